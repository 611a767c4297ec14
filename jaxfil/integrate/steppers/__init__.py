"""steppers: one smooth step, and what its estimated error says of it.

- tableau: the coefficients of a one-step method; a stepper is the method as the user names it
  (`explicit`, `rosenbrock`, `taylor`).
- polynomial: the motion within a step as a power series in the fraction of the step that is gone.
- trial step: a step not yet accepted.
- error estimate: whether a trial step can be trusted.
"""
