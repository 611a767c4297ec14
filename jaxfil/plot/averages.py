"""An average of the lanes of a sweep, as a curve over one parameter or a map over two."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.plot.canvas import BLACK, color_bar, own_axes, styled
from jaxfil.plot.parameter_plane import label_plane, plane_of
from jaxfil.sweep.diagram import BifurcationDiagram


def averages(
    diagram: BifurcationDiagram,
    name: str | None = None,
    ax: Axes | None = None,
    component: int = 0,
    colorbar: bool | Axes = True,
    **style: Any,
) -> Axes:
    """Draw an average of each lane of a sweep over its parameter, or as a map over two.

    Failed lanes are omitted.

    **Arguments**

    - `diagram`: a `BifurcationDiagram` of `bifurcation_diagram(..., average=…)`, of one parameter
      or over a grid of two.
    - `name`: name of the average, by default the first; also the label of the axis: "power, W".
    - `ax`: the axes to draw on; by default new ones.
    - `component`: index into an average of several numbers, in C order.
    - `colorbar`: whether to draw the scale of colours beside a map, or the axes to draw it in.
    - `style`: matplotlib's keywords of the curve, as `color`, `lw` or `label`.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> diagram = jf.bifurcation_diagram(
    ...     jf.systems.SDOscillator(), ("omega", "f0"),
    ...     (jnp.array([0.5, 0.6]), jnp.array([0.2, 0.25])), jnp.array([1.0, 0.0]), transient=20,
    ...     samples=8, progress=False, average={"rms of x": jf.RMS(lambda t, x, side: x[0])})
    >>> ax = jf.plot.averages(diagram, "rms of x", jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel(), ax.figure.axes[1].get_ylabel()
    ('Ω', 'f₀', 'rms of x')
    """
    check.instance("diagram", diagram, BifurcationDiagram)
    known = diagram.averages or {}
    if not known:
        raise ValueError(
            "`diagram` must have averages, by its argument `average`, got one without."
        )
    name = check.one_of("name", next(iter(known)) if name is None else name, tuple(known))
    lanes = diagram.successful.shape
    numbers = known[name].reshape(*lanes, -1)
    column = numbers[..., check.component("component", component, numbers.shape[-1])]
    label = name if numbers.shape[-1] == 1 else f"{name}[{component}]"
    if isinstance(diagram.parameter, str):
        ax, values = own_axes(ax), np.asarray(diagram.values)
        order = np.argsort(values)
        ax.plot(values[order], column[order], **styled(style, color=BLACK))
        ax.set_xlabel(diagram.labels.parameter(diagram.parameter))
        ax.set_ylabel(label)
        return ax
    axes, place = plane_of(diagram)
    ax, shown = own_axes(ax), np.ma.masked_invalid(column[place].T)
    picture = ax.pcolormesh(*axes, shown, shading="nearest", rasterized=True, cmap="viridis")
    color_bar(ax, picture, colorbar, label=label)
    label_plane(ax, diagram)
    return ax
