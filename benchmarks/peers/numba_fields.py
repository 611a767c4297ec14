"""The two scenes as scalar numba functions, and a smooth step written out from a tableau.

In: a scene's kind and a tableau (A, b, c). Out: the handful of compiled functions that the event
loop in `numba_scalar` is built from. `p` is the scene's tuple of constants and `s` the side, +-1;
in a slide (s = 0) only `hold` and `slide` are asked.
"""

import math

import numba
import numpy as np
from numba.core.codegen import get_host_cpu_features

from .tableaus import TABLEAUS, written_out

# Vectors as wide as the machine has them, which LLVM does not take unasked.
numba.config.CPU_FEATURES = get_host_cpu_features() + ",-prefer-256-bit"

njit = numba.njit(fastmath=True)
# Without inf and nan, but in the written order: regrouping would undo the reduction of the angle.
exact = numba.njit(fastmath={"nnan", "ninf", "nsz", "contract"})

COSINE = tuple((-1) ** k / math.factorial(2 * k) for k in range(11))


@exact
def cosine(x):
    """cos x to 1e-16 for a phase of a few turns, without the call that numba's would cost."""
    turns = np.rint(x * (1 / math.pi))
    r = (x - turns * math.pi) - turns * 1.2246467991473532e-16  # pi in two pieces
    sign = 1 - 2 * (turns - 2 * np.floor(0.5 * turns))
    z = r * r
    value = COSINE[10]
    for k in range(9, -1, -1):  # unrolled by the compiler: the tuple is a constant
        value = value * z + COSINE[k]
    return sign * value


@njit
def belt_field(force, x1, x2, s, p):
    """Slope of the belt oscillator on side s; `force` is f0 cos(omega t)."""
    _, grip, damp, cubic, g1, g2, v = p
    u = x2 - v
    return x2, force + u * (damp - cubic * u * u) - x1 * (g1 + g2 * x1 * x1) - s * grip


@njit
def belt_height(x1, x2, d1, d2, p):
    """H and dH/dt from a state and its slope."""
    return x2 - p[6], d2


@njit
def belt_place(x1, x2, p):
    """The state moved onto the surface along the one component that H reads."""
    return x1, p[6]


@njit
def belt_hold(omega, t, x1, x2, p):
    """On the surface: the push across it, its rate along a stick, the grip against it."""
    f0, grip, _, _, g1, g2, v = p
    phase = omega * t
    push = f0 * np.cos(phase) - x1 * (g1 + g2 * x1 * x1)
    return push, -f0 * omega * np.sin(phase) - (g1 + 3 * g2 * x1 * x1) * v, grip


@njit
def belt_slide(x1, h, p):
    """A stick of length h: the mass moves with the belt."""
    return x1 + p[6] * h


@njit
def sd_field(force, x1, x2, s, p):
    """Slope of the SD oscillator at alpha = 0 on side s."""
    return x2, force - 2 * p[1] * x2 - x1 + s


@njit
def sd_height(x1, x2, d1, d2, p):
    """H and dH/dt from a state and its slope."""
    return x1, x2


@njit
def sd_place(x1, x2, p):
    """The state moved onto the surface."""
    return 0.0, x2


@njit
def sd_hold(omega, t, x1, x2, p):
    """No grip: every contact crosses, the way that x2 points."""
    return x2, 0.0, 0.0


@njit
def sd_slide(x1, h, p):
    """Never asked: nothing sticks."""
    return x1


FIELDS = {
    "belt": (belt_field, belt_height, belt_place, belt_hold, belt_slide),
    "sd": (sd_field, sd_height, sd_place, sd_hold, sd_slide),
}


def step_source(tableau):
    """The text of one step, unrolled, with the coefficients as literals.

    Entering: the state at t and its slope, which is the first stage. Leaving: both at t + h. Stages
    at one and the same time share a cosine.
    """
    lines = written_out(
        tableau,
        "    {force} = f0 * cos(omega * (t + {node} * h))",
        [
            "    y1 = x1 + h * ({first})",
            "    y2 = x2 + h * ({second})",
            "    k{i}1, k{i}2 = field({force}, y1, y2, s, p)",
        ],
        [
            "    y1 = x1 + h * ({first})",
            "    y2 = x2 + h * ({second})",
            "    d1, d2 = field({force}, y1, y2, s, p)",
        ],
    )
    head = ["def step(omega, t, h, x1, x2, k01, k02, s, p):", "    f0 = p[0]"]
    return "\n".join([*head, *lines, "    return y1, y2, d1, d2"])


def compile_step(kind, method):
    """The compiled step of one method for one scene."""
    names = {"field": FIELDS[kind][0], "cos": cosine}
    exec(step_source(TABLEAUS[method]), names)
    return njit(names["step"])
