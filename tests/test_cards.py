"""What results print of themselves: the precision, where it is not float64."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from tests import pictures
from tests.pictures import made


def in_float32(result):
    """The same result in float32."""

    def cast(leaf):
        return jnp.asarray(leaf, jnp.float32) if np.asarray(leaf).dtype == np.float64 else leaf

    return jax.tree.map(cast, result)


def branch(orbits):
    ends = {"points": [], "ended": ("start", "end"), "parameter": "omega"}
    return made(jf.Branch, orbits=orbits, values=np.arange(2.0), **ends)


SD = jf.systems.SDOscillator()
ORBITS = SimpleNamespace(system=SD, x0=np.zeros((2, 2)))
SINGLE_ORBITS = SimpleNamespace(system=SD, x0=np.zeros((2, 2), np.float32))
MOTION = dataclasses.replace(pictures.motion(), stats={"num_steps": np.array(9)})
FOURIER = jf.FourierOrbit(
    np.zeros((3, 2)), np.array(1.0), np.array(0.0), jf.RESULTS.successful, np.array(2)
)

# A result, the same in float32, and how its card tells it.
CARDS = {
    "solution": (MOTION, in_float32(MOTION), "Solution in float32: successful"),
    "diagram": (
        pictures.period_doublings(),
        in_float32(pictures.period_doublings()),
        "BifurcationDiagram of SDOscillator in float32",
    ),
    "basins": (
        pictures.basins(),
        in_float32(pictures.basins()),
        "Basins of SDOscillator in float32: 30",
    ),
    "spectrum": (
        pictures.spectrum(),
        in_float32(pictures.spectrum()),
        "LyapunovSpectrum in float32: successful",
    ),
    "synchronization": (
        pictures.synchronized(),
        in_float32(pictures.synchronized()),
        "Synchronization in float32: exponent",
    ),
    "curve": (
        pictures.curve(),
        in_float32(pictures.curve()),
        "BifurcationCurve in float32, 30 points",
    ),
    "work and precision": (
        pictures.errors(),
        in_float32(pictures.errors()),
        "Reference in float32: Dopri8",
    ),
    "fourier": (FOURIER, in_float32(FOURIER), "FourierOrbit in float32: successful"),
    "branch": (
        branch(ORBITS),
        branch(SINGLE_ORBITS),
        "Branch of SDOscillator in float32: 2 orbits",
    ),
    "route": (
        jf.Route(branch(ORBITS), []),
        jf.Route(branch(SINGLE_ORBITS), []),
        "Route of SDOscillator in omega, 0 found in float32",
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
