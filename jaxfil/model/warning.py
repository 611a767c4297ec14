"""Warnings at the user's line, the line outside of the package that called into it."""

import sys
import warnings

_BETWEEN = ("equinox", "jaxtyping", "beartype", "contextlib")


def warn(message: str, category: type[Warning]) -> None:
    """Warn at the line that called the package."""
    modules, frame = [], sys._getframe(1)
    while frame is not None:
        modules.append(frame.f_globals.get("__name__", ""))
        frame = frame.f_back
    level = max(i for i, name in enumerate(modules) if name.split(".")[0] == "jaxfil") + 1
    # Equinox, which reads the attributes of its modules, a context that decorates a function, and
    # an active type checker are between the caller and the function.
    while level < len(modules) and modules[level].split(".")[0] in _BETWEEN:
        level += 1
    warnings.warn(message, category, stacklevel=level + 2)
