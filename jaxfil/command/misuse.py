"""The error of an invalid command line."""


class Misuse(Exception):
    """An invalid command line; the one-line message states the valid arguments."""
