"""What answers are compared with, that shares no code with the package.

Exact motions of random systems with relays (`relay_motion`) and walls (`wall_motion`) in extended
precision, systems whose motions have closed forms, and what XLA and JAX say of a program: its
operations (`hlo`) and how often it was compiled (`compilations`). The benchmarks use them too.
"""
