"""A return map, one component at a section against the same component one return before."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.model.labels import Labels, labels_of
from jaxfil.model.system import System
from jaxfil.model.types import States
from jaxfil.plot.canvas import BLACK, GREY, own_axes, styled


def return_map(
    xs: States,
    ax: Axes | None = None,
    component: int = 0,
    system: System | None = None,
    lag: int = 1,
    **style: Any,
) -> Axes:
    """Draw one component of every state of a section against its value `lag` states before.

    Points on the diagonal repeat. A steep end like a square root indicates grazing; a flat part
    indicates sliding, which forgets the initial state.

    **Arguments**

    - `xs`: states in the order of time, shape (k, n) or (…, k, n), as `diagram.xs`.
    - `ax`: the axes to draw on; by default new ones.
    - `component`: the component of the state, from 0.
    - `system`: the `System` with the names of the axes; by default x[0], x[1], ….
    - `lag`: the number of returns between the two states, 1 or more.
    - `style`: matplotlib's keywords of the dots, as `color`, `ms`, `alpha` or `label`.

    **Returns** the matplotlib axes.

    >>> import numpy as np
    >>> import jaxfil as jf
    >>> xs = np.array([[0.1], [0.2], [0.4], [0.8]])
    >>> ax = jf.plot.return_map(xs, jf.plot.page().add_subplot())
    >>> print(ax.get_ylabel(), ax.lines[1].get_xydata().round(1).tolist())
    x[0], the next time [[0.1, 0.2], [0.2, 0.4], [0.4, 0.8]]
    """
    if system is not None:
        check.system("system", system)
    given, xs = xs, np.asarray(xs)
    if not isinstance(lag, (int, np.integer)) or lag < 1:
        raise ValueError(f"`lag` must be an integer of 1 or more, got {lag!r}.")
    if xs.dtype.kind not in "fiu" or xs.ndim < 2 or xs.shape[-2] <= lag:
        got = f"shape {xs.shape}" if xs.dtype.kind in "fiu" else type(given).__name__
        raise ValueError(f"`xs` must be states of shape (k, n) with k > {lag}, got {got}.")
    check.component("component", component, xs.shape[-1])
    ax = own_axes(ax)
    column = xs[..., component]
    before, after = column[..., :-lag].ravel(), column[..., lag:].ravel()
    finite = np.isfinite(before) & np.isfinite(after)
    ax.axline((0, 0), slope=1, color=GREY, linewidth=0.8)
    size = float(np.clip(60 / np.sqrt(max(finite.sum(), 1)), 1, 4))
    ours = {"marker": ".", "color": BLACK, "markersize": size, "markeredgewidth": 0}
    ours |= {"linestyle": "none", "rasterized": True}
    ax.plot(before[finite], after[finite], **styled(style, **ours))
    labels = Labels() if system is None else labels_of(system, xs.shape[-1])
    ax.set_xlabel(labels.component(component))
    told = "{}, the next time" if lag == 1 else f"{{}}, {lag} times later"
    ax.set_ylabel(labels.component(component, told))
    return ax
