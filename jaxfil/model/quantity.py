"""Numbers that summarise a motion over a span of time.

Each class wraps a user's function; a plain function stands for its mean.
`integrate.run.averaging` computes the numbers.
"""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, TypeAlias

import equinox as eqx

from jaxfil.model import argument


class _OfFunction(eqx.Module):
    """A quantity of a function along a motion."""

    function: Callable[..., Any]
    """The function g."""
    _given: ClassVar[str] = "(t, x, side)"

    def __check_init__(self):
        argument.function("function", self.function, self._given)


class RMS(_OfFunction):
    r"""The root mean square of a function along a motion.

    $$g_\mathrm{rms} = \Bigl(\frac{1}{T} \int g(t, x(t), \mathrm{side}(t))^2\, dt\Bigr)^{1/2}$$

    On a slide g is the blend of both sides, whose square is taken: of the force of a brake that
    holds it is the holding force, and not the limit that both sides have.

    **Arguments**

    - `function`: g, as in `jf.average`.

    **Raises** `ValueError` if `function` is not callable.

    **Source**: textbook.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall, x0 = jf.systems.ImpactOscillator(wall=2.0), jnp.array([0.0, 0.0])
    >>> d = jf.bifurcation_diagram(
    ...     wall, "omega", jnp.array([0.9, 1.2]), x0, transient=20, samples=2, progress=False,
    ...     average={"speed": jf.RMS(lambda t, x, side: x[1])})
    >>> d.averages["speed"].shape
    (2,)
    """


class Maximum(_OfFunction):
    r"""The largest value of a function along a motion, between samples and steps too.

    $$g_\mathrm{max} = \max_t\, g(t, x(t), \mathrm{side}(t))$$

    Where the rate of g along the motion vanishes within a step, a step of the method gives the
    state there, so the value has the order of the method. Both ends of a jump count. A cubic
    through the values and rates at both ends of steps decides which of two maxima is larger; where
    they differ by less than its error, the smaller one may be returned.

    **Arguments**

    - `function`: g, as in `jf.average`.

    **Raises** `ValueError` if `function` is not callable.

    **Source**: E. Hairer, S. P. Nørsett and G. Wanner, Solving Ordinary Differential Equations I,
    Springer (1993), section II.6, for the cubic.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall, x0 = jf.systems.ImpactOscillator(wall=2.0), jnp.array([0.0, 0.0])
    >>> d = jf.bifurcation_diagram(
    ...     wall, "omega", jnp.array([0.9, 1.2]), x0, transient=20, samples=2, progress=False,
    ...     average={"amplitude": jf.Maximum(lambda t, x, side: x[0])})
    >>> bool((d.averages["amplitude"] >= d.xs[..., 0].max(axis=1)).all())
    True
    """


class Minimum(_OfFunction):
    r"""The least value of a function along a motion, between samples and steps too.

    $$g_\mathrm{min} = \min_t\, g(t, x(t), \mathrm{side}(t))$$

    It is computed like `Maximum`.

    **Arguments**

    - `function`: g, as in `jf.average`.

    **Raises** `ValueError` if `function` is not callable.

    **Source**: as of `Maximum`.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall, x0 = jf.systems.ImpactOscillator(wall=2.0), jnp.array([0.0, 0.0])
    >>> d = jf.bifurcation_diagram(
    ...     wall, "omega", jnp.array([0.9, 1.2]), x0, transient=20, samples=2, progress=False,
    ...     average={"clearance": jf.Minimum(lambda t, x, side: 2.0 - x[0])})
    >>> bool((d.averages["clearance"] > 0).all())
    True
    """


class EventSum(_OfFunction):
    r"""A sum over the events of a motion, such as impacts, crossings, ends of slides, ticks.

    $$\sum_i g(t_i, x(t_i^-), x(t_i^+), \mathrm{surfaces}_i)$$

    **Arguments**

    - `function`: g, a function of the time of an event, the state before it and the state after it,
      both of shape (n,), and flags of 0 and 1 for the surfaces of the event, in the order of
      `System.switching`, shape () or (m,), all 0 for a tick. It returns an array of any shape; the
      flags themselves count the events of each surface. An argument `system` receives the system of
      the lane.

    A graze is an event with the same state on both sides. Of infinitely many impacts that die out,
    the sum includes those before rest is detected; the energy of the others is negligible. A tick
    that leaves the state unchanged, as with a dose of zero, is not an event and adds nothing, but
    the derivative of the sum includes that of its map.

    **Raises** `ValueError` if `function` is not callable.

    **Source**: textbook.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall, x0 = jf.systems.ImpactOscillator(), jnp.array([0.0, 0.0])
    >>> d = jf.bifurcation_diagram(
    ...     wall, "omega", jnp.array([0.9, 1.2]), x0, transient=20, samples=2, progress=False,
    ...     average={"impacts": jf.EventSum(lambda t, before, after, surfaces: surfaces)})
    >>> d.averages["impacts"].shape
    (2,)
    """

    _given: ClassVar[str] = "(t, before, after, surfaces)"


KINDS = RMS, Maximum, Minimum, EventSum

Quantity: TypeAlias = Callable[..., Any] | RMS | Maximum | Minimum | EventSum
"""A quantity of a motion; a plain function stands for its mean."""

Quantities: TypeAlias = Quantity | Mapping[str, Quantity]
"""One quantity, or several by name."""
