"""steppers: one smooth step, and the judgement of its estimated error.

- tableau: the coefficients of a one-step method; a stepper is the method as the user names it
  (`explicit`, `rosenbrock`, `taylor`).
- polynomial: the motion within a step as a power series in the elapsed fraction of the step.
- trial step: a step not yet accepted.
- error estimate: whether a trial step can be trusted.
"""
