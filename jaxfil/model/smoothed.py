"""A nonsmooth system made smooth."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.model import argument
from jaxfil.model.system import System, field_of
from jaxfil.model.wrapped import Wrapped
from jaxfil.xla import fast_trig


class _Smoothed(Wrapped):
    width: Array

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        h = jnp.atleast_1d(self.system.switching(t, x))
        scalar = jnp.ndim(self.system.switching(t, x)) == 0
        blend = 2 / np.pi * fast_trig.arctan(h / self.width)
        total = jnp.zeros_like(x)
        # 2^m fields, one for each choice of sides; their weights are products that sum to one.
        for corner in np.ndindex(*(2,) * h.shape[0]):
            sides = 1.0 - 2.0 * jnp.asarray(corner, x.dtype)
            weight = jnp.prod(0.5 * (1 + sides * blend))
            field = field_of(self.system, t, x, sides[0] if scalar else sides)
            total = total + weight * field
        return total

    @property
    def feels_reactions(self) -> bool:
        return False  # a smooth motion does not rest

    def tick(self, t: Array, x: Array, clock: Array) -> Array:
        return self.system.tick(t, x, clock)

    # Properties in place of the class variables, because the wrapped system defines the names.
    @property
    def state_names(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.state_names

    @property
    def symbols(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return {f"system.{name}": symbol for name, symbol in self.system.symbols.items()}

    @property
    def units(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        same = {"t", *self.system.state_names}
        given = self.system.units.items()
        return {name if name in same else f"system.{name}": unit for name, unit in given}


def smoothed(system: System, width: Array | float) -> System:
    """The smooth system in which sgn H of `system` is replaced by (2/π) arctan(H/width).

        ẋ = Σ_s Π_j (1 + s_j (2/π) arctan(H_j/width))/2 · F(t, x, s),    s ∈ {−1, +1}^m

    The two fields of each surface are blended, with product weights for several surfaces. Use it to
    check the event-driven result. The error is of the order of `width`, and the smooth field is
    stiff, with rates of the order of 1/width.

    **Arguments**

    - `system`: a `System` without `reset`. Its parameters are called `system.name` in the new one.
    - `width`: the scale of H over which the fields are blended, positive, in units of H; a
      parameter of the new system.

    **Returns** a `System` without surfaces.

    **Raises** `ValueError` if the system has impacts, which a blend of fields cannot replace.

    **Source**: J. Sotomayor and M. A. Teixeira, Regularization of discontinuous vector fields,
    International Conference on Differential Equations, Lisboa (1996) 207–223.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> smooth = jf.smoothed(jf.systems.CoulombOscillator(), 1e-2)
    >>> force = smooth.vector_field(jnp.array(0.0), jnp.array([0.0, 1.0]), jnp.zeros(0))[1]
    >>> print(round(float(force), 4))  # −F (2/π) arctan(1/width), F = 0.4
    -0.3975
    """
    if not isinstance(system, System):
        raise ValueError(f"`system` must be a jaxfil.System, got {type(system).__name__}.")
    scale = argument.leaf("width", width, positive=True)
    if system.resets:
        raise ValueError("`system` must have no `reset`: an impact cannot be smoothed.")
    return _Smoothed(system, jnp.asarray(scale))
