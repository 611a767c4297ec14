"""What results print of themselves: the precision, where it is not float64."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import outcome_codes, outcomes
from tests import pictures
from tests.pictures import made
from tests.results import in_float32


def branch(orbits):
    ends = {"points": [], "ended": ("start", "end"), "result": jf.RESULTS.successful}
    return made(jf.Branch, parameter="omega", orbits=orbits, values=np.arange(2.0), **ends)


SD = jf.systems.SDOscillator()
ORBITS = SimpleNamespace(system=SD, x0=np.zeros((2, 2)))
SINGLE_ORBITS = SimpleNamespace(system=SD, x0=np.zeros((2, 2), np.float32))
MOTION = pictures.motion()
FOURIER = jf.FourierOrbit(
    jnp.zeros((3, 2)), jnp.array(1.0), jnp.array(0.0), jf.RESULTS.successful, jnp.array(2)
)


def in_both(result, told):
    return result, in_float32(result), told


# A result, the same in float32, and how its card tells it.
CARDS = {
    "solution": in_both(MOTION, "Solution in float32: successful"),
    "diagram": in_both(
        pictures.period_doublings(), "BifurcationDiagram of SDOscillator in float32"
    ),
    "basins": in_both(pictures.basins(), "Basins of SDOscillator in float32: 30"),
    "spectrum": in_both(pictures.spectrum(), "LyapunovSpectrum in float32: successful"),
    "synchronization": in_both(pictures.synchronized(), "Synchronization in float32: exponent"),
    "curve": in_both(pictures.curve(), "BifurcationCurve in float32, 30 points"),
    "work and precision": in_both(pictures.errors(), "Reference in float32: Dopri8"),
    "fourier": in_both(FOURIER, "FourierOrbit in float32: successful"),
    "branch": (
        branch(ORBITS),
        branch(SINGLE_ORBITS),
        "Branch of SDOscillator in float32: 2 orbits",
    ),
    "route": (
        jf.BifurcationSequence(branch(ORBITS), [], []),
        jf.BifurcationSequence(branch(SINGLE_ORBITS), [], []),
        "BifurcationSequence of SDOscillator in omega, 0 found in float32",
    ),
}


@pytest.mark.parametrize("name", CARDS)
def test_a_card_says_that_it_is_of_float32(name):
    double, cast, told = CARDS[name]
    assert told in repr(cast)
    assert told.replace(" in float32", "") in repr(double) and "float" not in repr(double)


def test_a_card_of_many_lanes_says_so_too():
    cards = []

    @jax.jit
    def traced(sol):
        cards.append(repr(sol))
        return sol.t_final

    traced(in_float32(MOTION))
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), in_float32(MOTION))
    cards.append(repr(batch))
    assert all(card.startswith("Solution in float32: a batch of shape (") for card in cards)


def test_a_diagram_counts_its_outcomes_by_name():
    swept = pictures.period_doublings()
    assert "  59 of 60 lanes successful, 1 nonfinite" in repr(swept).splitlines()
    for ended, told in (
        ([], "60 of 60 lanes successful"),
        (["zeno", "nonunique", "zeno"], "57 of 60 lanes successful, 2 zeno, 1 nonunique"),
        (["interrupted"] * 60, "0 of 60 lanes successful, 60 interrupted"),
    ):
        names = np.asarray([*ended, *["successful"] * (60 - len(ended))])
        counted = eqx.tree_at(lambda d: d.results, swept, outcomes(outcome_codes(names)))
        assert f"  {told}" in repr(counted).splitlines()
