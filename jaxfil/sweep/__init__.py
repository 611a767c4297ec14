"""Many lanes at once: one parameter or several swept over thousands of values.

The words of this room:

- lane: one member of a batch, here one value of the parameters with its initial state.
- parameter grid: the values swept, on a line, on a product grid, or point by point.
- stroboscopic section: the state once every forcing period, which is what a diagram samples.
- transient: the forcing periods that run first and are not sampled.
- plan: every argument of a sweep once, checked.
- sampling: the part of its motion that each lane samples.
- point: a point in parameter space, as a lane is given it.
- chunk: the lanes of one call of the compiled program; chunks run on all cores at a time.
- block: the lanes within a chunk that share one loop, and are one kernel.
- checkpoint: a folder that keeps every finished chunk, and the record of what was asked for.
- record: every argument of a sweep by its name, by which a checkpoint knows its own sweep again.
- identity: a hash of what a function computes, which stands for it in a record.
- step halving: the same sweep at half the step; the distance of the two estimates the error.
- following: each value starts from the state in which the last one ended.
- conditions: what a sweep ran with besides the values swept.
- average: a number of each lane over the time of its samples: a mean, an extreme, a sum over
  events; `settled_average` gives those of one lane, with derivatives.
- data set: named arrays with their dimensions, from which files of every kind are written.
- basin: all initial states that lead to the same attractor.
"""
