"""Lanes that coast in a block: exactly what they would be if every step of theirs were judged."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

import jaxfil as jf
from jaxfil.integrate.contacts.cubic import NEVER, first_contact, stays_off
from jaxfil.xla.kernel import BLOCK
from tests.problems import closed_forms

number = st.floats(-4, 4).map(lambda v: v**3)
# Written out: lanes of a compact program are in no blocks.
FEW = {"transient": 4, "samples": 6, "progress": False, "compact": False}


@jax.jit
def judged(g0, d0, g1, d1, noise):
    armed = jnp.array(True)
    return stays_off(g0, d0, g1, d1, noise), *first_contact(g0, d0, g1, d1, armed, noise)


@pytest.mark.slow
def test_where_a_guard_stays_off_no_contact_is_found():
    off = []

    @given(g0=number, d0=number, g1=number, d1=number, more=st.sampled_from([0.0, 1e-12, 0.1]))
    @example(g0=64.0, d0=0.0, g1=1e-20, d1=0.0, more=0.0)
    @settings(max_examples=500, deadline=None)
    def look(**numbers):
        off.append(stays_off_and_is_not_met(**numbers))

    look()
    assert sum(off) > 50, "hardly a guard that stays off"


def stays_off_and_is_not_met(g0, d0, g1, d1, more):
    """Whether a guard of these ends is told to stay off, after checking that it does."""
    g0 = abs(g0)
    noise = 32 * np.finfo(float).eps * (g0 + abs(g1)) + more  # never less than rounding
    off, theta, look = judged(g0, d0, g1, d1, noise)
    if off:
        assert theta == look == NEVER
        steps = np.linspace(0, 1, 101)
        cubic = g0 + steps * (d0 + steps * (3 * (g1 - g0) - 2 * d0 - d1))
        cubic += steps**3 * (d0 + d1 - 2 * (g1 - g0))
        assert cubic.min() > 0
    return bool(off)


class Wall(jf.System):
    """A forced mass on a spring that hits a shaken wall: impacts, on a surface that moves."""

    omega: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.cos(self.omega * t) - x[0] - 0.05 * side * x[1]])

    def switching(self, t, x):
        return 0.8 - 0.1 * jnp.sin(self.omega * t) - x[0]

    def reset(self, t, x, surface):
        speed = -0.1 * self.omega * jnp.cos(self.omega * t)
        return jnp.stack([x[0], speed - 0.9 * (x[1] - speed)])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Pair(jf.System):
    """Two masses on one belt, coupled: two surfaces, each slid on."""

    omega: jax.Array

    def vector_field(self, t, x, side):
        pull = 0.3 * (x[0] - x[2])
        force = jnp.cos(self.omega * t)
        first = force - x[0] - pull - 0.4 * side[0]
        second = 0.7 * force - 1.3 * x[2] + pull - 0.3 * side[1]
        return jnp.stack([x[1], first, x[3], second])

    def switching(self, t, x):
        return jnp.stack([x[1] - 0.5, x[3] - 0.5])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


SCENES = {
    "stick-slip": (jf.systems.BeltFriction(), (4.2, 4.7), (0.0, 0.0)),
    "crossing": (jf.systems.SDOscillator(), (0.6, 1.3), (0.3, 0.1)),
    "impacts": (Wall(jnp.float64(1.7)), (1.5, 1.9), (0.0, 0.0)),
    "two surfaces": (Pair(jnp.float64(1.1)), (0.9, 1.3), (0.3, 0.0, -0.2, 0.1)),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        name if name == "stick-slip" else pytest.param(name, marks=pytest.mark.release)
        for name in SCENES
    ],
)
def test_a_block_gives_what_lanes_of_their_own_clock_give(name):
    system, ends, x0 = SCENES[name]
    values = np.linspace(*ends, 20)
    steps = {"steps": 30, "stepper": jf.RK4()}
    block = jf.bifurcation_diagram(system, "omega", values, jnp.array(x0), **FEW, **steps)
    alone = [
        jf.solve(
            system_at(system, value),
            jnp.array(x0),
            0.0,
            10 * 2 * np.pi / value,
            2 * np.pi / value / 30,
            stepper=jf.RK4(),
        ).x_final
        for value in values[::7]
    ]
    assert np.all(np.asarray(block.results == jf.RESULTS.successful))
    np.testing.assert_allclose(block.xs[::7, -1], alone, rtol=1e-9, atol=1e-10)


def system_at(system, omega):
    return eqx.tree_at(lambda s: s.omega, system, jnp.float64(omega))


@pytest.mark.slow
def test_a_lane_coasts_on_from_a_near_touch_without_losing_time():
    # x = 1 + Re a exp(iωt) comes within 2e-3 of the surface, which is looked at once a period, at a
    # time that float32 rounds by up to 6e-5; sampling times are rounded by as much.
    sd, omega = jf.systems.SDOscillator(), float(np.float32(0.86648))
    a, x0 = closed_forms.response(omega), closed_forms.one_sided(omega)
    d = jf.bifurcation_diagram(
        sd, "omega", [omega], np.float32(x0), transient=200, samples=100, steps=16, progress=False,
        compact=False,
    )  # fmt: skip
    rates = omega * a.imag, omega**2 * a.real
    bound = 1.5 * np.finfo(np.float32).eps * 300 * 2 * np.pi / omega * np.max(np.abs(rates))
    np.testing.assert_allclose(d.xs[0], np.broadcast_to(x0, (100, 2)), rtol=0, atol=bound)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stick-slip", "impacts"])
def test_the_others_in_a_block_make_no_difference_to_the_last_bit(name):
    system, ends, x0 = SCENES[name]
    values = np.linspace(*ends, 40)
    run = FEW | {"steps": 30, "stepper": jf.RK4()}
    states = np.broadcast_to(x0, (40, 2)).copy()
    calm = jf.bifurcation_diagram(system, "omega", values, states, **run)
    states[::2] = np.random.default_rng(0).normal(size=(20, 2)) - [2, 0]
    states[4] = np.nan
    wild = jf.bifurcation_diagram(system, "omega", values, states, **run)
    assert not np.array_equal(wild.xs[::2], calm.xs[::2])
    np.testing.assert_array_equal(wild.xs[1::2], calm.xs[1::2])
    assert BLOCK >= 40, "they share a block"
