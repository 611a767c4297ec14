"""contacts: where a trial step meets a surface, and what goes on from there.

- guard: what is positive within a mode and zero at its end: ±H on a side, 1 − w² on a slide of
  weight w, the reaction at rest. A surface just met is armed again once its guard exceeds rounding.
  A limit that is no surface of the system is a section.
- cubic: the guard between the ends of a step, by its values and rates there.
- polynomial: the guard within a step whose motion is one; its first zero is found on it.
- locate: where in a trial step a guard first becomes negative; a landing is a step that has ended
  there, with its Newton correction in time.
- switch: the map that is due, of a tick or of a surface, and the mode at the corrected state.
- decision: which mode goes on, of all surfaces that the state is on together (`decide`).
- reset: what a surface does to the state at a contact, and what follows: thrown back, let through,
  rest, or complete chattering, infinitely many impacts in a finite time (`resets`).
- beginning: how a run starts on such surfaces, and whether a reset is owed there.
- accumulation: contacts that recur at times that shrink in one ratio, completed by their limit.
"""
