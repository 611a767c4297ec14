"""The contacts of many motions in time, a row for each."""

from typing import Any

import numpy as np
from jaxtyping import Array, Float
from matplotlib import rcParams
from matplotlib.axes import Axes

from jaxfil.integrate.run.solution import Solution
from jaxfil.model import check
from jaxfil.plot.canvas import legend, own_axes, points_of, styled
from jaxfil.plot.path import MARKERS, contacts, lanes


def event_timeline(
    sol: Solution,
    ax: Axes | None = None,
    values: Float[Array, " p"] | Float[np.ndarray, " p"] | None = None,
    **style: Any,
) -> Axes:
    """Draw every contact of every lane at its time, marked by its kind.

    Continuous lines of marks are contacts that move smoothly with the lane. The order of contacts
    changes where a line begins or ends, or two lines merge.

    **Arguments**

    - `sol`: a `Solution` of one lane or of a batch of p lanes.
    - `ax`: the axes to draw on; by default new ones.
    - `values`: the height of each lane, such as the varied parameter; by default its number.
    - `style`: matplotlib's keywords of the marks, as `ms`.

    **Returns** the matplotlib axes.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=1.3)
    >>> def run(x):
    ...     return jf.solve(belt, jnp.stack([x, 0.0 * x]), 0.0, 5.0, 0.1, stepper=jf.RK4())
    >>> values = jnp.linspace(0.0, 1.0, 5)
    >>> ax = jf.plot.event_timeline(jax.vmap(run)(values), jf.plot.page().add_subplot(), values)
    >>> ax.get_xlabel(), sorted(text.get_text() for text in ax.get_legend().get_texts())
    ('t, s', ['crossing', 'slip', 'stick'])
    """
    check.instance("sol", sol, Solution)
    motions = lanes(sol)
    heights = np.arange(len(motions)) if values is None else np.asarray(values)
    if heights.shape != (len(motions),):
        raise ValueError(
            f"`values` must be one for each of {len(motions)} lanes, got shape {heights.shape}."
        )
    ax = own_axes(ax)
    size = float(np.clip(points_of(ax)[1] / len(motions), 1.0, rcParams["lines.markersize"]))
    found = [contacts(one) for one in motions]
    at = np.repeat(heights, [met.ts.size for met in found])
    ts = np.concatenate([met.ts for met in found])
    kinds = np.concatenate([met.kinds for met in found])
    for kind, (marker, color) in MARKERS.items():
        here = kinds == kind
        if here.any():
            ours = {"color": color, "markersize": size, "label": kind.name, "marker": marker}
            ours |= {"linestyle": "none", "markeredgewidth": 0, "rasterized": at.size > 10_000}
            ax.plot(ts[here], at[here], **styled(style, **ours))
    legend(ax, loc="upper right")
    ax.set_xlabel(sol.labels.time)
    ax.set_ylabel("lane" if values is None else "value of the lane")
    return ax
