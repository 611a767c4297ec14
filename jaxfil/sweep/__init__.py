"""Sweeps: many lanes at once, over thousands of values of one parameter or several.

Terms of this room:

- lane: one member of a batch, here one value of the parameters with its initial state.
- parameter grid: the swept values, on a line, on a product grid, or point by point.
- stroboscopic section: the state once every forcing period, which a diagram samples.
- transient: the forcing periods that run first and are not sampled.
- plan: the checked arguments of a sweep.
- sampling: the part of its motion that each lane samples.
- point: the parameter values of a lane.
- chunk: the lanes of one call of the compiled program; chunks run on all cores at a time.
- block: the lanes within a chunk that share one loop, and are one kernel.
- checkpoint: a folder with every finished chunk, and the record of the sweep.
- record: every argument of a sweep by name, by which a checkpoint identifies its sweep.
- identity: a hash of the computation of a function, which represents it in a record.
- step halving: the same sweep at half the step; the distance of the two estimates the error.
- following: each value starts from the final state of the previous value.
- conditions: the arguments of a sweep other than the swept values.
- average: a number of each lane over the time of its samples, such as a mean, an extreme or a sum
  over events; `settled_average` computes one lane, with derivatives.
- data set: named arrays with their dimensions, the common description of all file formats.
- basin: all initial states that approach the same attractor.
"""
