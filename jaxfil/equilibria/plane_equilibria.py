"""The equilibria of a planar system in a window, regular ones and pseudo-equilibria.

Newton's method starts from a grid of guesses, in every mode with at most one sliding surface.
"""

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfil.equilibria.equilibrium import Equilibrium
from jaxfil.equilibria.search import in_mode
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.system import System
from jaxfil.xla.known import array_of, part_of

# Number of guesses along each edge of the window.
_GRID = 7
# Largest number of evaluations of Newton's method from each guess.
_NEWTON_STEPS = 30
# Equilibria of one mode nearer than this fraction of the window are one.
_ONE = 1e-6
# Largest number of surfaces whose modes are all tried.
_MOST = 4


def equilibria_in(system: System, window: Float[np.ndarray, "2 2"], m: int) -> list[Equilibrium]:
    """The equilibria of the system, by mode and from left to right."""
    axes = [np.linspace(low, high, 2 * _GRID + 1)[1::2] for low, high in window]
    guesses = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    modes = _modes(m)
    xs = np.tile(guesses, (len(modes), 1))
    each = np.repeat(modes, len(guesses), axis=0)
    steps = array_of(_NEWTON_STEPS, jnp.int32)
    many = eqx.filter_vmap(lambda x, mode: in_mode(system, x, mode, steps, m, False))
    found = many(array_of(xs), array_of(each))
    admissible, states = np.asarray(found.admissible), np.asarray(found.x)
    inside = np.all((window[:, 0] <= states) & (states <= window[:, 1]), axis=1)
    inside &= np.asarray(found.result == RESULTS.successful) & admissible
    kept, size = [], np.ptp(window, axis=1)
    for i in np.flatnonzero(inside):
        same = [k for k in kept if np.all(abs(states[k] - states[i]) <= _ONE * size)]
        if not any(np.all(each[k] == each[i]) for k in same):
            kept.append(i)
    # Every mode has all guesses, so that the quotient is the number of the mode.
    order = sorted(kept, key=lambda i: (i // len(guesses), *states[i]))
    return [part_of(found, int(i)) for i in order]


def _modes(m: int) -> Float[np.ndarray, "k m"]:
    """Every mode with at most one sliding surface."""
    if m > _MOST:
        raise ValueError(f"`system` must have at most {_MOST} surfaces here, got {m}.")
    every = itertools.product((1.0, -1.0, 0.0), repeat=m)
    return np.array([mode for mode in every if mode.count(0.0) < 2])
