"""Pictures: a diagram or a solution enters, the matplotlib axes it was drawn on leave.

The only file that knows matplotlib, which is why importing jaxfil does not import this one. Every
picture takes the axes to draw on, or makes its own, and gives them back. The colours are those of
Okabe and Ito, which colour-blind readers tell apart.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jaxfil.results import KINDS

if TYPE_CHECKING:
    from jaxfil.analysis.branch import Branch, SpecialPoint
    from jaxfil.analysis.curve import BifurcationCurve
    from jaxfil.analysis.lyapunov import LyapunovSpectrum
    from jaxfil.analysis.work_precision import WorkPrecision
    from jaxfil.solution import Solution
    from jaxfil.sweep import BifurcationDiagram

BLACK, VERMILLION = "#000000", "#D55E00"
SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
COLORS = ("#0072B2", VERMILLION, "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
BANDS = {1: ("H > 0", "#56B4E9"), 0: ("sliding", "#E69F00"), -1: ("H < 0", "#FFFFFF")}
MARKERS = {
    KINDS.crossing: ("o", "#0072B2"),
    KINDS.stick: ("s", "#D55E00"),
    KINDS.slip: ("D", "#009E73"),
    KINDS.impact: ("^", "#CC79A7"),
    KINDS.graze: ("*", "#F0E442"),
}
CURVES = {
    "grazing": "#0072B2",
    "grazing-sliding": "#D55E00",
    "adding-sliding": "#009E73",
    "crossing-sliding": "#CC79A7",
    "switching-sliding": "#E69F00",
}
POINTS = {
    "fold": ("s", "#0072B2"),
    "period-doubling": ("D", "#009E73"),
    "neimark-sacker": ("^", "#CC79A7"),
    "contacts": ("o", "#F0E442"),
}


def bifurcation_diagram(
    diagram: BifurcationDiagram, ax: Axes | None = None, component: int = 0
) -> Axes:
    """Draw one component of every sample against the parameter.

    A million samples take about a second, and a vector file holds them as an image. Values whose
    lane ended early are ticked along the lower edge.
    """
    values, xs = np.asarray(diagram.values), np.asarray(diagram.xs)
    _check_component(component, xs.shape[-1])
    ax = _own_axes() if ax is None else ax
    column = xs[..., component]
    seen = np.isfinite(column)
    ax.plot(
        np.broadcast_to(values[:, None], column.shape)[seen],
        column[seen],
        color=BLACK,
        alpha=0.4,
        linestyle="none",
        marker="o",
        markersize=_marker_size(ax, values.size),
        markeredgewidth=0,
        rasterized=True,
    )
    _tick_failures(ax, values[~diagram.successful])
    if values.min() < values.max():
        ax.set_xlim(values.min(), values.max())
    ax.set_xlabel(diagram.parameter)
    ax.set_ylabel(f"x[{component}] once a period")
    return ax


def time_history(sol: Solution, ax: Axes | None = None, component: int = 0) -> Axes:
    """Draw one component against time over bands that show the mode, one band for each surface.

    A band changes at the contact between two saved times, and once at most: save often, as
    `diffrax.SaveAt(t0=True, steps=True)` does.
    """
    ts, xs = _path(sol)
    _check_component(component, xs.shape[1])
    ax = _own_axes() if ax is None else ax
    _shade_modes(ax, sol)
    ax.plot(ts, xs[:, component], color=BLACK, linewidth=1)
    ax.set_xlim(np.nanmin(ts), np.nanmax(ts))
    ax.set_xlabel("t")
    ax.set_ylabel(f"x[{component}]")
    return ax


def phase_portrait(sol: Solution, ax: Axes | None = None) -> Axes:
    """Draw the second component against the first and mark every contact by its kind."""
    _, xs = _path(sol)
    if xs.shape[1] < 2:
        raise ValueError("`sol` must have two components or more, got 1.")
    ax = _own_axes() if ax is None else ax
    ax.plot(xs[:, 0], xs[:, 1], color=BLACK, linewidth=1)
    _, contacts, kinds, _ = _contacts(sol)
    for kind in np.unique(kinds):
        marker, color = MARKERS[KINDS(kind)]
        x, y = contacts[kinds == kind, :2].T
        ax.plot(x, y, marker, color=color, markeredgecolor=BLACK, label=KINDS(kind).name)
    if kinds.size:
        ax.legend(fontsize="small", loc="upper right")
    ax.set_xlabel("x[0]")
    ax.set_ylabel("x[1]")
    return ax


def branch(
    branch: Branch, ax: Axes | None = None, component: int = 0, extremes: bool = False
) -> Axes:
    """Draw a branch of orbits against its parameter, unstable parts dashed, special points marked.

    Shown is one component of x0, or with `extremes` its smallest and largest value on the orbit.
    """
    _check_component(component, branch.orbits.x0.shape[-1])
    ax = _own_axes() if ax is None else ax
    if extremes:
        curves = [column[:, component] for column in branch.extremes()]
        label = f"least and largest x[{component}]"
    else:
        curves, label = [np.asarray(branch.orbits.x0)[:, component]], f"x[{component}] at t0"
    stable = branch.stable
    for curve in curves:
        for solid, style in ((True, "-"), (False, "--")):
            keep = stable == solid
            if not keep.any():
                continue
            # A piece between two orbits is drawn as the second one is.
            keep[:-1] |= keep[1:]
            ax.plot(
                branch.values,
                np.where(keep, curve, np.nan),
                style,
                color=BLACK if solid else VERMILLION,
                linewidth=1.2,
                label=("stable" if solid else "unstable") if curve is curves[0] else None,
            )
        for kind in dict.fromkeys(point.kind for point in branch.points):
            marker, color = POINTS[kind]
            shown = [point for point in branch.points if point.kind == kind]
            ax.plot(
                [point.value for point in shown],
                [_height(branch.values, curve, point) for point in shown],
                marker,
                color=color,
                markeredgecolor=BLACK,
                label=kind if curve is curves[0] else None,
            )
    ax.legend(fontsize="small")
    ax.set_xlabel(branch.parameter)
    ax.set_ylabel(label)
    return ax


def bifurcation_curve(curve: BifurcationCurve, ax: Axes | None = None) -> Axes:
    """Draw a bifurcation in the plane of two parameters, each kind in its colour, points of
    codimension two marked."""
    ax = _own_axes() if ax is None else ax
    kinds = np.array(curve.kinds)
    for kind in dict.fromkeys(curve.kinds):
        keep = kinds == kind
        keep[:-1] |= keep[1:]
        values = np.where(keep[:, None], curve.values, np.nan)
        ax.plot(*values.T, color=CURVES.get(kind, BLACK), linewidth=1.5, label=kind)
    for point in curve.points:
        ax.plot(*point.values, "o", color=BLACK, label=f"{point.before} to {point.after}")
    ax.legend(fontsize="small")
    ax.set_xlabel(curve.parameters[0])
    ax.set_ylabel(curve.parameters[1])
    return ax


def lyapunov_exponents(
    values: np.ndarray, spectrum: LyapunovSpectrum, ax: Axes | None = None, parameter: str = ""
) -> Axes:
    """Draw all exponents of a batch of spectra, one for each value, against the parameter.

    Exponents of −inf are ticked along the lower edge. Values whose average is no steady motion
    (`settled` False) are drawn hollow, and left out altogether where the lane failed.
    """
    values, exponents = np.asarray(values), np.asarray(spectrum.exponents)
    if exponents.shape[:1] != values.shape:
        raise ValueError(
            f"`spectrum` must hold one spectrum for each of {values.size} values, got exponents of "
            f"shape {exponents.shape}."
        )
    ax = _own_axes() if ax is None else ax
    settled = np.asarray(spectrum.settled)
    ax.axhline(0, color=BLACK, linewidth=0.5)
    size = max(1.5, 2 * _marker_size(ax, values.size))
    for i, column in enumerate(exponents.T):
        color = SERIES[i % len(SERIES)]
        style = {"linestyle": "none", "marker": "o", "markersize": size, "color": color}
        lost = np.isneginf(column)
        ax.plot(values[settled & ~lost], column[settled & ~lost], label=f"λ{i + 1}", **style)
        passing = np.isfinite(column) & ~settled
        ax.plot(values[passing], column[passing], fillstyle="none", markeredgewidth=0.5, **style)
        if lost.any():
            edge = {"transform": ax.get_xaxis_transform(), "clip_on": False, "color": color}
            height = np.full(lost.sum(), 0.015 + 0.03 * i)
            ax.plot(values[lost], height, "|", label=f"λ{i + 1} = −∞", **edge)
    ax.set_xlim(values.min(), values.max() if values.max() > values.min() else None)
    ax.set_xlabel(parameter)
    ax.set_ylabel("exponents per unit time")
    ax.legend(fontsize="small", loc="best", markerscale=2)
    return ax


def lyapunov_convergence(spectrum: LyapunovSpectrum, ax: Axes | None = None) -> Axes:
    """Draw the running estimates of one spectrum against the time averaged over, with the band of
    one standard error that the last of them has, shrinking as 1/√t."""
    times, running = np.asarray(spectrum.times), np.asarray(spectrum.running)
    if times.ndim != 1:
        raise ValueError(
            f"`spectrum` must be of one lane, got {times.shape[0]} of them: take lane i with "
            "jax.tree.map(lambda a: a[i], spectrum)."
        )
    ax = _own_axes() if ax is None else ax
    for i, column in enumerate(running.T):
        color, last = SERIES[i % len(SERIES)], np.asarray(spectrum.exponents)[i]
        if not np.isfinite(last):
            continue
        error = np.asarray(spectrum.standard_error)[i] * np.sqrt(times[-1] / times)
        ax.fill_between(times, last - error, last + error, color=color, alpha=0.2, linewidth=0)
        ax.plot(times, column, color=color, label=f"λ{i + 1} = {last:.4g}")
    ax.set_xlim(0, times[-1])
    ax.set_xlabel("time averaged over")
    ax.set_ylabel("running estimate")
    ax.legend(fontsize="small", loc="upper right")
    return ax


def work_precision(table: WorkPrecision, ax: Axes | None = None) -> Axes:
    """Draw the error of every run against its run time, a line for each stepper.

    Steps get shorter to the right. Below the dashed line, the change of the reference on halving
    its step, errors are not resolved.
    """
    ax = _own_axes() if ax is None else ax
    size = max(float(np.max(abs(table.reference))), np.finfo(float).tiny)
    floor = max(table.reference_error, float(np.finfo(table.reference.dtype).eps) * size)
    lines = zip(table.steppers, table.seconds, table.errors, strict=True)
    for (name, seconds, errors), color in zip(lines, itertools.cycle(COLORS)):
        order = np.argsort(-table.dts)  # run times of neighbours may change places by chance
        told = np.maximum(errors, floor)[order]
        ax.loglog(seconds[order], told, "o-", color=color, markersize=4, label=name)
    if np.isfinite(floor):
        ax.axhline(floor, color=BLACK, linewidth=0.8, linestyle="--", label="reference")
    ax.set_xlabel("run time of a lane, s")
    ax.set_ylabel("error of x(t1)")
    ax.legend(fontsize="small")
    return ax


def page() -> Figure:
    """An empty figure that no window shows, for a picture that goes to a file."""
    return Figure(figsize=(8, 5), dpi=200, layout="constrained")


def _height(values: np.ndarray, curve: np.ndarray, point: SpecialPoint) -> float:
    """Of a curve at a special point, which lies between the orbits index − 1 and index."""
    pair = slice(max(point.index - 1, 0), point.index + 1)
    order = np.argsort(values[pair])
    return float(np.interp(point.value, values[pair][order], curve[pair][order]))


def _own_axes() -> Axes:
    import matplotlib.pyplot as plt  # looks for a display, so only when a window is wanted

    return plt.subplots(layout="constrained")[1]


def _check_component(component: int, n: int) -> None:
    if not -n <= component < n:
        raise ValueError(f"`component` must be from 0 to {n - 1}, got {component}.")


def _marker_size(ax: Axes, columns: int) -> float:
    """The width of a column of samples in points, from half a point up to two."""
    width = ax.get_window_extent().transformed(ax.figure.dpi_scale_trans.inverted()).width
    return float(np.clip(72 * width / columns, 0.5, 2.0))


def _tick_failures(ax: Axes, values: np.ndarray) -> None:
    if values.size:
        label = f"{values.size} ended early"
        ax.plot(
            values,
            np.zeros(values.size),
            "|",
            color=VERMILLION,
            transform=ax.get_xaxis_transform(),
            clip_on=False,
            label=label,
        )
        ax.legend(fontsize="small", loc="upper right")


def _shade_modes(ax: Axes, sol: Solution) -> None:
    """Fill one band of the axes for each surface, the first lowest, with its mode's colour."""
    ts, _, modes = _saved(sol)
    times, _, _, members = _contacts(sol)
    m = modes.shape[1]
    for j in range(m):
        starts, widths, held = _spans(ts, modes[:, j], times[members[:, j]])
        for mode, (_, color) in BANDS.items():
            ax.broken_barh(
                list(zip(starts[held == mode], widths[held == mode], strict=True)),
                (j / m, 1 / m),
                transform=ax.get_xaxis_transform(),
                facecolor=color,
                alpha=0.5,
                linewidth=0,
            )
    shown = [
        Patch(facecolor=color, alpha=0.5, edgecolor=BLACK, linewidth=0.5, label=label)
        for mode, (label, color) in BANDS.items()
        if (modes == mode).any()
    ]
    if shown:
        ax.legend(handles=shown, fontsize="small", loc="upper right")


