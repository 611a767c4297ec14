"""What `python -m jaxfil` does: words enter, a picture or a table, its numbers and one line leave.

Words are read without JAX, which takes a second to import: help, the version and most mistakes are
answered before it is.

The words of this room:

- command: what `arguments` names; each has a file, with `check`, which says what is
  wrong before any computing starts, and `run`, which gives the exit code.
- chosen: the system of a command, a textbook one or a class in a file, with what was set.
- misuse: a command line that cannot be carried out; one line says what is allowed instead.
- listing: the textbook systems by their names, with their parameters and initial states.
- suggestion: the name that was probably meant.
"""
