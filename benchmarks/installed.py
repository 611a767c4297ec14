"""Is a package installed that a program needs? Its name enters; a reason, or nothing, leaves."""

import importlib.util


def missing(package: str, called: str = "") -> str:
    """Why what needs this package cannot run; empty where it is installed."""
    found = importlib.util.find_spec(package)
    return "" if found else f"{called or package} is not installed"
