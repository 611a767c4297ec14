"""Old spellings of public names.

The old and the new spelling of an argument or an attribute enter; what goes on taking the old one
leaves. It does so for one release, with a `DeprecationWarning` that says the new one.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from jaxfil.model.warning import warn

_Args = ParamSpec("_Args")
_Out = TypeVar("_Out")


def warn_renamed(old: str, new: str) -> None:
    """The warning that `old` is now called `new`."""
    warn(f"`{old}` is now called `{new}`.", DeprecationWarning)


def renamed_argument(
    old: str, new: str
) -> Callable[[Callable[_Args, _Out]], Callable[_Args, _Out]]:
    """A decorator: the function also takes its argument `new` under the keyword `old`."""

    def decorate(function: Callable[_Args, _Out]) -> Callable[_Args, _Out]:
        @ft.wraps(function)
        def call(*args: _Args.args, **kwargs: _Args.kwargs) -> _Out:
            if old in kwargs and new not in kwargs:
                warn_renamed(old, new)
                kwargs[new] = kwargs.pop(old)
            return function(*args, **kwargs)

        return call

    return decorate


def renamed_attribute(old: str, new: str) -> property:
    """A property that reads the attribute `new` under its old name."""

    def read(self: object) -> Any:
        warn_renamed(old, new)
        return getattr(self, new)

    return property(read, doc=f"The old name of `{new}`.")
