"""The affine fields of a relay system: on every side, and where it slides.

    x' = A x + b + Σ_j s_j (c_j + g_j H_j),   s_j = sgn H_j,   H_j = n_j·x - d_j

A system and a mode (a side or 0, slid on, for each surface) enter; a matrix Z with z' = Z z, z =
(x, 1), leaves, and the rows of the weights w_J that replace s_J where the motion slides on a set J
of surfaces: there H_J = 0, and n_J·x' = 0 is linear in them.
"""

from typing import NamedTuple

import numpy as np

from tests.oracles.polynomials import REAL


class Relays(NamedTuple):
    """The arrays of a system with n states and m surfaces, a row each."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    g: np.ndarray
    n: np.ndarray
    d: np.ndarray


class Degenerate(Exception):
    """A sliding motion that is not defined: its weights have no single solution."""


def real(system: Relays) -> Relays:
    """The same in extended precision."""
    return Relays(*(np.asarray(v, REAL) for v in system))


def side_field(system: Relays, mode):
    """(A, b) of the affine field with the terms of the surfaces slid on left out."""
    a, b = system.a.copy(), system.b.copy()
    for s, c, g, n, d in zip(mode, system.c, system.g, system.n, system.d, strict=True):
        if s != 0:
            a += s * np.outer(g, n)
            b += s * (c - g * d)
    return a, b


def inverse(matrix):
    """The inverse of a matrix of up to three rows that is regular relative to its entries."""
    if len(matrix) == 1:
        adjugate = np.ones((1, 1), REAL)
    elif len(matrix) == 2:
        (p, q), (r, s) = matrix
        adjugate = np.asarray([[s, -q], [-r, p]])
    else:
        u, v, w = matrix
        adjugate = np.stack([np.cross(v, w), np.cross(w, u), np.cross(u, v)], axis=1)
    det = matrix[0] @ adjugate[:, 0]
    if abs(det) <= 1e-9 * abs(matrix).max() ** len(matrix) or abs(det) < 1e-9:
        raise Degenerate
    return adjugate / det


def mode_field(system: Relays, mode):
    """(Z, W): z' = Z z, and the rows of W z are the weights of the surfaces slid on, in order."""
    a, b = side_field(system, mode)
    z = np.zeros((len(b) + 1,) * 2, REAL)
    z[:-1, :-1], z[:-1, -1] = a, b
    slid = [j for j, s in enumerate(mode) if s == 0]
    if not slid:
        return z, np.zeros((0, len(b) + 1), REAL)
    weights = -inverse(system.n[slid] @ system.c[slid].T) @ system.n[slid] @ z[:-1]
    z[:-1] += system.c[slid].T @ weights
    return z, weights
