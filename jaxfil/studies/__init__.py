"""studies: questions that one or a few runs answer.

- average: time averages along a motion.
- return map: from one crossing of a section to the next.
- fit: parameters from measured motions.
- choose step: a step and a stepper for an error asked for; `work_precision` measures many.
"""
