"""Branches of orbits that come to rest after infinitely many impacts, and where they cease to."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxfil as jf
from tests.problems.systems import ShakenTable

E = 0.4


def comes_to_rest(amplitude):
    """Whether the impacts end of a ball that has left the table where that falls at the
    acceleration of gravity, before it does so again: followed one by one."""
    leaves = np.arcsin(1 / amplitude)
    t, v, wait = leaves, amplitude * np.cos(leaves), 1.0
    while t < leaves + 2 * np.pi:
        x = amplitude * np.sin(t)

        def height(s, t=t, x=x, v=v):
            return x + v * s - s * s / 2 - amplitude * np.sin(t + s)

        s = wait
        while height(s) > 0:
            s *= 1.02
        s = brentq(height, s / 1.02, s, xtol=1e-16, rtol=1e-14)
        table = amplitude * np.cos(t + s)
        t, v = t + s, table - E * (v - s - table)
        pace, press = v - table, 1 - amplitude * np.sin(t)
        # Flights of constant acceleration have the length 2 pace/press.
        if pace < 1e-8 and press > 0:
            return t + 2 * pace / press / (1 - E) < leaves + 2 * np.pi
        wait = 0.5 * min(2 * pace / max(press, 0.01), 1.0)
    return False


def orbit(amplitude):
    system = ShakenTable(jnp.array(amplitude), E)
    x0 = jnp.array([0.0, amplitude])
    return system, jf.periodic_orbit(system, x0, max_events=64)


@pytest.mark.slow
def test_of_impacts_that_die_out_one_more_is_no_bifurcation():
    """Impacts end as they pass t0, and others become too low to be followed: it goes on resting."""
    system, start = orbit(1.7)
    branch = jf.continue_orbit(system, "a", start, stop=1.742)
    counts = {len(sequence) for sequence in branch.sequences}
    assert len(counts) > 1 and branch.points == []


def test_the_branch_says_where_rest_ceases():
    """There the impacts go on for all of the time until the table falls away again."""
    system, start = orbit(1.755)
    branch = jf.continue_orbit(system, "a", start, stop=1.75689745)
    rests = [point for point in branch.points if point.kind == "rest"]
    assert len(rests) == 1 and rests[0] is branch.points[0]
    assert repr(rests[0]).split(": ")[1].startswith("ceases on surface 0, ")
    assert max(point.value for point in branch.points) <= branch.values[-1] == 1.75689745
    value = rests[0].value
    assert comes_to_rest(value - 2e-7) and not comes_to_rest(value + 2e-7)
