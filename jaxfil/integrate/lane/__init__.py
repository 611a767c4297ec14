"""lane: the data of one member of a batch, with a clock, contacts and an outcome of its own.

- problem: system, tableau, grid of steps and what is to be recorded, together.
- state: a lane between two iterations, and what a trial step finds.
- forcing phase: elapsed times that start anew in each period of the forcing.
- clock: times at which fields may jump; a tick is one of them (`clocks`).
- step length: how far a trial step goes, and what is at its end.
- recording: saved states and the table of events.
"""
