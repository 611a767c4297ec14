"""A command line that cannot be carried out."""


class Misuse(Exception):
    """A command line that cannot be carried out; its one-line message says what is allowed."""
