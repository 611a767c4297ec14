"""Components of a state that only events change, such as a latch (`Structure.constant`).

On an orbit whose events do not determine such a component every value of it closes, so that its
equation of closure is singular. It is then no unknown and keeps the value of the guess.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfil.xla.select import select
from jaxfil.xla.thresholds import SAME_STATE


class Constant(eqx.Module):
    """The numbers of the components without a field."""

    numbers: tuple[int, ...] = eqx.field(static=True)

    def held(
        self, gap: Float[Array, "M n"], jacobian: Float[Array, "Mn k"], size: Float[Array, " n"]
    ) -> tuple[Float[Array, "M n"], Float[Array, "Mn k"]]:
        """The mismatches of all arcs and their derivative, by the starts first, where components
        that no event determines stay as they are, given the scale of each."""
        m, n = gap.shape
        # Of the columns by starts, and of those by the period and a parameter, whose units differ.
        parts = jacobian[:, : m * n], jacobian[:, m * n :]
        sizes = [jnp.full(v.shape[1], jnp.max(abs(v), initial=0.0)) for v in parts]
        scale = jnp.concatenate(sizes)
        for i in self.numbers:
            rows = np.arange(m) * n + i
            own = jnp.asarray(np.eye(*jacobian.shape, dtype=jacobian.dtype)[rows])
            ends = jacobian[rows] + jnp.roll(own, -1, axis=0)
            # An event may turn it, and another one back.
            factors = jnp.sum(own * ends, axis=1)
            free = _is_rounding(ends - factors[:, None] * own, scale)
            free &= _is_rounding(jnp.prod(factors) - 1, 1)
            free &= _is_rounding(gap[:, i], size[i])
            gap = gap.at[:, i].set(select(free, 0, gap[:, i]))
            # Without its columns too a step leaves it unchanged to the last bit.
            alone = jacobian.at[:, rows].set(0).at[rows].set(own)
            jacobian = select(free, alone, jacobian)
        return gap, jacobian


def unchanged(
    constant: Bool[Array, "*batch n"], monodromy: Float[Array, "*batch n n"]
) -> Bool[Array, "*batch n"]:
    """Flags of the components, of those without a field, whose value at the end of an orbit is that
    at its start, whatever this is."""
    unit = jnp.eye(monodromy.shape[-1], dtype=monodromy.dtype)
    largest = jnp.max(abs(monodromy), axis=(-2, -1))
    return constant & (jnp.max(abs(monodromy - unit), axis=-1) <= rounding(largest)[..., None])


def _is_rounding(v: Array, scale: Array | float) -> Bool[Array, ""]:
    """Whether all numbers are rounding errors of numbers of a scale."""
    return jnp.all(abs(v) <= rounding(jnp.asarray(scale, v.dtype)))


def rounding(scale: Array) -> Array:
    """The rounding error of numbers of a scale after a period."""
    return SAME_STATE * float(jnp.finfo(scale.dtype).eps) * scale
