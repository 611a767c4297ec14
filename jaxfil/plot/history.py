"""A motion against time, over bands that show its mode."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.typing import ColorType

from jaxfil.integrate.run.solution import Solution
from jaxfil.model import check
from jaxfil.model.outcomes import EventKind
from jaxfil.model.system import System
from jaxfil.plot.canvas import BLACK, COLORS, own_axes, points_of, styled, subscript
from jaxfil.plot.legend import legend
from jaxfil.plot.path import (
    BANDS,
    JUMPS,
    MARKERS,
    chosen,
    contacts,
    drawn_lanes,
    jumps,
    path,
    saved,
    spans,
)

# With several surfaces, the height of the strip of each in the size of the text, and the part of
# the axes that all of them take at most.
_STRIP, _ALL = 1.1, 0.4


def time_history(
    sol: Solution,
    ax: Axes | None = None,
    components: int | Iterable[int] = 0,
    system: System | None = None,
    **style: Any,
) -> Axes:
    """Draw components against time over bands that show the mode.

    For one surface the bands fill the axes; for several each has a strip below the curves, numbered
    from 0 as in the event table. Impacts are marked, and their jumps dotted. A band changes at the
    contact between two saved times, and at most once; save often, as with
    `diffrax.SaveAt(t0=True, steps=True)`. For a batch every lane is drawn,
    except those that stopped at their start, without bands.

    **Arguments**

    - `sol`: a `Solution` with two saved times or more.
    - `ax`: the axes to draw on; by default new ones.
    - `components`: components of the state, from 0; each has a colour.
    - `system`: the `System` whose reset gives the state after an impact; by default the next saved
      state.
    - `style`: matplotlib's keywords of a line, as `color` or `lw`.

    **Returns** the matplotlib axes.

    >>> import diffrax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0])
    >>> saveat = diffrax.SaveAt(t0=True, steps=True)
    >>> sol = jf.solve(system, x0, 0.0, 14.0, 0.1, stepper=jf.RK4(), saveat=saveat)
    >>> ax = jf.plot.time_history(sol, jf.plot.page().add_subplot(), components=1, color="C0")
    >>> ax.get_ylabel(), [text.get_text() for text in ax.get_legend().get_texts()]
    ("x'", ['H > 0', 'sliding', 'H < 0'])
    """
    check.instance("sol", sol, Solution)
    if system is not None:
        check.system("system", system)
    shown = chosen("components", components, sol.x_final.shape[-1], ())
    motions = drawn_lanes(sol)
    paths = [path(one) for one in motions]
    ax = own_axes(ax)
    for i, c in enumerate(shown):
        ours = {"color": COLORS[i % len(COLORS)] if len(shown) > 1 else BLACK, "linewidth": 1}
        if len(shown) > 1:
            ours["label"] = sol.labels.component(c)
        for one, (ts, xs) in zip(motions, paths, strict=True):
            (line,) = ax.plot(ts, xs[:, c], **styled(style, **ours))
            for kind in JUMPS:
                _mark_jumps(ax, one, system, kind, c, line.get_color())
    every = np.concatenate([ts for ts, _ in paths])
    ax.set_xlim(np.nanmin(every), np.nanmax(every))
    ax.set_xlabel(sol.labels.time)
    ax.set_ylabel(", ".join(sol.labels.component(c) for c in shown))
    entries, height = _shade_modes(ax, sol) if np.ndim(sol.t_final) == 0 else ((), 0.0)
    legend(ax, entries, below=height)
    return ax


def _mark_jumps(
    ax: Axes, sol: Solution, system: System | None, kind: EventKind, c: int, color: ColorType
) -> None:
    """A mark at the start of each jump of a kind, and a dotted line to its end."""
    ts, before, after = jumps(sol, system, kind)
    if not ts.size:
        return
    marker, fill = MARKERS[kind]
    pair = np.stack([before[:, c], after[:, c], np.full(ts.size, np.nan)], axis=1)
    ax.plot(np.repeat(ts, 3), pair.ravel(), ":", color=color, linewidth=0.8)
    ax.plot(ts, before[:, c], marker, color=fill, markeredgecolor=BLACK, label=kind.name)


def _shade_modes(ax: Axes, sol: Solution) -> tuple[list[Patch], float]:
    """Fill the bands of each surface, the first lowest, with their modes' colours; returns the
    entries of the legend, and the part of the height that strips take."""
    ts, _, modes = saved(sol)
    met = contacts(sol)
    m = modes.shape[1]
    height = 1.0
    if m > 1:
        # The strips are below the curves.
        height = min(_STRIP * rcParams["font.size"] / points_of(ax)[1], _ALL / (m + 1))
        stretched = 1 / (1 - height * (m + 1))
        ends = ax.transAxes.transform([(0, 1 - stretched)])
        ax.update_datalim(ax.transData.inverted().transform(ends), updatex=False)
    for j in range(m):
        starts, widths, held = spans(ts, modes[:, j], met.ts[met.members[:, j]])
        for mode, (_, color) in BANDS.items():
            ax.broken_barh(
                list(zip(starts[held == mode], widths[held == mode], strict=True)),
                (j * height, height),
                transform=ax.get_xaxis_transform(),
                facecolor=color,
                alpha=0.5 if m == 1 else 1.0,
                linewidth=0,
            )
        if m > 1:
            edge = {"color": BLACK, "linewidth": 0.8, "transform": ax.transAxes}
            ax.plot([0, 1], [(j + 1) * height] * 2, **edge)
            ax.annotate(
                f"H{subscript(j)}",
                (1, (j + 0.5) * height),
                (2, 0),
                xycoords="axes fraction",
                textcoords="offset points",
                verticalalignment="center",
                fontsize="small",
            )
    entries = [
        Patch(facecolor=color, alpha=0.5, edgecolor=BLACK, linewidth=0.5, label=label)
        for mode, (label, color) in BANDS.items()
        if (modes == mode).any()
    ]
    return entries, height * (m + 1) if m > 1 else 0.0
