"""Sliders of parameters over a motion, for a notebook.

One program is compiled, with the parameters as array arguments.
"""

import importlib
import inspect
import io
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

import diffrax
import equinox as eqx
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave

from jaxfil.integrate.run.solution import Solution
from jaxfil.integrate.run.solve import solve
from jaxfil.integrate.run.step_choice import StepLength
from jaxfil.integrate.steppers.explicit import Stepper
from jaxfil.model import check
from jaxfil.model.labels import labels_of
from jaxfil.model.outcomes import is_good, outcome_names
from jaxfil.model.parameter import cast, get_parameter, replace_parameters, scalar_parameters
from jaxfil.model.system import System
from jaxfil.model.types import Scalar, State, Widget
from jaxfil.plot.canvas import VERMILLION
from jaxfil.plot.portrait import phase_portrait

# Number of steps of a slider.
_POSITIONS = 200


def explore(
    system: System,
    ranges: Mapping[str, tuple[float, float]],
    x0: State,
    t0: Scalar,
    t1: Scalar,
    dt: StepLength,
    picture: Callable[..., Any] = phase_portrait,
    figure: Figure | None = None,
    stepper: Stepper | None = None,
    **options: Any,
) -> Widget:
    """Sliders of parameters above the motion from one state, redrawn as they move.

    Parameters are arrays in the program. It is compiled for the first picture, and moving a slider
    does not recompile. A motion that ends early is drawn up to its end, with its outcome.

    **Arguments**

    - `system`: the `System`.
    - `ranges`: the least and the greatest value of each parameter by its name. A slider starts at
      the system's value, or at the nearer end.
    - `x0`, `t0`, `t1`, `dt`, `stepper`: as in `jaxfil.solve`. Every step is drawn.
    - `picture`: a function of this module that draws a `Solution`, as `time_history`; by default
      `phase_portrait`. It is called with the solution and the axes, and with the system if it has
      an argument `system`.
    - `figure`: the matplotlib figure to draw on, which is cleared; by default one of
      550 × 360 pixels with fixed margins, which is drawn in half the time of a `page`.
    - `options`: further arguments of `picture`, as `components` or `lw`.

    **Returns** an `ipywidgets.VBox`: a slider for each parameter, in their order, and the picture.

    **Errors**: `ImportError` without ipywidgets; `ValueError` names an unknown parameter or an
    invalid range.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> box = jf.plot.explore(
    ...     jf.systems.CoulombOscillator(), {"friction": (0.1, 1.0)}, jnp.array([3.0, 0.0]), 0.0,
    ...     14.0, 0.1, jf.plot.time_history, stepper=jf.RK4(), components=1)
    >>> friction, image = box.children
    >>> friction.description, friction.value
    ('F', 0.4)
    >>> before = image.value
    >>> friction.value = 0.8
    >>> image.value == before
    False
    """
    widgets = _ipywidgets()
    x = check.state("x0", x0)
    check.system("system", system)
    if not callable(picture):
        raise ValueError(f"`picture` must be a function of jaxfil.plot, got {picture!r}.")
    system = cast(system, x.dtype)  # so that every parameter is an argument of the program
    names = scalar_parameters(system, tuple(ranges))
    labels = labels_of(system, x.shape[0])
    sliders = [
        widgets.FloatSlider(**_positions(system, name, ranges[name]), description=told)
        for name, told in zip(names, map(labels.parameter, names), strict=True)
    ]
    figure = _page() if figure is None else figure
    image = widgets.Image(format="png")
    how = {"stepper": stepper, "saveat": diffrax.SaveAt(t0=True, steps=True), "throw": False}
    run = eqx.filter_jit(lambda system: solve(system, x, t0, t1, dt, **how))

    def redraw(_: object = None) -> None:
        here = replace_parameters(system, names, [slider.value for slider in sliders])
        _draw(figure, picture, run(here), here, options)
        image.value = _png(figure)

    redraw()
    for slider in sliders:
        slider.observe(redraw, "value")
    return widgets.VBox([*sliders, image])


def _ipywidgets() -> ModuleType:
    try:
        return importlib.import_module("ipywidgets")
    except ImportError as error:
        raise ImportError(
            "Sliders need the package ipywidgets: pip install 'jaxfil[notebooks]'."
        ) from error


def _page() -> Figure:
    """A page with fixed margins, because computing them takes as long as drawing a frame."""
    figure = Figure(figsize=(5.5, 3.6), dpi=100)
    figure.subplots_adjust(left=0.13, right=0.9, bottom=0.15, top=0.95)
    return figure


def _positions(system: System, name: str, ends: Any) -> dict[str, Any]:
    """The range, the initial value and the step of a slider."""
    limits = np.asarray(ends)
    real = limits.dtype.kind in "fiu" and limits.shape == (2,) and np.isfinite(limits).all()
    if not real or limits[0] >= limits[1]:
        raise ValueError(f"`ranges[{name!r}]` must be (low, high) with low < high, got {ends!r}.")
    low, high = map(float, limits)
    value = float(np.clip(float(get_parameter(system, name)), low, high))
    step = (high - low) / _POSITIONS
    return {"value": value, "min": low, "max": high, "step": step, "readout_format": ".4g"}


def _draw(
    figure: Figure,
    picture: Callable[..., Any],
    sol: Solution,
    system: System,
    options: dict[str, Any],
) -> None:
    """The picture of a motion, alone on its figure, with its outcome if it ended early."""
    figure.clear()
    space = np.size(options.get("components", ())) == 3
    ax = figure.add_subplot(projection="3d" if space else None)
    if "system" in inspect.signature(picture).parameters:
        options = {"system": system} | options
    if np.isfinite(np.asarray(sol.ts)).sum() > 1:  # otherwise it ended at its start
        picture(sol, ax, **options)
    if not is_good(sol.result):
        told = f"{outcome_names(sol.result)} at t = {float(sol.t_final):.4g}"
        ax.annotate(told, (0.02, 0.98), xycoords="axes fraction", va="top", color=VERMILLION)


def _png(figure: Figure) -> bytes:
    canvas, pixels = FigureCanvasAgg(figure), io.BytesIO()
    canvas.draw()  # once; `savefig` would draw it twice
    # A frame is shown briefly: fast compression matters more than size.
    imsave(pixels, canvas.buffer_rgba(), format="png", pil_kwargs={"compress_level": 1})
    return pixels.getvalue()
