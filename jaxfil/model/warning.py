"""Warnings that point to the user's line.

A sentence and a category enter; a warning leaves, at the line outside of the package that called
into it.
"""

import sys
import warnings

_BETWEEN = ("equinox", "jaxtyping", "beartype", "contextlib")


def warn(message: str, category: type[Warning]) -> None:
    """Warn where the package was called from."""
    modules, frame = [], sys._getframe(1)
    while frame is not None:
        modules.append(frame.f_globals.get("__name__", ""))
        frame = frame.f_back
    level = max(i for i, name in enumerate(modules) if name.split(".")[0] == "jaxfil") + 1
    # Equinox, which reads the attributes of its modules, a context that decorates a function, and
    # a checker of types, where one is at work, stand between the caller and what it calls.
    while level < len(modules) and modules[level].split(".")[0] in _BETWEEN:
        level += 1
    warnings.warn(message, category, stacklevel=level + 2)
