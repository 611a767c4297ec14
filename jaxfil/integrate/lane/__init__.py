"""lane: the data of one member of a batch, with a clock, contacts and an outcome of its own.

- problem: system, tableau, grid of steps and what is to be recorded, together.
- state: a lane between two iterations, and what a trial step finds.
- forcing phase: elapsed times that start anew in each period of the forcing.
- clock: times at which fields may jump; a tick is one of them (`clocks`).
- step length: how far a trial step goes, and what is at its end.
- recording: the table of events.
- recorder: which states are saved, and where (`recorders`).
- extension: a feature with a state of its own, and the hooks that the loop calls.
"""
