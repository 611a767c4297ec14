"""Floquet multipliers in the complex plane.

An orbit enters; the axes its multipliers were drawn on leave.
"""

import numpy as np
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.orbits.orbit import Orbit
from jaxfil.plot.canvas import BLACK, COLORS, VERMILLION, own_axes


def multipliers(orbit: Orbit, ax: Axes | None = None) -> Axes:
    """Draw the Floquet multipliers of an orbit, or of a batch of them, and the unit circle.

    Those outside it are drawn as crosses: the orbit is unstable. The multiplier 1 that every orbit
    of an autonomous system has, for a shift in time, is drawn apart and says nothing of stability.

    **Arguments**

    - `orbit`: an `Orbit`, of one lane or of many.
    - `ax`: the axes to draw on; by default those of a figure of their own.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> orbit = jf.periodic_orbit(jf.systems.SDOscillator(omega=0.7), jnp.array([3.0, 0.6]))
    >>> ax = jf.plot.multipliers(orbit, jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), [text.get_text() for text in ax.get_legend().get_texts()]
    ('Re μ', ['inside'])
    """
    check.instance("orbit", orbit, Orbit)
    values = np.asarray(orbit.multipliers, complex)
    trivial = np.zeros(values.shape, bool)
    if orbit.system.period is None:
        # It is 1 to the error of the orbit only: the nearest one is taken for it.
        nearest = np.argmin(abs(np.where(np.isfinite(values), values, np.inf) - 1), axis=-1)
        np.put_along_axis(trivial, nearest[..., None], True, axis=-1)
    finite = np.isfinite(values)
    values, trivial = values[finite], trivial[finite]
    ax = own_axes(ax)
    # Stability is told by the modulus: equal axes, or the circle would be none.
    angle = np.linspace(0, 2 * np.pi, 361)
    ax.plot(np.cos(angle), np.sin(angle), color=BLACK, linewidth=0.8)
    ax.axhline(0, color=BLACK, linewidth=0.3)
    ax.axvline(0, color=BLACK, linewidth=0.3)
    outside = (np.abs(values) > 1) & ~trivial
    for some, marker, color, label in (
        (~outside & ~trivial, "o", COLORS[0], "inside"),
        (outside, "x", VERMILLION, "outside"),
        (trivial, "s", BLACK, "trivial"),
    ):
        if some.any():
            ax.plot(np.real(values[some]), np.imag(values[some]), marker, color=color, label=label)
    if values.size:
        ax.legend(fontsize="small", loc="best")
    ax.set_aspect("equal")
    ax.set_xlabel("Re μ")
    ax.set_ylabel("Im μ")
    return ax
