"""The paper on which the figures are drawn: sizes, colours and marks that all of them share.

Millimetres, axes and samples enter; an empty figure, axes drawn on, and files leave. A colour means
one kind of motion in every figure: see `SLIPS`, and `PAPER` for what the paper prints.
"""

import io

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxfil.plot import PRINT
from jaxfil.plot.canvas import (
    BLACK as BLACK,
    BLUE as BLUE,
    GREEN as GREEN,
    GREY as GREY,
    ORANGE as ORANGE,
    PURPLE as PURPLE,
    SKY as SKY,
    VERMILLION as VERMILLION,
    WHITE as WHITE,
)

# The widths of a page and of a column, in millimetres.
PAGE, COLUMN = 174, 84
# Where something is marked that the paper prints and jaxfil does not find there.
PAPER = {"color": VERMILLION, "lw": 0.8, "ls": (0, (4, 2))}
# On either side of a surface, and on it.
SLIPS = {-1: BLUE, 1: VERMILLION, 0: ORANGE}
DOTS = {"linestyle": "none", "marker": "o", "markeredgewidth": 0, "rasterized": True}
PIXELS = 220  # per inch


def canvas(width, height):
    """An empty figure of that many millimetres."""
    return Figure(figsize=(width / 25.4, height / 25.4), dpi=PIXELS, layout="constrained")


def style():
    """A context in which text has 8 points: figures are drawn and written in it."""
    return matplotlib.rc_context(dict(PRINT))


def save(figure, path):
    """Write `path` with .png, in 256 colours, and with .pdf."""
    FigureCanvasAgg(figure)
    pixels = io.BytesIO()
    figure.savefig(pixels, format="png", dpi=PIXELS)
    few = Image.open(pixels).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    few.save(path.with_suffix(".png"), optimize=True, dpi=(PIXELS, PIXELS))
    # Without its date a figure drawn again is the same file.
    figure.savefig(path.with_suffix(".pdf"), dpi=PIXELS, metadata={"CreationDate": None})


def entitle(ax, text):
    """A panel's title, on the left."""
    ax.set_title(text, loc="left")


def dots(ax, values, samples, **style):
    """Every sample (p, samples) above its value (p,)."""
    xs = values[:, None] + 0 * samples
    ax.plot(xs.ravel(), samples.ravel(), **{**DOTS, "color": BLACK, "markersize": 0.7, **style})


def below(figure, handles, columns):
    """A legend below all panels, where it covers none of them."""
    labels = [handle.get_label() for handle in handles]
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
