"""lane: the data of one member of a batch, which has a clock, contacts and an outcome of its own.

- problem: system, tableau, time grid and recording options, as one object.
- state: a lane between two iterations, and the end of a trial step.
- forcing phase: elapsed times that restart in each period of the forcing.
- clock: times at which fields may jump; a tick is one of them (`clocks`).
- step length: the length of a trial step, and the times that its end coincides with.
- recording: the table of events.
- recorder: rules for which states are saved and where (`recorders`).
- extension: a feature with a state of its own, and the hooks that the loop calls.
"""
