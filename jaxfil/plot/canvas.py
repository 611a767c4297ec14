"""Pages, axes and colours of pictures.

The colours are from M. Okabe and K. Ito, Color Universal Design (2008), for colour-blind readers.
"""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cbook import normalize_kwargs
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import ListedColormap, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Annotation

from jaxfil.model.labels import Labels

BLACK, GREY, WHITE = "#000000", "#999999", "#FFFFFF"
BLUE, VERMILLION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, YELLOW = "#E69F00", "#56B4E9", "#F0E442"
COLORS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)

# For `matplotlib.rc_context`: text of 8 points, matching lines and marks, and fonts of type 42 that
# publishers accept, for pages at their printed width.
PRINT = MappingProxyType(
    {
        "font.size": 8.0,
        "axes.titlesize": "medium",
        "figure.titlesize": "medium",
        "legend.fontsize": "medium",
        "legend.handlelength": 1.5,
        "legend.borderpad": 0.3,
        "legend.labelspacing": 0.3,
        "axes.linewidth": 0.6,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "xtick.minor.width": 0.4,
        "ytick.minor.width": 0.4,
        "xtick.major.size": 2.5,
        "ytick.major.size": 2.5,
        "xtick.minor.size": 1.5,
        "ytick.minor.size": 1.5,
        "lines.linewidth": 1.0,
        "lines.markersize": 4.0,
        "pdf.fonttype": 42,
        "savefig.dpi": 300.0,
    }
)


def page(width: float = 203.2, height: float | None = None) -> Figure:
    """An empty figure without a window, for a picture in a file.

    Print it at its own width; journals have columns of 84 to 90 mm and pages of 174 to 180 mm.
    Drawn within `matplotlib.rc_context(jaxfil.plot.PRINT)`, its text has 8 points there.

    **Arguments**

    - `width`: width in millimetres; by default 8 inches.
    - `height`: height in millimetres; by default 5/8 of the width.

    **Returns** a `matplotlib.figure.Figure` of 200 dots per inch: add axes with `add_subplot`, and
    write it with `savefig`.

    >>> import matplotlib
    >>> import jaxfil as jf
    >>> with matplotlib.rc_context(jf.plot.PRINT):
    ...     page = jf.plot.page(84)
    ...     ax = page.add_subplot()
    ...     label = ax.set_xlabel("t")
    >>> page.get_size_inches().round(2).tolist(), label.get_fontsize()
    ([3.31, 2.07], 8.0)
    """
    # Without pyplot, which retains every figure until it is closed and may open a display.
    inches = np.array([width, 5 / 8 * width if height is None else height]) / 25.4
    return Figure(figsize=tuple(inches), dpi=200, layout="constrained")


def own_axes(ax: object, projection: str | None = None) -> Axes:
    """The given axes, or new ones, checked for the projection."""
    if isinstance(ax, Axes):
        if projection is not None and ax.name != projection:
            raise ValueError(f'`ax` must have projection="{projection}", got "{ax.name}".')
        return ax
    if ax is not None:
        raise ValueError(f"`ax` must be matplotlib axes or None, got {type(ax).__name__}.")
    import matplotlib.pyplot as plt  # opens a display, so only if axes are not given

    return plt.subplots(layout="constrained", subplot_kw={"projection": projection})[1]


def styled(given: dict[str, Any], **ours: Any) -> dict[str, Any]:
    """Keywords of a line, where given ones, under their long names (`linewidth` for `lw`), replace
    ours."""
    return {**ours, **normalize_kwargs(given, Line2D)}


class Heading(Annotation):
    """A title over the left end of axes, shown while they have no title of the caller's."""

    def __init__(self, ax: Axes, text: str) -> None:
        at: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points"}
        super().__init__(text, (0, 1), (0, 6), va="bottom", fontsize="medium", **at)
        ax.add_artist(self)
        self.set_clip_on(False)
        self._titled = ax

    def get_visible(self) -> bool:
        """Whether the axes have no other title."""
        titles = (self._titled.get_title(loc) for loc in ("left", "center", "right"))
        return super().get_visible() and not any(titles)


def color_bar(
    ax: Axes, picture: ScalarMappable, colorbar: bool | Axes, **options: Any
) -> Colorbar | None:
    """The scale of a picture's colours next to it, or in the given axes; None if `colorbar` is
    False."""
    if isinstance(colorbar, Axes):
        return ax.figure.colorbar(picture, cax=colorbar, **options)
    if not isinstance(colorbar, bool):
        raise ValueError(
            "`colorbar` must be True, False or the matplotlib axes to draw it in, got "
            f"{type(colorbar).__name__}."
        )
    return ax.figure.colorbar(picture, ax=ax, **options) if colorbar else None


def draw_cells(
    ax: Axes,
    axes: Sequence[np.ndarray],
    values: np.ndarray,
    styles: Mapping[int, tuple[str, str]],
    colorbar: bool | Axes,
) -> Colorbar | None:
    """A map of integers over two ascending axes, each with its colour and its words in the scale,
    which has only those that occur."""
    # The colours of all would fill the bar, but few occur.
    seen = [value for value in styles if (values == value).any()]
    picture = ax.pcolormesh(
        *axes,
        # The index of each value among the occurring ones, which selects its colour.
        np.argmax(values[..., None] == np.array(seen), axis=-1),
        cmap=ListedColormap([styles[value][0] for value in seen]),
        vmin=-0.5,
        vmax=len(seen) - 0.5,
        shading="nearest",
        rasterized=True,
    )
    bar = color_bar(ax, picture, colorbar, ticks=range(len(seen)))
    if bar is not None:
        bar.set_ticklabels([styles[value][1] for value in seen])
        bar.ax.tick_params(length=0)
    return bar


def name_components(ax: Axes, labels: Labels, shown: Iterable[int]) -> None:
    """The names of the drawn components along the axes, of two or three dimensions."""
    for name, c in zip("xyz", shown, strict=False):
        getattr(ax, f"set_{name}label")(labels.component(c))


def shades(count: int) -> list[str]:
    """`count` different colours: `COLORS`, then lighter and darker ones; more than three times as
    many are spread over a spectrum."""
    if count > 3 * len(COLORS):
        from matplotlib import colormaps

        return [to_hex(color) for color in colormaps["turbo"](np.linspace(0.05, 0.95, count))]
    rgb = np.array([to_rgb(color) for color in COLORS])
    every = np.concatenate([rgb, 0.45 * rgb + 0.55, 0.55 * rgb])
    return [to_hex(color) for color in every[:count]]


def subscript(i: int) -> str:
    """A number below the line: ₁₂."""
    return str(i).translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


def marker_size(ax: Axes, columns: int) -> float:
    """The width of a column of samples in points, from 0.8 up to three."""
    # Markers as wide as a column have no gap and no overlap; thinner ones vanish on paper.
    return float(np.clip(points_of(ax)[0] / columns, 0.8, 3.0))


def points_of(ax: Axes) -> np.ndarray:
    """The width and the height of axes in points."""
    box = ax.get_window_extent().transformed(ax.figure.dpi_scale_trans.inverted())
    return 72 * np.array([box.width, box.height])
