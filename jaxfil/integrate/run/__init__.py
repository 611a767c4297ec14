"""run: the verb `solve`.

- options: what a run is asked for besides the problem.
- solution: what it returns; `dataset` writes it to a file, `failure` says where and why it stopped.
- observed: values of a function of time, state, sides, reactions and modes along a motion.
- averaging: numbers of a motion over a span of time: means, extremes, sums over events.
- step choice: a step and a stepper that belong together.
"""
