"""xla: what coaxes one good kernel out of XLA.

Nothing here knows what a nonsmooth system is.

The words of this room:

- program: the operations of a function of arrays, as JAX has traced them (`program`).
- kernel: a program that XLA's CPU backend compiles into one function, loops included, instead of
  one for each of their parts, which would have to be started one by one (`kernel`).
- block: so many lanes that share a kernel, few enough for their numbers to stay in the first-level
  cache.
- element: one number of a small array; fields written with arrays are compiled number by number
  (`elements`).
- fence: what keeps XLA from computing a value again in each loop that uses it (`trace`).
- ahead: what a function takes of time alone, computed for all stages of a step at once (`trace`).
- forward Jacobian: the derivatives of all results by all arguments, a column for each number that
  moves; transposed, it is the reverse mode of loops (`forward_jacobian`).
- power series: the Taylor coefficients of what a program computes along a motion, by the recurrence
  of each operation (`series`, `series_functions`, `series_rules`, `series_program`).
- pushforward: results together with their tangents, in one run (`pushforward`).
- known: not traced; outside of every transformation verbs share compiled functions (`known`).
- masked write: an entry of a table, written by those lanes that have one (`masked_write`).
- jump: an operation that is not continuous in an argument, such as a sign (`jumps`).
- disk cache: compiled programs kept for later processes (`disk_cache`).
- range reduction: what brings the argument of a sine within a quarter of a turn (`fast_trig`).
"""
