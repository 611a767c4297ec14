"""Studies that need one or a few runs.

- average: time averages along a motion.
- return map: from one crossing of a section to the next.
- fit: parameters from measured motions.
- choose step: a step and a stepper for a given error; `work_precision` measures many.
"""
