"""Error against run time."""

import itertools

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

from jaxfil.integrate.run.step_choice import StepChoice
from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.plot.canvas import BLACK, COLORS, own_axes
from jaxfil.plot.legend import legend
from jaxfil.studies.work_precision import WorkPrecision


@draws(WorkPrecision)
def work_precision(table: WorkPrecision, ax: Axes | None = None) -> Axes:
    """Draw the error of every run against its run time, a line for each stepper.

    Steps become shorter to the right. Errors below the dashed line, the change of the reference
    when its step is halved, are not resolved.

    **Arguments**

    - `table`: a `WorkPrecision`.
    - `ax`: the axes to draw on; by default new ones.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> table = jf.work_precision(
    ...     jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0]), 2.0, [jf.RK4()], [0.1, 0.05])
    >>> ax = jf.plot.work_precision(table, jf.plot.page().add_subplot())
    >>> ax.get_xscale(), ax.get_yscale(), ax.lines[0].get_label()
    ('log', 'log', 'RK4')
    """
    check.instance("table", table, WorkPrecision)
    ax = own_axes(ax)
    size = max(float(np.max(abs(table.reference))), np.finfo(float).tiny)
    # Errors are drawn at or above the error of the reference; a logarithmic axis has no zero.
    floor = max(table.reference_error, float(np.finfo(table.reference.dtype).eps) * size)
    lines = zip(table.steppers, table.seconds, table.errors, strict=True)
    for (name, seconds, errors), color in zip(lines, itertools.cycle(COLORS)):
        order = np.argsort(-table.dts)  # run times of neighbours may be exchanged by chance
        told = np.maximum(errors, floor)[order]
        ax.loglog(seconds[order], told, "o-", color=color, markersize=4, label=name)
    if np.isfinite(floor):
        ax.axhline(floor, color=BLACK, linewidth=0.8, linestyle="--", label="reference")
    _thin_ticks(ax)
    ax.set_xlabel("run time of a lane, s")
    ax.set_ylabel("error of x(t1)")
    legend(ax)
    return ax


@draws(StepChoice)
def step_choice(choice: StepChoice, ax: Axes | None = None) -> Axes:
    """Draw the error of every run of a choice against its run time.

    A line for each stepper; the tolerance is the dashed line, and the chosen run the ring.

    **Arguments**

    - `choice`: a `StepChoice`.
    - `ax`: the axes to draw on; by default new ones.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> scene, x0 = jf.systems.RotatingOscillator(), jnp.array([0.36787944117144233, 0.0])
    >>> choice = jf.choose_step(scene, x0, 0.0, 2.0, tolerance=1e-4, steppers=[jf.RK4()])
    >>> ax = jf.plot.step_choice(choice, jf.plot.page().add_subplot())
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['RK4', 'tolerance', 'chosen']
    """
    check.instance("choice", choice, StepChoice)
    ax = own_axes(ax)
    # Errors are drawn at or above the error of the reference; a logarithmic axis has no zero.
    floor = max(choice.reference_error, float(np.finfo(choice.reference.dtype).eps))
    lines = zip(choice.steppers, choice.times, choice.errors, strict=True)
    for (name, times, errors), color in zip(lines, itertools.cycle(COLORS)):
        told = np.maximum(errors, floor)
        ax.loglog(times, told, "o-", color=color, markersize=4, label=name)
    ax.axhline(choice.tolerance, color=BLACK, linewidth=0.8, linestyle="--", label="tolerance")
    ring = {"markersize": 10, "markerfacecolor": "none", "markeredgecolor": BLACK}
    ax.plot(choice.seconds, max(choice.error, floor), "o", label="chosen", **ring)
    ax.set_xlabel("run time of a lane, s")
    ax.set_ylabel("error of x(t1), relative")
    _thin_ticks(ax)
    legend(ax)
    return ax


def _thin_ticks(ax: Axes) -> None:
    """Ticks at 1, 2 and 5 of a decade for few decades, because labels of all nine would overlap."""
    low, high = ax.get_xlim()
    few = np.log10(high / low) < 2
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=8))
    ax.xaxis.set_major_formatter(LogFormatterSciNotation(minor_thresholds=(np.inf, np.inf)))
    ax.xaxis.set_minor_formatter(NullFormatter())
