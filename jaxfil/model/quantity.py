"""Quantities: single numbers that say something of a motion over a span of time.

A user's functions enter, each in the record of what is made of it; `integrate.run.averaging` takes
the numbers. A plain function stands for its mean.
"""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, TypeAlias

import equinox as eqx

from jaxfil.model import argument


class _OfFunction(eqx.Module):
    """What is made of a function along a motion."""

    function: Callable[..., Any]
    """g."""
    _given: ClassVar[str] = "(t, x, side)"

    def __check_init__(self):
        argument.function("function", self.function, self._given)


class RMS(_OfFunction):
    r"""The root mean square of a function along a motion.

    $$g_\mathrm{rms} = \Bigl(\frac{1}{T} \int g(t, x(t), \mathrm{side}(t))^2\, dt\Bigr)^{1/2}$$

    **Arguments**

    - `function`: g, as in `jf.average`.

    **Raises** `ValueError` if it is no function.

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

    Where the rate of g along the motion vanishes within a step, the state there is that of a step
    of the method, and the value has its order. Both ends of a jump count. Which of two maxima is
    the larger is told from a cubic through the values and rates at both ends of steps: where they
    differ by less than its error, it may be the smaller one that is given.

    **Arguments**

    - `function`: g, as in `jf.average`.

    **Raises** `ValueError` if it is no function.

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

    It is found as that of `Maximum`.

    **Arguments**

    - `function`: g, as in `jf.average`.

    **Raises** `ValueError` if it is no function.

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
    r"""A sum over the events of a motion: impacts, crossings, ends of slides, ticks.

    $$\sum_i g(t_i, x(t_i^-), x(t_i^+), \mathrm{surfaces}_i)$$

    **Arguments**

    - `function`: g, a function of the time of an event, the state before it and the state after it,
      both of shape (n,), and flags of 0 and 1 that say which surfaces are those of the event, as
      `System.switching` counts them, shape () or (m,); none is that of a tick. It returns an array
      of any shape: the flags themselves count the events of each surface. If it has an argument
      `system`, it is given the system of the lane.

    A graze is an event, with the same state on both sides. Of infinitely many impacts that die out
    those count that are told apart from rest; the others have no energy left to speak of.

    **Raises** `ValueError` if it is no function.

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
"""What is made of a function along a motion; of a plain one its mean."""

Quantities: TypeAlias = Quantity | Mapping[str, Quantity]
"""One of them, or several by their names."""
