"""The legend of axes, in a place where it covers nothing."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.legend import Legend
from matplotlib.path import Path
from matplotlib.transforms import Bbox, offset_copy

# The largest width of a legend beside axes, relative to theirs, and the largest part of the height
# at which a legend is within.
_BESIDE, _INSIDE = 0.6, 0.5


def legend(ax: Axes, more: Iterable[Artist] = (), below: float = 0.0, **options: Any) -> None:
    """A legend with one entry for each label, however often it was drawn, after the entries `more`;
    omitted without labels.

    Where no place within the axes is free, the upper limit is raised to make one, and the part
    `below` of the height is preserved at the lower end; a legend that would need most of the height
    is outside. Call it last, since the labels of axes affect their size.
    """
    entries = _entries(ax, more)
    if not entries[0]:
        return
    drawn = ax.legend(*entries, **{"loc": "best", **options})  # by default it warns when slow
    if not ax.get_autoscaley_on() or ax.name == "3d":
        return
    page: Any = ax.figure.figure  # also for axes in a subfigure
    if (engine := page.get_layout_engine()) is not None:
        engine.execute(page)
    if not _covered(ax, drawn):
        return
    drawn = _in_columns(ax, entries, 0.95 * ax.bbox.width, **options | {"loc": "upper right"})
    part = (ax.bbox.y1 - drawn.get_window_extent().padded(3).y0) / ax.bbox.height
    if part + below > _INSIDE and engine is not None:
        legend_outside(ax, more)
    else:
        _reserve(ax, below, min(part, 0.6 - below))


def legend_outside(ax: Axes, more: Iterable[Artist] = ()) -> None:
    """A legend to the right of axes, or below the label of narrow ones."""
    entries = _entries(ax, more)
    drawn = ax.legend(*entries, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    if drawn.get_window_extent().width < _BESIDE * ax.bbox.width:
        return
    label = ax.xaxis.get_tightbbox()
    figure: Any = ax.figure
    gap = 0.0 if label is None else (label.y0 - ax.bbox.y0) / figure.dpi
    place = offset_copy(ax.transAxes, figure, y=gap - 0.05)
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "bbox_transform": place}
    small = {"fontsize": "small", "columnspacing": 1.0, "frameon": False}
    _in_columns(ax, entries, 1.15 * ax.bbox.width, **below, **small)


def _entries(ax: Axes, more: Iterable[Artist] = ()) -> tuple[list[Artist], list[str]]:
    """Artists and their labels, each label once."""
    found = {handle.get_label(): handle for handle in more}
    for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
        found.setdefault(label, handle)
    return list(found.values()), [str(label) for label in found]


def _in_columns(
    ax: Axes, entries: tuple[list[Artist], list[str]], width: float, **options: Any
) -> Legend:
    """A legend of as many columns as fit into a width."""
    columns = len(entries[0])
    drawn = ax.legend(*entries, ncols=columns, **options)
    while columns > 1 and drawn.get_window_extent().width >= width:
        columns -= 1
        drawn = ax.legend(*entries, ncols=columns, **options)
    return drawn


def _covered(ax: Axes, drawn: Legend) -> bool:
    """Whether a legend lies on a line, a mark or a text."""
    ax.get_ylim()  # matplotlib computes automatic limits of both axes only when asked for them
    box = drawn.get_window_extent().padded(2)
    if any(box.overlaps(text.get_window_extent()) for text in ax.texts if text.get_visible()):
        return True
    marks = [xy for c in ax.collections if len(xy := np.ma.asarray(c.get_offsets())) > 1]
    if any(_within(box, ax.transData.transform(np.ma.filled(xy, np.nan))) for xy in marks):
        return True
    # Lines across the whole axes, such as zero, may pass beneath.
    for line in ax.lines:
        if line.get_transform() in (ax.transData, ax.transAxes):
            points = line.get_transform().transform(line.get_xydata())
            stroke = line.get_linestyle() not in ("None", "none", "")
            if _within(box, points) or (stroke and _crosses(box, points)):
                return True
    return False


def _within(box: Bbox, points: np.ndarray) -> bool:
    """Whether one of the points (k, 2) is in a box."""
    return bool(np.any(np.all((box.min <= points) & (points <= box.max), axis=1)))


def _crosses(box: Bbox, points: np.ndarray) -> bool:
    """Whether a line through points (k, 2), broken at NaN, enters a box."""
    if len(points) < 2:
        return False
    return Path(points).cleaned(remove_nans=True).intersects_bbox(box, filled=False)


def _reserve(ax: Axes, below: float, above: float) -> None:
    """Extend automatic limits so that parts of the height at the upper and lower end remain free,
    the lower one already being so."""
    stretch = (1 - below) / (1 - below - above)
    ends = [(0, below + (1 - below) * stretch)]
    if below:
        ends.append((0, below - below * stretch))
    # As data, so that the limits also remain when more is drawn.
    ax.update_datalim(
        ax.transData.inverted().transform(ax.transAxes.transform(ends)), updatex=False
    )
    ax.autoscale_view(scalex=False)
