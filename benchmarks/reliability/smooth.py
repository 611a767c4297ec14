"""Random smooth fields against SciPy's DOP853 at a tolerance of 1e-13.

A number of systems and a seed enter; a group of verdicts for each number of states leaves.

    x' = V tanh(P x) - x/5 - x³/20 + Σ_k u_k sin(w_k·x + ω_k t + φ_k)
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxfil as jf
from benchmarks.reliability.lanes import counts, in_chunks
from benchmarks.reliability.verdict import Group, Verdict
from jaxfil.model.outcomes import outcome_names
from tests.oracles.random_problems import random_direction

T1, WAVES = 5.0, 4
RESOLVED = 0.3
TOLERANCE = 1e-13
# Errors allowed, relative to the size of the state: outright, or times what a change of the
# system by 1 does to the end.
ALLOWED, OF_GROWTH = 1e-9, 1e-11
SHAPES = {n: 0.01 for n in (1, 2, 3, 4, 6)}


class Waves(NamedTuple):
    """The arrays of a field."""

    v: np.ndarray
    p: np.ndarray
    u: np.ndarray
    w: np.ndarray
    omega: np.ndarray
    phi: np.ndarray

    def field(self, t, x, module):
        """x', in terms of a module's functions."""
        waves = module.sin(self.w @ x + self.omega * t + self.phi)
        return self.v @ module.tanh(self.p @ x) - 0.2 * x - 0.05 * x**3 + waves @ self.u

    def rate(self):
        """A bound on the norm of its Jacobian, and its frequencies."""
        sizes = [np.linalg.norm(self.v) * np.linalg.norm(self.p)]
        sizes += [np.linalg.norm(self.u) * np.linalg.norm(self.w), abs(self.omega).max(), 1.0]
        return sum(sizes)


class WaveSystem(jf.System):
    """The same without surfaces."""

    waves: Waves

    def vector_field(self, t, x, side):
        return self.waves.field(t, x, jnp)


def random_system(seed, n):
    """A field of order one."""
    rng = np.random.default_rng(seed)
    shapes = [(n, n), (n, n), (WAVES, n), (WAVES, n), (WAVES,), (WAVES,)]
    return Waves(*(rng.normal(size=s) for s in shapes)), rng.normal(size=n)


@eqx.filter_jit
@eqx.filter_vmap
def solve(waves, x0, dt):
    """What is compared of a chunk of solutions."""
    sol = jf.solve(WaveSystem(Waves(*waves)), x0, 0.0, T1, dt, throw=False)
    return sol.result, sol.x_final


def reference(waves, x0):
    """The state at the end."""
    options = dict(method="DOP853", rtol=TOLERANCE, atol=TOLERANCE)
    return solve_ivp(lambda t, x: waves.field(t, x, np), (0, T1), x0, **options).y[:, -1]


def growth(waves, x0, step=1e-6):
    """What a change of the system by 1 does to the end."""
    by, also = random_direction(waves, x0, 0)
    ends = [
        reference(Waves(*(u + s * v for u, v in zip(waves, by, strict=True))), x0 + s * also)
        for s in (step, -step)
    ]
    return 1 + abs(ends[0] - ends[1]).max() / (2 * step)


def judge(number, waves, x0, outcome, x):
    """The verdict on one solution."""
    if outcome != "successful":
        return Verdict(number, "refused", outcome)
    want = reference(waves, x0)
    error = abs(x - want).max() / (1 + abs(want).max())
    if error <= ALLOWED or error <= OF_GROWTH * growth(waves, x0):
        return Verdict(number, "right", error=error)
    return Verdict(number, "wrong", f"error {error:.1e}", error)


def group(n, count, seed):
    """The verdicts on `count` fields of n states."""
    problems = [random_system([seed, n, i], n) for i in range(count)]
    dts = np.asarray([RESOLVED / waves.rate() for waves, _ in problems])
    results, xs = in_chunks(solve, problems, dts)
    everything = zip(problems, outcome_names(results), xs, strict=True)
    verdicts = [judge(i, *p, str(o), x) for i, (p, o, x) in enumerate(everything)]
    return Group("smooth", f"{n} state{'s' * (n > 1)}", verdicts)


def groups(systems, seed):
    """All shapes."""
    for n, count in counts(SHAPES, systems).items():
        yield group(n, count, seed)
