"""Curves of folds and period doublings of orbits that stick, against SciPy with events.

The belt with a cubic spring sticks once a period, so that its orbit is a fixed point of a map of
one number, which `tests.oracles.sticking_map` integrates from contact to contact.
"""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import fsolve

import jaxfil as jf
from jaxfil.model.parameter import replace_parameters
from tests.oracles.sticking_map import MU_G, slope, stick_map
from tests.problems.systems import cubic_belt

FREE = "omega", "f0"


@functools.cache
def special_points():
    """The fold and the period doubling on the branch from 4.56, by kind."""
    system = cubic_belt(4.56)
    orbit = jf.periodic_orbit(system, jnp.asarray([0.08, 0.48]), steps=100)
    branch = jf.continue_orbit(system, "omega", orbit, stop=(4.4, 4.56), max_step=0.1)
    return system, {point.kind: point for point in branch.points}


def stick_on(curve, i):
    """A time in the middle of the stick of an orbit of a curve, and x1 there."""
    system = replace_parameters(cubic_belt(4.5), FREE, jnp.asarray(curve.values[i]))
    t0, period = float(curve.ts[i]), float(system.period)
    path = jf.solve(system, jnp.asarray(curve.xs[i]), t0, t0 + 2 * period, period / 100)
    ts = np.asarray(path.events.ts)[: int(path.num_events)]
    after = np.asarray(path.events.modes)[: ts.size, 0]
    k = np.flatnonzero(after == 0)[0]
    middle = 0.5 * (ts[k] + ts[k + 1])
    # It moves with the belt.
    return middle, float(path.events.xs[k, 0]) + middle - ts[k]


@pytest.mark.release
@pytest.mark.parametrize(
    "kind, multiplier",
    [("fold", 1), pytest.param("period-doubling", -1, marks=pytest.mark.release)],
)
def test_critical_orbits_that_stick(kind, multiplier):
    system, points = special_points()
    curve = jf.continue_bifurcation(system, FREE, points[kind], stop=4.6, max_step=0.1)
    assert curve.kinds == (kind,) * len(curve.kinds) and curve.points == []
    for i, (omega, f0) in enumerate(curve.values):
        t0, x1 = stick_on(curve, i)
        assert_allclose(stick_map(omega, t0, x1, f0), x1, rtol=0, atol=1e-10)
        assert_allclose(slope(omega, t0, x1, f0), multiplier, rtol=0, atol=1e-6)

    def equations(z):
        gap = stick_map(omega, t0, z[1], z[0]) - z[1]
        return [gap, 0.1 * (slope(omega, t0, z[1], z[0]) - multiplier)]

    assert_allclose(f0, fsolve(equations, [f0 + 0.01, x1], xtol=1e-11)[0], rtol=0, atol=1e-7)


@pytest.mark.release
def test_a_fold_of_orbits_that_stick_goes_on_where_they_begin_to_cross():
    """The orbit comes to the belt where the push just exceeds the friction: switching-sliding."""
    system, points = special_points()
    curve = jf.continue_bifurcation(system, FREE, points["fold"], stop=4.7, max_step=0.1)
    assert curve.ended[1] == "omega = 4.7 was reached"
    (point,) = curve.points
    assert point.kind == "tangency"
    i = np.argmin(abs(curve.values[:, 0] - point.values[0]))
    t0, x1 = stick_on(curve, i)

    def equations(z):
        omega, f0, x1 = z
        pushes = []
        gap = stick_map(omega, t0, x1, f0, pushes=pushes) - x1
        fold = 0.1 * (slope(omega, t0, x1, f0) - 1)
        return [gap, fold, 1e-3 * (pushes[1] - MU_G)]

    omega, f0, _ = fsolve(equations, [*point.values, x1], xtol=1e-10)
    assert_allclose(point.values, [omega, f0], rtol=0, atol=1e-6)
