"""run: the verb `solve`.

- options: the arguments of a run besides the problem.
- solution: its result; `dataset` writes it to a file, `failure` says where and why a run stopped.
- observed: values of a function of time, state, sides, reactions and modes along a motion.
- averaging: numbers that summarise a span of a motion: means, extremes, sums over events.
- step choice: a step and a stepper that belong together.
"""
