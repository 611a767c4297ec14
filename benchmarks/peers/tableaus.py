"""Explicit Runge–Kutta methods as tableaus (A, b, c), and their steps as text.

In: a tableau and the lines of a language. Out: one step written out. SciPy has the numbers.
"""

import numpy as np
from scipy.integrate import DOP853, RK45

RK4 = (
    np.array([[0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1.0, 0]]),
    np.array([1, 2, 2, 1]) / 6,
    np.array([0, 0.5, 0.5, 1.0]),
)
TABLEAUS = {
    "rk4": RK4,
    "dopri5": (RK45.A, RK45.B, RK45.C),
    "dop853": (DOP853.A[:12, :12], DOP853.B, DOP853.C[:12]),
}


def _weighted(coefficients, component):
    """The sum of coefficients times slopes k{stage}{component}, zeros left out."""
    used = [(a, j) for j, a in enumerate(coefficients) if a]
    return " + ".join(f"{float(a)!r} * k{j}{component}" for a, j in used)


def written_out(tableau, force, stage, end):
    """The lines of one step in a language whose lines these are: `force` for the forcing {force} at
    a {node} of the step, once for each, `stage` for number {i} and `end`, both with the {force} of
    their time and the sums {first} and {second} of the slopes of either component."""
    a, b, c = tableau
    lines, forces = [], {}

    def add(template, node, row, i=0):
        if node not in forces:
            forces[node] = f"w{len(forces)}"
            lines.append(force.format(force=forces[node], node=repr(float(node))))
        sums = dict(first=_weighted(row, 1), second=_weighted(row, 2))
        lines.extend(line.format(i=i, force=forces[node], **sums) for line in template)

    for i in range(1, len(c)):
        add(stage, c[i], a[i], i)
    add(end, 1.0, b)
    return lines