def _spans(
    ts: np.ndarray, modes: np.ndarray, contacts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start, width and mode of each span of time over which the mode stays the same."""
    changes = np.flatnonzero(np.diff(modes))
    edges = [ts[0]]
    for before, after in zip(ts[changes], ts[changes + 1], strict=True):
        low, high = min(before, after), max(before, after)
        between = contacts[(low <= contacts) & (contacts <= high)]
        edges.append(between[-1] if between.size else after)
    edges.append(ts[-1])
    return np.array(edges[:-1]), np.diff(edges), modes[np.append(changes, len(modes) - 1)]


def _path(sol: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Times and states saved, with the contacts among them in order and a gap at each impact."""
    ts, xs, _ = _saved(sol)
    times, contacts, kinds, _ = _contacts(sol)
    impacts = times[kinds == KINDS.impact]
    gaps = np.full((impacts.size, xs.shape[1]), np.nan)
    every = np.concatenate([times, impacts, ts])  # so at one time: left limit, gap, right limit
    order = np.argsort(every if ts[0] <= ts[-1] else -every, kind="stable")
    return every[order], np.concatenate([contacts, gaps, xs])[order]


def _saved(sol: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, states and modes that were saved and reached."""
    if np.ndim(sol.t_final):
        raise ValueError(
            f"`sol` must be one lane, got {np.shape(sol.t_final)} of them: "
            "take lane i with jax.tree.map(lambda a: a[i], sol)."
        )
    if sol.ts is not None:
        ts, xs, modes = map(np.asarray, (sol.ts, sol.xs, sol.modes))
        real = np.isfinite(ts) & np.isfinite(xs).all(axis=1)
        if real.sum() > 1:
            return ts[real], xs[real], modes[real]
    raise ValueError(
        "`sol` must hold two saved times or more: "
        "solve with saveat=diffrax.SaveAt(t0=True, steps=True) or diffrax.SaveAt(ts=...)."
    )


def _contacts(sol: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, state just before, kind and surfaces of every contact that the event table holds."""
    table = sol.events
    if table is None:
        n, m = np.size(sol.x_final), np.size(sol.mode_final)
        return np.zeros(0), np.zeros((0, n)), np.zeros(0, int), np.zeros((0, m), bool)
    ts, xs, kinds, members = map(np.asarray, (table.ts, table.xs, table.kinds, table.members))
    real = kinds != KINDS.none
    return ts[real], xs[real], kinds[real], members[real]
