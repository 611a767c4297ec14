"""Tables of text: columns and rows of values enter, one text leaves."""

import itertools
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple


class Column(NamedTuple):
    """A heading, and how the cells below it are written.

    `form` is Python's format of a number, alignment included, such as ">,.0f"; text stands as it
    is, and None as an empty cell. With a `width`, longer cells wrap.
    """

    heading: str
    form: str = "<"
    width: int | None = None

    def cell(self, value: Any) -> str:
        """The text of a value."""
        if value is None:
            return ""
        return value if isinstance(value, str) else format(value, self.form)

    def lines(self, cell: str) -> list[str]:
        """The lines that a cell takes."""
        return [cell] if self.width is None else textwrap.wrap(cell, self.width)

    def padded(self, line: str, width: int) -> str:
        """A line of a cell as wide as the column."""
        return line.rjust(width) if self.form.startswith(">") else line.ljust(width)


def table(
    columns: Sequence[Column], rows: Iterable[Sequence[Any]], title: str = "", note: str = ""
) -> str:
    """The title, the rows below their headings and a rule, and the note, a blank line between."""
    body = [[c.cell(v) for c, v in zip(columns, row, strict=True)] for row in rows]
    cells = [[c.heading for c in columns], *body]
    longest = [max(map(len, column)) for column in zip(*cells, strict=True)]
    widths = [c.width or size for c, size in zip(columns, longest, strict=True)]
    head, *rest = [_row(columns, widths, row) for row in cells]
    rule = "  ".join("-" * width for width in widths)
    return "\n\n".join(filter(None, [title, "\n".join([head, rule, *rest]), note]))


def _row(columns: Sequence[Column], widths: Sequence[int], cells: Sequence[str]) -> str:
    """One row, of as many lines as its longest cell takes."""
    wrapped = [column.lines(cell) for column, cell in zip(columns, cells, strict=True)]
    lines = []
    for parts in itertools.zip_longest(*wrapped, fillvalue=""):
        padded = [c.padded(p, w) for c, p, w in zip(columns, parts, widths, strict=True)]
        lines.append("  ".join(padded).rstrip())
    return "\n".join(lines)
