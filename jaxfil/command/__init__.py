"""What `python -m jaxfil` does: words enter, a picture or a table, its numbers and one line leave.

Words are read without JAX, which takes a second to import: help, the version and most mistakes are
answered before it is.

The words of this room:

- misuse: a command line that cannot be carried out; one line says what is allowed instead.
- listing: the textbook systems by their names, with their parameters and initial states.
- suggestion: the name that was probably meant.
"""
