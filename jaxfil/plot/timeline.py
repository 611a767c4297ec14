"""Contacts in time: of one motion a row for each surface, of many a row for each motion."""

from typing import Any

import numpy as np
from jaxtyping import Array, Float
from matplotlib import rcParams
from matplotlib.axes import Axes

from jaxfil.integrate.run.solution import Solution
from jaxfil.model import check
from jaxfil.plot.canvas import own_axes, points_of, styled
from jaxfil.plot.legend import legend
from jaxfil.plot.path import MARKERS, Contacts, contacts, lanes


def event_timeline(
    sol: Solution,
    ax: Axes | None = None,
    values: Float[Array, " p"] | Float[np.ndarray, " p"] | None = None,
    **style: Any,
) -> Axes:
    """Draw every contact of every lane at its time, marked by its kind.

    A single lane has a row for each surface, numbered from 0 as in the event table, and one for
    ticks of clocks; a contact of several surfaces is in the row of each. A batch has a row for each
    lane: continuous lines of marks are contacts that move smoothly with the lane, and the order of
    contacts changes where a line begins or ends, or two lines merge.

    **Arguments**

    - `sol`: a `Solution` of one lane or of a batch of p lanes.
    - `ax`: the axes to draw on; by default new ones.
    - `values`: the height of each lane, such as the varied parameter; by default its number, or
      for a single lane the surfaces.
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
    alone = np.ndim(sol.t_final) == 0 and values is None
    if alone:
        rows = _by_surface(found[0])
    else:
        at = np.repeat(heights, [met.ts.size for met in found])
        ts = np.concatenate([met.ts for met in found])
        rows = ts, at, np.concatenate([met.kinds for met in found])
    ts, at, kinds = rows
    for kind, (marker, color) in MARKERS.items():
        here = kinds == kind
        if here.any():
            ours = {"color": color, "markersize": size, "label": kind.name, "marker": marker}
            ours |= {"linestyle": "none", "markeredgewidth": 0, "rasterized": at.size > 10_000}
            ax.plot(ts[here], at[here], **styled(style, **ours))
    ax.set_xlabel(sol.labels.time)
    if alone:
        _name_surfaces(ax, found[0].members.shape[1], ticks=bool((at < 0).any()))
    else:
        ax.set_ylabel("lane" if values is None else "value of the lane")
    legend(ax)
    return ax


def _by_surface(met: Contacts) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, row and kind of each contact on each of its surfaces; a tick alone has the row −1."""
    rows = np.concatenate([~met.members.any(axis=1, keepdims=True), met.members], axis=1)
    contact, row = np.nonzero(rows)
    return met.ts[contact], row - 1, met.kinds[contact]


def _name_surfaces(ax: Axes, m: int, ticks: bool) -> None:
    """Number the rows of the surfaces, and name that of the ticks."""
    ax.set_yticks(range(-ticks, m), ["clock"] * ticks + [str(j) for j in range(m)])
    ax.update_datalim([(0, -ticks - 0.4), (0, m - 0.6)], updatex=False)
    ax.autoscale_view(scalex=False)
    ax.set_ylabel("surface")
