"""How a result is drawn, without knowing how.

A function that draws one kind of result enters through `draws`; `draw` gives back the axes that it
has drawn on. Results are made in rooms that `jaxfil.plot` imports, so they cannot import it:
`jaxfil.plot` registers here what it draws, and each result's `plot()` looks here.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:  # each name there needs JAX, which `jaxfil` connects pictures without
    from jaxfil.model.types import Axes

_Drawer = TypeVar("_Drawer", bound=Callable[..., Any])
_DRAWERS: dict[type, Callable[..., Any]] = {}
_IMPORTERS: list[Callable[[], object]] = []


def use(importer: Callable[[], object]) -> None:
    """Have `importer` called before a picture is drawn: it imports what registers pictures."""
    _IMPORTERS.append(importer)


def draws(*kinds: type) -> Callable[[_Drawer], _Drawer]:
    """A decorator: the function, called with a result of one of these kinds, draws it."""

    def register(drawer: _Drawer) -> _Drawer:
        _DRAWERS.update(dict.fromkeys(kinds, drawer))
        return drawer

    return register


def draw(result: object, **options: Any) -> "Axes":
    """Draw a result; returns the matplotlib axes."""
    # An importer runs before every picture and not once: it is cheap (a module that is imported
    # comes from `sys.modules`), and a second one may have been added since.
    for importer in _IMPORTERS:
        importer()
    drawer = next(_DRAWERS[kind] for kind in type(result).__mro__ if kind in _DRAWERS)
    return drawer(result, **options)
