"""Lyapunov exponents against a parameter, and their convergence."""

from typing import Any

import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes

from jaxfil.exponents.coupled import Synchronization, TransverseExponent
from jaxfil.exponents.lyapunov import LyapunovSpectrum
from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.plot.canvas import BLACK, COLORS, marker_size, own_axes, styled, subscript
from jaxfil.plot.legend import legend

# The axes reach below zero at most this multiple of the other exponents' size; exponents below this
# multiple of one over the time are zero.
_REACH, _ZERO = 5.0, 3.0


def lyapunov_exponents(
    values: Float[Array, " p"] | Float[np.ndarray, " p"],
    spectrum: LyapunovSpectrum,
    ax: Axes | None = None,
    parameter: str = "parameter",
    **style: Any,
) -> Axes:
    """Draw all exponents of a batch of spectra, one for each value, against the parameter.

    Exponents of −inf are ticks on the lower edge. Exponents so negative that the others would lie
    on one line are triangles there, and the legend has the least of them. Values whose average is
    not settled (`settled` False) are drawn hollow, failed lanes are omitted.

    **Arguments**

    - `values`: values of the parameter, shape (p,).
    - `spectrum`: a `LyapunovSpectrum` of p lanes, as from `equinox.filter_vmap`.
    - `ax`: the axes to draw on; by default new ones.
    - `parameter`: label of the axis.
    - `style`: matplotlib's keywords of the dots, as `ms` or `alpha`.

    **Returns** the matplotlib axes.

    >>> import equinox as eqx
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> def spectrum(damping):
    ...     wall = jf.systems.ImpactOscillator(damping=damping)
    ...     return jf.lyapunov_spectrum(
    ...         wall, jnp.array([0.1, 0.0]), periods=20, transient=0, steps=20, stepper=jf.RK4())
    >>> values = jnp.array([0.8, 1.0, 1.2])
    >>> ax = jf.plot.lyapunov_exponents(
    ...     values, eqx.filter_vmap(spectrum)(values), jf.plot.page().add_subplot(), "c")
    >>> ax.get_xlabel(), [text.get_text() for text in ax.get_legend().get_texts()]
    ('c', ['λ₁', 'λ₂'])
    """
    check.instance("spectrum", spectrum, LyapunovSpectrum)
    values, exponents = np.asarray(values), np.asarray(spectrum.exponents)
    if exponents.shape[:1] != values.shape:
        raise ValueError(
            f"`spectrum` must hold one spectrum for each of {values.size} values, got exponents of "
            f"shape {exponents.shape}."
        )
    ax = own_axes(ax)
    settled = np.asarray(spectrum.settled)
    ax.axhline(0, color=BLACK, linewidth=0.5)
    size = float(np.clip(1.5 * marker_size(ax, values.size), 2.0, 3.0))
    least = _lower_limit(exponents, np.asarray(spectrum.times))
    edges = 0
    for i, column in enumerate(exponents.T):
        color = COLORS[i % len(COLORS)]
        # The largest one, the most important, above the others.
        ours: dict[str, Any] = {
            "linestyle": "none",
            "marker": "o",
            "markersize": size,
            "color": color,
        }
        ours = styled(style, **ours, markeredgewidth=0, zorder=2 + 0.1 * (len(exponents.T) - i))
        lost, far = np.isneginf(column), np.isfinite(column) & (column < least)
        inside = ~lost & ~far
        name = f"λ{subscript(i + 1)}"
        named: dict[str, Any] = {"label": name} if np.isfinite(column[inside]).any() else {}
        ax.plot(values[settled & inside], column[settled & inside], **ours | named)
        passing = np.isfinite(column) & inside & ~settled
        hollow: dict[str, Any] = {"fillstyle": "none", "markeredgewidth": 0.5}
        if i == 0 and passing.any():
            hollow["label"] = "not settled"
        ax.plot(values[passing], column[passing], **ours | hollow)
        for which, marker, told in ((far, "v", "down to"), (lost, "|", "=")):
            if which.any():
                end = f"{column[which].min():.3g}".replace("-inf", "−∞").replace("-", "−")
                _on_edge(ax, values[which], edges, marker, color, f"{name} {told} {end}")
                edges += 1
    finite = values[np.isfinite(values)]
    if finite.size:
        ax.set_xlim(finite.min(), finite.max() if finite.max() > finite.min() else None)
    ax.set_xlabel(parameter)
    ax.set_ylabel("exponents per unit time")
    legend(ax, markerscale=2)
    return ax


def _lower_limit(exponents: np.ndarray, times: np.ndarray) -> float:
    """The lower limit of axes for exponents (…, n) averaged over times (…, k), −inf without one."""
    rest = abs(exponents[..., :-1] if exponents.shape[-1] > 1 else exponents)
    # An exponent of zero has a mean of the order of one over the time.
    rest = rest[np.isfinite(rest) & (rest > _ZERO / np.nanmax(times))]
    if not rest.size:
        return -np.inf
    limit = -_REACH * np.percentile(rest, 90)
    return float(limit) if exponents[np.isfinite(exponents)].min() < limit else -np.inf


