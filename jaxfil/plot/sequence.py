"""A branch of orbits with every bifurcation on it, each named and numbered."""

from typing import Any

from matplotlib.axes import Axes

from jaxfil.bifurcations.sequence import BifurcationSequence
from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.model.labels import labels_of
from jaxfil.plot.canvas import BLACK, own_axes
from jaxfil.plot.kinds import KINDS
from jaxfil.plot.legend import legend
from jaxfil.plot.orbits import curves_of, draw_stability, height


@draws(BifurcationSequence)
def bifurcation_sequence(
    found: BifurcationSequence,
    ax: Axes | None = None,
    component: int = 0,
    extremes: bool = False,
    **style: Any,
) -> Axes:
    """Draw a branch of orbits and its bifurcations, a mark for each kind and a number for each one.

    The legend has the name and the value of each number.

    **Arguments**

    - `found`: a `BifurcationSequence`.
    - `ax`: the axes to draw on; by default new ones.
    - `component`: the component of the state to draw, from 0.
    - `extremes`: draw its smallest and largest value on the orbit instead of its value at t0.
    - `style`: matplotlib's keywords of the branch's lines, as `color` or `lw`.

    **Returns** the matplotlib axes.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=11.5)
    >>> orbit = jf.periodic_orbit(belt, jnp.array([0.1, 0.0]))
    >>> found = jf.find_bifurcations(belt, "omega", orbit, stop=10.5)
    >>> ax = jf.plot.bifurcation_sequence(found, jf.plot.page().add_subplot())
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['stable', '1: grazing-sliding, 10.905']
    """
    check.instance("found", found, BifurcationSequence)
    branch = found.branch
    ax = own_axes(ax)
    curves, wording = curves_of(branch, component, extremes)
    for curve in curves:
        draw_stability(ax, branch, curve, style)
        for i, (b, index) in enumerate(zip(found, found.indices, strict=True), start=1):
            marker, color = KINDS.get(str(b.kind), KINDS["undecided"])
            value = float(b.value)
            at = value, height(branch, curve, value, index)
            label = f"{i}: {b.kind}, {value:.6g}"
            ax.plot(*at, marker, color=color, markeredgecolor=BLACK, label=label)
            # Labels of neighbours alternate above and below.
            side = 1 if i % 2 else -1
            va = "bottom" if side > 0 else "top"
            ax.annotate(str(i), at, (0, 4 * side), textcoords="offset points", ha="center", va=va)
    labels = labels_of(branch.orbits.system, branch.orbits.x0.shape[-1])
    ax.set_xlabel(labels.parameter(branch.parameter))
    ax.set_ylabel(labels.component(component, wording))
    legend(ax)
    return ax
