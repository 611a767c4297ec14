"""The command line `python -m jaxfil`.

Arguments are read without JAX, which takes a second to import. Help, the version and most mistakes
are therefore answered at once.

Terms of this room:

- command: a subcommand of `arguments`. Each has a file with `check`, which reports mistakes before
  any computation, and `run`, which returns the exit code.
- chosen: the system of a command, a textbook system or a class in a file, with its settings.
- misuse: an invalid command line; one line states the valid arguments.
- listing: the textbook systems by name, with their parameters and initial states.
- suggestion: the name that was probably meant.
"""
