"""xla: compilation of whole lanes into single CPU kernels, and transformations of programs.

This room does not depend on nonsmooth systems. Its words:

- program: the operations of a function of arrays, as traced by JAX (`program`).
- kernel: a program that XLA's CPU backend compiles into one function, loops included, instead of
  one for each of its parts, which would have to be started one by one (`kernel`).
- block: a number of lanes that share a kernel, small enough for their numbers to stay in the
  first-level cache.
- element: one number of a small array; fields written with arrays are compiled number by number
  (`elements`).
- fence: an operation that keeps XLA from recomputing a value in each loop that uses it (`trace`).
- ahead: values of a function that depend on time alone, computed for all stages of a step at once
  (`trace`).
- forward Jacobian: the derivatives of all results by all arguments, a column for each number that
  varies; transposed, it is the reverse mode of loops (`forward_jacobian`).
- power series: the Taylor coefficients of a program's values along a motion, by the recurrence of
  each operation (`series`, `series_functions`, `series_rules`, `series_program`).
- pushforward: results together with their tangents, in one run (`pushforward`).
- known: not traced; outside every transformation verbs share compiled functions (`known`).
- masked write: an entry of a table, written by the lanes that have one (`masked_write`).
- masked product: one that is zero where a factor is, whatever the other one is
  (`masked_product`).
- valid: of a result whose derivatives are used; the others leave shared cotangents unchanged
  (`valid_derivative`).
- jump: an operation that is discontinuous in an argument, such as a sign (`jumps`).
- disk cache: compiled programs stored for later processes (`disk_cache`).
- threshold: a multiple of eps below which a value is rounding (`thresholds`).
- range reduction: reduction of the argument of a sine to a quarter of a turn (`fast_trig`).
"""