def _on_edge(ax: Axes, values: np.ndarray, row: int, marker: str, color: str, label: str) -> None:
    """Marks at values on the lower edge of axes, where they are not read as numbers; those of
    several exponents in rows."""
    edge: dict[str, Any] = {"transform": ax.get_xaxis_transform(), "clip_on": False}
    ax.plot(values, np.full(values.size, 0.025 * row), marker, color=color, label=label, **edge)


@draws(LyapunovSpectrum, TransverseExponent)
def lyapunov_convergence(
    spectrum: LyapunovSpectrum | TransverseExponent, ax: Axes | None = None, **style: Any
) -> Axes:
    """Draw the running estimates of one spectrum, or of one transverse exponent, against time.

    The time is the averaging time. The band is one standard error of the last estimate wide, and
    shrinks as 1/√t, like the error of a mean. An exponent of −inf, or one so negative that the
    others would lie on one line, is in the legend alone.

    **Arguments**

    - `spectrum`: a `LyapunovSpectrum` or a `TransverseExponent` of one lane.
    - `ax`: the axes to draw on; by default new ones.
    - `style`: matplotlib's keywords of the lines, as `lw`.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall = jf.systems.ImpactOscillator(damping=1.0)
    >>> found = jf.lyapunov_spectrum(
    ...     wall, jnp.array([0.1, 0.0]), periods=20, transient=0, steps=20, stepper=jf.RK4())
    >>> ax = jf.plot.lyapunov_convergence(found, jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), len(ax.lines)
    ('time averaged over', 2)
    """
    check.instance("spectrum", spectrum, LyapunovSpectrum, TransverseExponent)
    times = np.asarray(spectrum.times)
    if times.ndim != 1:
        raise ValueError(
            f"`spectrum` must be of one lane, got {times.shape[0]} of them; take lane i with "
            "jax.tree.map(lambda a: a[i], spectrum)."
        )
    exponents = np.asarray(spectrum.exponents)
    errors = np.atleast_1d(spectrum.standard_error)
    running = np.asarray(spectrum.running).reshape(times.size, exponents.size)
    ax, least = own_axes(ax), _lower_limit(exponents, times)
    for i, (column, last, error) in enumerate(zip(running.T, exponents, errors, strict=True)):
        told = f"λ{subscript(i + 1)} = {last:.4g}".replace("-inf", "−∞").replace("-", "−")
        if np.isnan(last):
            continue
        if np.isneginf(last) or last < least:
            ax.plot([], [], linewidth=0, label=told)
            continue
        color, band = COLORS[i % len(COLORS)], error * np.sqrt(times[-1] / times)
        ax.fill_between(times, last - band, last + band, color=color, alpha=0.2, linewidth=0)
        ax.plot(times, column, **styled(style, color=color, label=told))
    ax.set_xlim(0, times[-1])
    ax.set_xlabel("time averaged over")
    ax.set_ylabel("running estimate")
    legend(ax)
    return ax


@draws(Synchronization)
def synchronization(found: Synchronization, ax: Axes | None = None) -> Axes:
    """Draw the smallest distance of drive and response at each coupling.

    Couplings that synchronised are filled, and a line stands at the exponent that follows.

    **Arguments**

    - `found`: a `Synchronization` of one lane.
    - `ax`: the axes to draw on; by default new ones.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall = jf.systems.ImpactOscillator(damping=1.0)
    >>> found = jf.synchronization_exponent(
    ...     wall, jnp.array([0.1, 0.0]), jnp.array([-0.55, -0.3]), periods=20, transient=0,
    ...     steps=20, stepper=jf.RK4())
    >>> ax = jf.plot.synchronization(found, jf.plot.page().add_subplot())
    >>> ax.get_ylabel(), [text.get_text() for text in ax.get_legend().get_texts()]
    ('smallest distance', ['synchronised', 'λ₁ = −0.3'])
    """
    check.instance("found", found, Synchronization)
    couplings, distances = np.asarray(found.couplings), np.asarray(found.distances)
    if couplings.ndim != 1:
        raise ValueError(
            f"`found` must be of one lane, got {couplings.shape[0]} of them; take lane i with "
            "jax.tree.map(lambda a: a[i], found)."
        )
    ax = own_axes(ax)
    done = np.asarray(found.synchronized)
    # Distances of zero are drawn at the level of rounding.
    shown = np.maximum(distances, np.finfo(distances.dtype).eps)
    ax.plot(couplings[~done], shown[~done], "o", color=COLORS[0], fillstyle="none")
    ax.plot(couplings[done], shown[done], "o", color=COLORS[0], label="synchronised")
    ax.axhline(float(found.tolerance), color=BLACK, linestyle="--", linewidth=0.8)
    if np.isfinite(found.exponent):
        label = f"λ₁ = {float(found.exponent):.3g}".replace("-", "−")
        ax.axvline(float(found.exponent), color=COLORS[1], linewidth=1, label=label)
    ax.set_yscale("log")
    ax.set_xlabel("coupling")
    ax.set_ylabel("smallest distance")
    legend(ax)
    return ax
