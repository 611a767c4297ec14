"""Numbers of a field that are squared, such as those whose root mean square is asked for.

The square is of the value along the motion, so it is taken after the blend of a slide and the
reactions of a rest: both sides of a brake that holds have the square of its limit.
"""

import numpy as np

from jaxfil.integrate.system.components import Components, where
from jaxfil.xla.select import select
from jaxfil.xla.series import Expansion, Series, square


def squared(which: tuple[int, ...], f: Components) -> Components:
    """The rate of a motion from its field f, with the squares of these numbers."""
    if not which:
        return f
    if f.is_array:
        return where(Components([_flags(which, f.size)]), f * f, f)
    return Components(v * v if i in which else v for i, v in enumerate(f.parts))


def squared_series(
    which: tuple[int, ...], expansion: Expansion, f: list[Series], n: int
) -> list[Series]:
    """The same of power series, of n numbers or of one array of them."""
    if not which:
        return f
    if len(f) == n:
        return [square(expansion, v) if i in which else v for i, v in enumerate(f)]
    (own,), flags = f, _flags(which, n)
    both = square(expansion, own)
    return [expansion.series(lambda k: select(flags, both[k], own[k]))]


def _flags(which: tuple[int, ...], n: int) -> np.ndarray:
    return np.isin(np.arange(n), which)
