"""A Lyapunov exponent over two parameters."""

import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.colors import CenteredNorm, LinearSegmentedColormap

from jaxfil.exponents.lyapunov import LyapunovSpectrum
from jaxfil.model import check
from jaxfil.plot.canvas import BLACK, BLUE, VERMILLION, WHITE, color_bar, own_axes, subscript

# Zero is white; the hue separates chaos from regular motion, and its depth is the strength.
_SCALE = LinearSegmentedColormap.from_list("exponents", [BLUE, WHITE, VERMILLION])

Values = Float[Array, " p"] | Float[np.ndarray, " p"]


def exponent_map(
    values: tuple[Values, Values],
    spectrum: LyapunovSpectrum,
    ax: Axes | None = None,
    parameters: tuple[str, str] = ("first parameter", "second parameter"),
    component: int = 0,
    colorbar: bool | Axes = True,
) -> Axes:
    """Draw one exponent of each point of a grid, by default the largest.

    Positive ones are red, chaos; negative ones blue; the line is zero. The scale is
    symmetric, and smaller exponents, including −inf, have its lowest colour. Failed lanes are
    omitted.

    **Arguments**

    - `values`: values of both parameters, shapes (a,) and (b,).
    - `spectrum`: a `LyapunovSpectrum` of lanes of shape (a, b), as of `equinox.filter_vmap` twice.
    - `ax`: the axes to draw on; by default new ones.
    - `parameters`: labels of the axes.
    - `component`: which exponent, from 0, the largest.
    - `colorbar`: whether to draw the scale of colours beside them, or the axes to draw it in.

    **Returns** the matplotlib axes.

    >>> import equinox as eqx
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> def spectrum(damping, stiffness):
    ...     wall = jf.systems.ImpactOscillator(damping=damping, stiffness=stiffness)
    ...     return jf.lyapunov_spectrum(
    ...         wall, jnp.array([0.1, 0.0]), periods=20, transient=0, steps=20, stepper=jf.RK4())
    >>> values = jnp.array([0.8, 1.0]), jnp.array([1.0, 1.5, 2.0])
    >>> over = eqx.filter_vmap(eqx.filter_vmap(spectrum, in_axes=(None, 0)), in_axes=(0, None))
    >>> ax = jf.plot.exponent_map(values, over(*values), jf.plot.page().add_subplot(), ("c", "k"))
    >>> ax.get_xlabel(), ax.figure.axes[1].get_ylabel()
    ('c', 'λ₁ per unit time')
    """
    check.instance("spectrum", spectrum, LyapunovSpectrum)
    exponents = np.asarray(spectrum.exponents)
    check.component("component", component, exponents.shape[-1])
    axes = [np.asarray(axis) for axis in values]
    sizes = tuple(axis.size for axis in axes)
    if exponents.shape[:-1] != sizes or min(sizes) < 2:
        raise ValueError(
            f"`spectrum` must hold one spectrum for each point of a grid of {sizes[0]} × {sizes[1]}"
            f" values, two or more of each, got exponents of shape {exponents.shape}."
        )
    ax = own_axes(ax)
    order = [np.argsort(axis) for axis in axes]
    x, y = (axis[o] for axis, o in zip(axes, order, strict=True))
    shown = exponents[..., component][np.ix_(*order)].T
    finite = shown[np.isfinite(shown)]
    above = finite.max(initial=0.0)
    reach = above if above > 0 else abs(finite).max(initial=1e-3)
    picture = ax.pcolormesh(
        x,
        y,
        np.ma.masked_invalid(np.where(np.isneginf(shown), -2 * reach, shown)),
        cmap=_SCALE,
        norm=CenteredNorm(0, reach),
        shading="nearest",
        rasterized=True,
    )
    if (finite < 0).any() and above > 0:
        ax.contour(x, y, np.maximum(shown, -reach), levels=[0.0], colors=BLACK, linewidths=0.5)
    label = f"λ{subscript(component + 1)} per unit time"
    color_bar(ax, picture, colorbar, label=label, extend="min")
    ax.set_xlabel(parameters[0])
    ax.set_ylabel(parameters[1])
    return ax
