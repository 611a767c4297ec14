"""Explicit Runge–Kutta methods as tableaus (A, b, c), and the sums of their stages as text.

In: a row of coefficients. Out: the sum that Python and C++ both read. SciPy has the numbers.
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


def weighted(coefficients, component):
    """The sum of coefficients times slopes k{stage}{component}, zeros left out."""
    used = [(a, j) for j, a in enumerate(coefficients) if a]
    return " + ".join(f"{float(a)!r} * k{j}{component}" for a, j in used)
