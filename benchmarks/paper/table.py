"""The table beside a figure: what was found enters as rows, a text leaves."""

from typing import NamedTuple

import numpy as np

from benchmarks.table import Column, table

WIDTHS = {"what": 44, "paper": 18, "jaxfil": 22, "reference": 20, "why": 48}
HEADINGS = ("quantity", "paper prints", "jaxfil finds", "reference", "why they differ")


class Row(NamedTuple):
    """A quantity: what the paper prints, what was found, an independent reference (physics worked
    out apart from this library), and why they differ. `digits` are those of found numbers."""

    what: str
    paper: str
    found: float | complex | str
    reference: float | complex | str = ""
    why: str = ""
    digits: int = 13


def told(value, digits):
    """A number with its digits; text as it is."""
    if isinstance(value, str):
        return value
    if np.iscomplexobj(value):
        return f"{value.real:.{digits}g} ± {abs(value.imag):.{digits}g}i"
    return f"{value:.{digits}g}".replace("inf", "∞").replace("-", "−")


def layout(title, rows):
    """A title and rows as a table of text whose cells wrap."""
    columns = [Column(h, width=w) for h, w in zip(HEADINGS, WIDTHS.values(), strict=True)]
    return table(columns, map(cells, rows), title) + "\n"


def cells(row):
    """The texts of a row."""
    numbers = (told(row.found, row.digits), told(row.reference, 16))
    return (row.what, row.paper, *numbers, row.why)
