"""The registry of drawing functions.

`jaxfil.plot` imports the rooms that define results, so they cannot import it. It registers its
functions here with `draws`, and each result's `plot()` calls `draw`, which returns the axes.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:  # each name there needs JAX, and `jaxfil` connects pictures without JAX
    from jaxfil.model.types import Axes

_Drawer = TypeVar("_Drawer", bound=Callable[..., Any])
_DRAWERS: dict[type, Callable[..., Any]] = {}
_IMPORTERS: list[Callable[[], object]] = []


def use(importer: Callable[[], object]) -> None:
    """Call `importer`, which imports the registering modules, before a picture is drawn."""
    _IMPORTERS.append(importer)


def draws(*kinds: type) -> Callable[[_Drawer], _Drawer]:
    """A decorator that registers a function to draw results of these classes."""

    def register(drawer: _Drawer) -> _Drawer:
        _DRAWERS.update(dict.fromkeys(kinds, drawer))
        return drawer

    return register


def draw(result: object, **options: Any) -> "Axes":
    """Draw a result; returns the matplotlib axes."""
    # Importers run before every picture. They are cheap (an imported module comes from
    # `sys.modules`), and another one may have been added since.
    for importer in _IMPORTERS:
        importer()
    drawer = next(_DRAWERS[kind] for kind in type(result).__mro__ if kind in _DRAWERS)
    return drawer(result, **options)
