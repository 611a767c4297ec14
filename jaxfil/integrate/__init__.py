"""integrate: a system from one state to the next.

The words of this room, in the order in which a step meets them:

- components: the numbers of a state one by one, or as one array, as the loop carries them
  (`components`, `component_system`).
- side, mode: a surface's side is +1 or −1; the mode of a motion is its side of each surface, 0
  where it slides on it (`filippov`), or twice the side where it rests on it (`unilateral`).
- tableau, stepper: the coefficients of a one-step method; the method as the user names it
  (`stepper`, `rosenbrock`).
- problem: system, tableau, grid of steps and what is to be recorded, together (`problem`).
- guard: what is positive within a mode and zero at its end: ±H on a side, 1 − w² on a slide of
  weight w (`filippov`), the reaction at rest (`unilateral`).
- trial step: one smooth step in the current mode, not yet accepted (`loop`).
- event location: where in a trial step a guard first becomes negative (`event_location`).
- landing: a step that has ended on a contact, and its Newton correction in time (`event_location`).
- switch: reset and choice of the mode at the corrected state (`mode_switch`; at t0 `initial_mode`).
- reset: what a surface does to the state at a contact, and what follows: thrown back, let through,
  rest, or complete chattering, infinitely many impacts in a finite time (`impact`).
- arming: a surface just met is met again only after its guard has risen above rounding
  (`mode_switch`).
- free step: a trial step on a lane's own sides, which needs no more if it meets nothing
  (`event_free`); coasting and judging are the two turns of a batch (`batch_loop`).
- lane: one member of a batch, with a clock, contacts and an outcome of its own.
"""
