"""contacts: where a trial step reaches a surface, and how the motion continues from there.

- guard: a function that is positive within a mode and zero at its end: ±H on a side, 1 − w² on a
  slide of weight w, the reaction at rest. After a contact a surface is armed again once its guard
  exceeds rounding. A limit that is not a surface of the system is a section.
- cubic: the guard between the ends of a step, interpolated from its values and rates there.
- polynomial: the guard within a step whose motion is a polynomial; its first zero is located on it.
- locate: the fraction of a trial step at which a guard first becomes negative; a landing is a step
  that has ended there, with its Newton correction in time.
- switch: the map that is due, of a tick or of a surface, and the mode at the corrected state.
- decision: the mode that continues, for all surfaces that the state is on together (`decide`).
- reset: the map of a surface at a contact, and the motion after it: thrown back, let through, at
  rest, or in complete chattering, infinitely many impacts in a finite time (`resets`).
- holding: the rounding of H by the forces that hold a state on surfaces.
- beginning: the start of a run on surfaces with resets, and whether a reset is due there.
- turn: the contacts from one to the next of its kind; of an `accumulation`, in which they recur at
  geometrically shrinking intervals, it tells the limit.
"""
