"""Floquet multipliers in the complex plane."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from jaxfil.model import check
from jaxfil.model.labels import labels_of
from jaxfil.orbits.branch import Branch
from jaxfil.orbits.orbit import Orbit
from jaxfil.plot.canvas import BLACK, COLORS, VERMILLION, color_bar, own_axes, styled
from jaxfil.plot.legend import legend

# Colours of the parameter of a branch.
_SCALE = "viridis"


def multipliers(
    orbit: Orbit | Branch, ax: Axes | None = None, colorbar: bool | Axes = True, **style: Any
) -> Axes:
    """Draw the Floquet multipliers of an orbit, of a batch of orbits or of a branch.

    Multipliers outside the unit circle, of an unstable orbit, are crosses. The multiplier 1 of
    every orbit of an autonomous system, for a shift in time, has a separate mark and does not
    affect stability. On a `Branch` the colour shows the parameter.

    **Arguments**

    - `orbit`: an `Orbit`, of one lane or of many, or a `Branch`.
    - `ax`: the axes to draw on; by default new ones.
    - `colorbar`: whether to draw the parameter's scale beside them, or the axes to draw it in.
    - `style`: matplotlib's keywords of the marks, as `ms` or `alpha`; on a `Branch` the size, the
      marker, the label and `alpha`.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> orbit = jf.periodic_orbit(jf.systems.SDOscillator(omega=0.7), jnp.array([3.0, 0.6]))
    >>> ax = jf.plot.multipliers(orbit, jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), [text.get_text() for text in ax.get_legend().get_texts()]
    ('Re μ', ['inside'])
    """
    check.instance("orbit", orbit, Orbit, Branch)
    orbits = orbit.orbits if isinstance(orbit, Branch) else orbit
    values, trivial = _told_apart(orbits)
    ax = own_axes(ax)
    # Stability depends on the modulus, so the scales are equal and the circle is round.
    angle = np.linspace(0, 2 * np.pi, 361)
    ax.plot(np.cos(angle), np.sin(angle), color=BLACK, linewidth=0.8)
    ax.axhline(0, color=BLACK, linewidth=0.3)
    ax.axvline(0, color=BLACK, linewidth=0.3)
    parameter = orbit.values if isinstance(orbit, Branch) else np.zeros(len(values))
    at = np.broadcast_to(np.reshape(parameter, (-1, *[1] * (values.ndim - 1))), values.shape)
    norm = Normalize(at.min(), at.max())
    outside = (np.abs(values) > 1) & ~trivial
    finite = np.isfinite(values)
    for some, marker, color, label in (
        (~outside & ~trivial & finite, "o", COLORS[0], "inside"),
        (outside & finite, "x", VERMILLION, "outside"),
        (trivial & finite, "s", BLACK, "trivial"),
    ):
        if not some.any():
            continue
        x, y = np.real(values[some]), np.imag(values[some])
        ours = styled(style, color=color, marker=marker, label=label, linestyle="none")
        if not isinstance(orbit, Branch):
            ax.plot(x, y, **ours)
        else:
            size = ours.get("markersize", 3.0) ** 2
            kept = {key: ours[key] for key in ("marker", "label", "alpha") if key in ours}
            ax.scatter(x, y, size, at[some], cmap=_SCALE, norm=norm, **kept)
    if isinstance(orbit, Branch):
        labels = labels_of(orbits.system, orbits.x0.shape[-1])
        scale = ScalarMappable(norm, _SCALE)
        color_bar(ax, scale, colorbar, label=labels.parameter(orbit.parameter))
    ax.set_aspect("equal")
    ax.set_xlabel("Re μ")
    ax.set_ylabel("Im μ")
    legend(ax)
    return ax


def _told_apart(orbit: Orbit) -> tuple[np.ndarray, np.ndarray]:
    """The multipliers, and flags of the trivial multiplier of an autonomous system."""
    values = np.asarray(orbit.multipliers, complex)
    trivial = np.zeros(values.shape, bool)
    if orbit.system.period is None:
        # It equals 1 up to the error of the orbit; the nearest multiplier is taken.
        nearest = np.argmin(abs(np.where(np.isfinite(values), values, np.inf) - 1), axis=-1)
        np.put_along_axis(trivial, nearest[..., None], True, axis=-1)
    return values, trivial
