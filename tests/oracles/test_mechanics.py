"""The exact motions of masses with friction and walls, and of neurons, against closed forms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.oracles import avalanches, clocked_mechanics
from tests.oracles.avalanches import Network
from tests.oracles.clocked_mechanics import Jump
from tests.oracles.contact_modes import Machine
from tests.oracles.linear_flow import Uncertain
from tests.oracles.mechanics import propagate


def machine(masses=1, **given):
    """Masses of one without forces, a state of the load that is the time, and what is given."""
    n = masses
    none = {
        "mass": np.eye(n),
        "stiffness": np.zeros((n, n)),
        "damping": np.zeros((n, n)),
        "constant": np.zeros(n),
        "load": np.zeros((n, 1)),
        "drive": np.zeros((1, 1)),
        "drift": np.ones(1),
        "rubs": np.zeros((0, n)),
        "limits": np.zeros(0),
        "walls": np.zeros((0, n)),
        "places": np.zeros(0),
        "restitutions": np.zeros(0),
    }
    made = {k: np.array(v, float) for k, v in {**none, **given}.items()}
    rubs = len(made["rubs"])
    made.setdefault("falls", np.zeros(rubs))
    made.setdefault("belts", np.zeros((rubs, 2)))
    return Machine(**made)


def test_a_block_turns_four_times_and_sticks():
    block = machine(stiffness=[[1]], rubs=[[1]], limits=[0.4])
    motion = propagate(block, [3.0, 0, 0], 14.0)
    assert motion.mode == (0,) and motion.events[-1].kind == "stick"
    assert_allclose([e.t for e in motion.events[-4:]], np.pi * np.arange(1, 5), rtol=1e-14)
    assert_allclose(motion.x, [-0.2, 0, 14], rtol=0, atol=1e-13)


def test_a_block_is_taken_along_by_its_belt_until_the_spring_is_stronger():
    # It sticks at v = 1/2 until x = F, and then swings about F with an amplitude of 1/2.
    block = machine(stiffness=[[1]], rubs=[[1]], limits=[0.4], belts=[[0.5, 0]])
    motion = propagate(block, [0.0, 0.5, 0], 2.0)
    assert [e.kind for e in motion.events] == ["stick", "slip"]
    assert_allclose(motion.events[1].t, 0.8, rtol=1e-14)
    assert_allclose(motion.x[0], 0.4 + 0.5 * np.sin(1.2), rtol=1e-13)


@pytest.mark.parametrize("e", [0.0, 0.5, 0.9])
def test_a_ball_comes_to_rest(e):
    ball = machine(constant=[-2], walls=[[1]], places=[0.5], restitutions=[e])
    motion = propagate(ball, [1.5, 0, 0], 30.0)
    assert motion.mode == (2,)
    assert_allclose(motion.events[0].t, 1.0, rtol=1e-15)
    assert_allclose(motion.events[-1].t, (1 + e) / (1 - e), rtol=1e-6)  # rebounds are cut off
    assert_allclose(motion.x, [0.5, 0, 30], rtol=0, atol=1e-12)


# The upper block is pulled up by t, and leaves at t = 1; or the lower one, and both leave at t = 2.
@pytest.mark.parametrize("pulled", [0, 1])
def test_blocks_that_lie_on_each_other_are_lifted(pulled):
    stack = machine(
        2,
        constant=[-1, -1],
        load=[[1 - pulled], [pulled]],
        walls=[[1, 0], [-1, 1]],
        places=[0, 1],
        restitutions=[0, 0.5],
    )
    motion = propagate(stack, [0.0, 1, 0, 0, 0], 3.0)
    up = 8 / 6 if pulled else 1 / 12
    assert motion.mode == ((2, 1) if pulled else (1, 2))
    assert_allclose(motion.events[-1].t, 1 if pulled else 2, rtol=1e-13)
    assert_allclose(motion.x[:2], [0 if pulled else up, 1 + up], rtol=0, atol=1e-12)


def test_a_block_slips_on_another_one_that_slides():
    # The lower one is pulled by t: both start at t = 1, and at t = 2 the upper one is left behind.
    stack = machine(2, load=[[1], [0]], rubs=[[1, 0], [-1, 1]], limits=[1, 0.5])
    motion = propagate(stack, [0.0, 0, 0, 0, 0], 3.0)
    assert [(e.kind, e.contact) for e in motion.events[-2:]] == [("slip", 0), ("slip", 1)]
    assert_allclose([e.t for e in motion.events[-2:]], [1, 2], rtol=1e-13)
    start = 1 / 12 + 1 / 4
    assert_allclose(motion.x[:2], [start + 1 / 4 + 1 / 6, start + 1 / 4], rtol=1e-12)


def test_friction_holds_a_mass_at_its_wall_when_it_is_pulled_off():
    # Pulled by t − 1, it has no reaction from t = 1 on, and slips at t = 1 + F.
    mass = machine(
        constant=[-1],
        load=[[1]],
        rubs=[[1]],
        limits=[0.5],
        walls=[[1]],
        places=[0.25],
        restitutions=[0.5],
    )
    motion = propagate(mass, [0.25, 0, 0], 3.0)
    assert_allclose(motion.x[0], 0.25 + 1.5**3 / 6, rtol=1e-12)


def test_a_touch_is_not_judged():
    ball = machine(constant=[-2], walls=[[-1]], places=[-1], restitutions=[0.5])
    with pytest.raises(Uncertain):
        propagate(ball, [0.0, 2, 0], 1.5)  # its highest point is 1


def test_a_kick_and_a_force_that_is_switched_on():
    mass = machine(rubs=[[1]], limits=[0.5])
    kick = Jump(1.0, np.eye(3), np.array([0, 1.0, 0]), np.array([0.0]))
    push = Jump(4.0, np.eye(3), np.zeros(3), np.array([2.5]))
    motion = clocked_mechanics.propagate(mass, [kick, push], np.zeros(3), 5.0)
    # It stops after 2 at x = 1, and is pushed by 2 from t = 4 on.
    assert_allclose(motion.x[:2], [2, 2], rtol=1e-13)


def test_neurons_fire_together():
    # By itself neuron 0 fires each ln 2; its kick makes neuron 1 fire, and that one's kick not 0.
    weights = np.array([[0, 0.9], [0.2, 0]])
    network = Network(np.array([2.0, 0.5]), np.ones(2), weights, np.array(9.0), np.array(8.0), 0.0)
    v, fired = avalanches.propagate(network, np.array([0.0, 0.5]), 1.0)
    assert fired == [(pytest.approx(np.log(2), rel=1e-15), i) for i in (0, 1)]
    left = np.exp(-(1 - np.log(2)))
    assert_allclose(v, [2 + (0.2 - 2) * left, 0.5 - 0.5 * left], rtol=1e-14)
