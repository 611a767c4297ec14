"""Tables as text: a head and rows of cells enter, aligned lines leave."""


def table(head, rows, right=()):
    """Columns as wide as their widest cell; those numbered in `right` end at the same place."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = []
    for cells in [head, ["-" * w for w in widths], *rows]:
        pairs = enumerate(zip(cells, widths, strict=True))
        line = "  ".join(c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in pairs)
        lines.append(line.rstrip())
    return "\n".join(lines)
