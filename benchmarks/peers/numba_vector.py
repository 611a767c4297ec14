"""What an expert writes with numba who wants the processor's vectors: lanes in blocks.

In: a scene, frequencies, a method and its steps per period. Out: sampled states. Every lane of a
block takes the next grid step as if it met nothing, in one loop that the compiler vectorises. Then
the few that did meet something, or stick, take that step again one by one, as `numba_scalar` does.
"""

import functools

import numpy as np

from . import numba_fields, numba_scalar
from .numba_scalar import SETTINGS, SHAPED, effort, label, method, missing, prepare

__all__ = ["SETTINGS", "SHAPED", "effort", "label", "method", "missing", "prepare", "sample"]

NAME = "numba vector"
# Lanes of a block at most: twice as many as its numbers have room for in a first-level cache of
# 32 KiB, and the rate is the same; with 64 a step's call weighs as much as the step.
BLOCK = 512


def free_source(tableau):
    """The text of one grid step of a block of lanes that meet nothing, without a branch.

    Written out in one piece around `step_source`'s lines: a call in the loop, or a row of a matrix
    for each number, and the compiler leaves it scalar.
    """
    lines = numba_fields.step_source(tableau).splitlines()[2:-1]
    head = [
        "def free(omegas, hs, k, s0, a1, a2, b1, b2, g0, r0, c1, c2, e1, e2, g1, r1, free, p):",
        "    f0 = p[0]",
        "    for i in range(hs.shape[0]):",
        "        h = hs[i]; t = k * h; omega = omegas[i]; s = s0[i]",
        "        x1 = a1[i]; x2 = a2[i]; k01 = b1[i]; k02 = b2[i]",
    ]
    tail = [
        "        g, r = height(y1, y2, d1, d2, p)",
        "        g = s * g; r = s * r; third = h * (1 / 3)",
        "        c1[i] = y1; c2[i] = y2; e1[i] = d1; e2[i] = d2; g1[i] = g; r1[i] = r",
        "        inside = min(g0[i] + third * r0[i], g - third * r)",
        # A stick has s = 0: it is never free.
        "        free[i] = min(min(inside, g), abs(s) - 0.5)",
    ]
    return "\n".join([*head, *("    " + line for line in lines), *tail])


@functools.cache
def kernel(kind, method):
    """The compiled function of all lanes for one scene and method."""
    import numba

    njit = numba.njit(fastmath=True)
    begin, go = numba_scalar.loop_tools(kind, method)
    field, height = numba_fields.FIELDS[kind][:2]
    names = {"field": field, "height": height, "cos": numba_fields.cosine}
    exec(free_source(numba_fields.TABLEAUS[method]), names)
    free_step = njit(names["free"])

    @njit
    def mend(omega, h, k, s, a, c, free, p):
        """The lanes that were not free, one by one; `a` before the step, `c` after it."""
        for i in range(len(s)):
            if not free[i] >= 0.0:
                s[i], c[0][i], c[1][i], c[2][i], c[3][i], c[4][i], c[5][i] = go(
                    omega[i], h[i], k, k + 1,
                    s[i], a[0][i], a[1][i], a[2][i], a[3][i], a[4][i], a[5][i], p,
                )  # fmt: skip

    @njit
    def block(omega, h, steps, start, p, transient, samples, out):
        """Lanes side by side; time starts anew in each period, so that no digits are lost."""
        s, free = np.empty(len(omega)), np.empty(len(omega))
        a = (s.copy(), s.copy(), s.copy(), s.copy(), s.copy(), s.copy())
        c = (s.copy(), s.copy(), s.copy(), s.copy(), s.copy(), s.copy())
        for i in range(len(s)):
            s[i], a[0][i], a[1][i], a[2][i], a[3][i], a[4][i], a[5][i] = begin(
                omega[i], start[0], start[1], p
            )
        for j in range(transient + samples):
            for k in range(steps):
                free_step(
                    omega, h, k, s, a[0], a[1], a[2], a[3], a[4], a[5],
                    c[0], c[1], c[2], c[3], c[4], c[5], free, p,
                )  # fmt: skip
                mend(omega, h, k, s, a, c, free, p)
                a, c = c, a
            if j >= transient:
                for i in range(len(s)):
                    out[i, j - transient, 0] = a[0][i]
                    out[i, j - transient, 1] = a[1][i]

    @numba.njit(fastmath=True, parallel=True)
    def lanes(omegas, spans, size, steps, start, p, transient, samples, out):
        for number in numba.prange(len(omegas) // size):
            some = slice(number * size, (number + 1) * size)
            h = spans[some] / steps
            block(omegas[some].copy(), h, steps, start, p, transient, samples, out[some])

    return lanes


def sample(scene, omegas, transient, samples, setting, cores=1):
    """States at the end of the last `samples` periods, (lanes, samples, 2)."""
    asked = len(omegas)
    blocks = cores * -(-asked // (BLOCK * cores))
    # Blocks of one size, of whole vectors, and as many for each core.
    size = 8 * -(-asked // (8 * blocks))
    filled = blocks * size
    omegas = np.ascontiguousarray(omegas, dtype=float)[np.minimum(np.arange(filled), asked - 1)]
    spans = np.array([scene.period(omega) for omega in omegas])
    out = np.empty((filled, samples, 2))
    run = kernel(scene.kind, setting["method"])
    run(omegas, spans, size, setting["steps"], scene.x0, scene.constants(), transient, samples, out)
    return out[:asked]
