"""Error against run time.

A table of work and precision enters; the axes it was drawn on leave.
"""

import itertools

import numpy as np
from matplotlib.axes import Axes

from jaxfil.integrate.work_precision import WorkPrecision
from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.plot.canvas import BLACK, COLORS, own_axes


@draws(WorkPrecision)
def work_precision(table: WorkPrecision, ax: Axes | None = None) -> Axes:
    """Draw the error of every run against its run time, a line for each stepper.

    Steps get shorter to the right. Below the dashed line, the change of the reference on halving
    its step, errors are not resolved.

    **Arguments**

    - `table`: a `WorkPrecision`.
    - `ax`: the axes to draw on; by default those of a figure of their own.

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
    # No error is drawn below what the reference knows, nor at zero, where a logarithm has no place.
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
