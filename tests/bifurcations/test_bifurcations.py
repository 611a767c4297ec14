"""Grazing and sliding bifurcations of periodic orbits.

Reference values: the closed form of the SD oscillator's grazing, Den Hartog's closed form, the
amplitude at which a linear oscillator reaches a wall, and numbers from an independent piecewise
closed-form and mpmath computation for the belt of Santhosh, Narayanan and Padmanabhan (2016).
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import jaxfil as jf
from jaxfil.bifurcations.candidates import tangency_candidates
from jaxfil.bifurcations.flights import filled
from jaxfil.bifurcations.locate import BIFURCATION_KINDS
from jaxfil.model.outcomes import EventKind, outcome_names
from jaxfil.model.parameter import replace_parameter
from tests.oracles.stick_and_slip import least_gap
from tests.problems import closed_forms
from tests.problems.values import (
    BELT_ADDS,
    BELT_CHANGES,
    BELT_GRAZES,
    CUBIC_GRAZES,
    DEN_HARTOG_STICKS,
    SD_GRAZES,
    WALL_GRAZES,
)
from tests.results import in_float32, lane

SD_LOW, SD_HIGH = SD_GRAZES
BELT = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0)


def sd_orbits(values, x1=1.5):
    """One-sided orbits of the SD oscillator, a linear oscillation about 1."""
    system = jf.systems.SDOscillator()

    def one(w, x):
        return jf.periodic_orbit(replace_parameter(system, "omega", w), x, steps=60, throw=False)

    x0 = jnp.stack([jnp.broadcast_to(jnp.asarray(x1), len(values)), jnp.zeros(len(values))], axis=1)
    return system, eqx.filter_vmap(one)(jnp.asarray(values), x0)


def belt_orbits(values):
    def one(w):
        orbit = jf.periodic_orbit(
            replace_parameter(BELT, "omega", w),
            jnp.array([1.0, 0.5]),
            transient=20,
            steps=60,
            throw=False,
        )
        return orbit

    return eqx.filter_vmap(one)(jnp.asarray(values))


@pytest.fixture(scope="module")
def sd():
    system, orbits = sd_orbits([0.97 * SD_LOW, 0.8, 1.03 * SD_HIGH])
    return system, orbits


@pytest.fixture(scope="module")
def sd_grazing(sd):
    system, orbits = sd
    return jf.find_bifurcation(system, "omega", lane(orbits, 0), "grazing")


@pytest.mark.release
def test_the_sd_oscillator_grazes_where_its_amplitude_is_one(sd):
    system, orbits = sd
    found = jf.find_bifurcation(system, "omega", orbits, "grazing")
    np.testing.assert_allclose(found.value, [SD_LOW, SD_LOW, SD_HIGH], rtol=0, atol=1e-11)
    assert found.kind.tolist() == ["grazing"] * 3
    # It touches x = 0 at rest, from the right, with a positive acceleration.
    np.testing.assert_allclose(found.x, 0, rtol=0, atol=1e-11)
    assert np.all(np.asarray(found.conditions.bend) > 0)


# Guesses 3 % off on either side: values from the branch of an independent code, or from closed
# forms per piece (0.917, 1.549, 10.905).
BELT_CASES = {
    "grazing-sliding": [(value, off) for value in BELT_GRAZES for off in (0.97, 1.03)],
    "adding-sliding": [(BELT_ADDS, 0.97), (BELT_ADDS, 1.03)],
}


@pytest.fixture(scope="module")
def belts():
    """The orbits of all cases, from one program."""
    return belt_orbits([value * off for case in BELT_CASES.values() for value, off in case])


@pytest.mark.release
@pytest.mark.parametrize("kind", BELT_CASES)
def test_bifurcations_of_the_belt_from_either_side(kind, belts):
    # Both kinds in six lanes, so that one program finds both.
    kinds = np.repeat([*BELT_CASES], [len(case) for case in BELT_CASES.values()])
    lanes = np.resize(np.flatnonzero(kinds == kind), 6)
    values = np.resize([value for value, _ in BELT_CASES[kind]], 6)
    orbits = lane(belts, lanes)
    found = jf.find_bifurcation(BELT, "omega", orbits, kind)
    np.testing.assert_allclose(found.value, values, rtol=0, atol=1e-10)
    assert found.kind.tolist() == [kind] * values.size
    assert np.all(np.asarray(found.residual) < 1e-11)


@pytest.mark.release
def test_a_cubic_spring_grazes_where_its_orbit_reaches_the_belt():
    system = jf.systems.BeltFriction(omega=4.52)
    orbit = jf.periodic_orbit(system, jnp.array([0.148, 0.358]), steps=160)
    found = jf.find_bifurcation(system, "omega", orbit, "grazing", throw=False)
    assert abs(float(found.value) - CUBIC_GRAZES) < 1e-10
    # There is a sliding region where it touches: the name says so, whatever was asked for.
    assert found.kind == "grazing-sliding"
    assert outcome_names(found.result) == "other_kind"


@pytest.mark.release
def test_sticking_begins_as_den_hartog_says_over_a_range_of_frequencies():
    system = jf.systems.DenHartog(friction=0.78, omega=0.8)
    orbit = jf.periodic_orbit(system, jnp.array([2.0, 0.3]), steps=80)
    begins = jf.find_bifurcation(system, "friction", orbit, "crossing-sliding")
    assert abs(float(begins.value) - DEN_HARTOG_STICKS) < 1e-10
    assert abs(float(begins.value) - closed_forms.den_hartog_sticks(0.8)) < 1e-11
    names = ("omega", "friction")
    curve = jf.continue_bifurcation(system, names, begins, stop=(0.55, 0.95))
    omega, friction = curve.values.T
    assert omega.min() == pytest.approx(0.55, abs=1e-12)
    assert omega.max() == pytest.approx(0.95, abs=1e-12)
    np.testing.assert_allclose(friction, closed_forms.den_hartog_sticks(omega), rtol=0, atol=1e-8)
    assert set(curve.kinds) == {"crossing-sliding"}


@pytest.mark.release
def test_a_wall_is_grazed_where_the_amplitude_reaches_it():
    system = jf.systems.ImpactOscillator(amplitude=0.43, omega=1.2)
    orbit = jf.periodic_orbit(system, jnp.array([0.5, 0.5]), steps=60)
    graze = jf.find_bifurcation(system, "amplitude", orbit, "grazing")
    assert abs(float(graze.value) - WALL_GRAZES) < 1e-9
    curve = jf.continue_bifurcation(system, ("omega", "amplitude"), graze, stop=(1.1, 1.3))
    omega, amplitude = curve.values.T
    exact = closed_forms.wall_amplitude(omega)
    np.testing.assert_allclose(amplitude, exact, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_curve_of_grazing_is_where_the_amplitude_is_one(sd_grazing):
    system = jf.systems.SDOscillator(omega=0.84)
    curve = jf.continue_bifurcation(system, ("omega", "f0"), sd_grazing, stop=(0.75, 0.95))
    ax = curve.plot(jf.plot.page().add_subplot())
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Ω", "f₀")
    omega, f0 = curve.values.T
    exact = np.sqrt((1 - omega**2) ** 2 + (2 * 0.0141 * omega) ** 2)
    np.testing.assert_allclose(f0, exact, rtol=0, atol=1e-9)
    assert "omega from 0.75 to 0.95" in repr(curve)
    assert outcome_names(curve.result) == "successful" and "  successful\n" in repr(curve)


@pytest.mark.slow
def test_the_value_has_the_derivative_of_the_closed_form(sd):
    system, orbits = sd
    orbit = lane(orbits, 0)

    def value(system):
        return jf.find_bifurcation(system, "omega", orbit, "grazing").value

    slope = jax.grad(value)(system)

    def exact(f0, zeta):
        a = 1 - 2 * zeta**2
        return jnp.sqrt(a - jnp.sqrt(a**2 - 1 + f0**2))

    by_f0, by_zeta = jax.grad(exact, argnums=(0, 1))(jnp.float64(0.25), jnp.float64(0.0141))
    np.testing.assert_allclose(slope.f0, by_f0, rtol=1e-9)
    np.testing.assert_allclose(slope.zeta, by_zeta, rtol=1e-8)


def margin_exact(f0, zeta, omega):
    return 1 - f0 / jnp.sqrt((1 - omega**2) ** 2 + (2 * zeta * omega) ** 2)


@pytest.mark.slow
def test_the_margin_and_its_gradient_on_both_sides_of_grazing(sd):
    _, orbits = sd
    orbit = lane(orbits, 1)
    margin = jax.jit(jax.value_and_grad(lambda s: jf.grazing_margin(s, orbit)))
    for omega in (0.8, 0.855, 0.875):  # the last one past grazing, where the margin is negative
        value, slope = margin(jf.systems.SDOscillator(omega=jnp.float64(omega)))
        exact, by = jax.value_and_grad(margin_exact, argnums=(0, 1, 2))(0.25, 0.0141, omega)
        assert abs(float(value - exact)) < 1e-11
        np.testing.assert_allclose([slope.f0, slope.zeta, slope.omega], by, rtol=1e-8)
    assert float(value) < 0


class Threshold(jf.System):
    """y' = cos t − y, and ½ more beyond y = d. Short of it y reaches 1/√2."""

    d: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.cos(t) - x + jnp.where(side < 0, 0.5, 0.0)

    def switching(self, t, x):
        return self.d - x[0]


class ThresholdWithClock(Threshold):
    clocks = (jf.Clock(np.pi / 8, 0.2),)


@pytest.mark.parametrize("kind", [Threshold, ThresholdWithClock])
@pytest.mark.slow
def test_ticks_do_not_end_a_flight_beyond_its_surface(kind):
    orbit = jf.periodic_orbit(kind(jnp.array(0.8)), jnp.array([0.5]), steps=32)
    margin = jax.jit(lambda d: jf.grazing_margin(kind(d), orbit))
    for d in (0.8, 0.7, 0.6):
        assert abs(float(margin(jnp.array(d))) - (d - np.sqrt(0.5))) < 1e-11


class SoftThreshold(jf.System):
    """y' = p cos t − y and 4(0.6 − y) more beyond y = 0.6, below another one of 0.66. For a
    smaller p than 0.6√2 the largest y is p/√2."""

    p: jax.Array
    period = 2 * np.pi
    slides = False

    def vector_field(self, t, x, side):
        return self.p * jnp.cos(t) - x - jnp.where(side[0] > 0, 4.0 * (x - 0.6), 0.0)

    def switching(self, t, x):
        return jnp.stack([x[0] - 0.6, 0.66 - x[0]])


@pytest.mark.slow
def test_a_margin_is_not_that_of_a_flight_beyond_another_surface():
    """The flight of the known orbit is followed beyond 0.6, where that of the others is shorter, or
    never. The largest y was found by DOP853 in SciPy."""
    orbit = jf.periodic_orbit(SoftThreshold(jnp.float64(1.0)), jnp.array([0.4]), steps=32)

    @eqx.filter_jit
    @eqx.filter_vmap
    def margin(p):
        return jf.grazing_margin(SoftThreshold(p), orbit, throw=False)

    found = margin(jnp.array([1.0, 0.86, 0.83, 0.8]))
    assert outcome_names(found.result).tolist() == ["successful", *["orbit_lost"] * 3]
    np.testing.assert_allclose(found.value, [0.66 - 0.6488699031, *[np.nan] * 3], rtol=0, atol=1e-9)


class Counted(jf.systems.SDOscillator):
    """Counts how often its field is traced."""

    traced = []

    def vector_field(self, t, x, side):
        self.traced.append(t)
        return super().vector_field(t, x, side)


@pytest.mark.release
def test_verbs_share_their_flows():
    """One flow with derivatives serves orbits and branches in all parameters, another one
    bifurcations in all parameters, margins and curves."""
    system = Counted(omega=jnp.float64(0.84), f0=jnp.float64(0.25))

    def traced(verb):
        Counted.traced.clear()
        return verb(), len(Counted.traced)

    orbit, first = traced(lambda: jf.periodic_orbit(system, jnp.array([1.9, 0.0])))
    branches = [
        traced(lambda name=name, stop=stop: jf.continue_orbit(system, name, orbit, stop=stop))
        for name, stop in (("omega", 0.845), ("f0", 0.252))
    ]
    assert first > 0 and [again for _, again in branches] == [0, 0]

    found, first = traced(lambda: jf.find_bifurcation(system, "omega", orbit, "grazing"))
    value, slope = jax.value_and_grad(lambda s: jf.grazing_margin(s, orbit))(system)
    others = [
        traced(verb)[1]
        for verb in (
            lambda: jf.find_bifurcation(system, "f0", orbit, "grazing"),
            lambda: jf.grazing_margin(system, orbit),
            lambda: jax.grad(lambda s: jf.grazing_margin(s, orbit))(system),
            lambda: jf.continue_bifurcation(system, ("omega", "f0"), found, stop=0.869),
        )
    ]
    # A gradient looks for traced numbers that the field and H close over, and finds its flow again.
    assert first > 0 and others == [0, 0, 2, 0]
    np.testing.assert_allclose(found.value, SD_LOW, rtol=1e-11)
    exact, by = jax.value_and_grad(margin_exact, argnums=(0, 1, 2))(0.25, 0.0141, 0.84)
    assert abs(float(value - exact)) < 1e-11
    np.testing.assert_allclose([slope.f0, slope.zeta, slope.omega], by, rtol=1e-8)


def margins(system, orbit, omegas):
    """Margins for many values of ω, each with its outcome."""

    def one(omega):
        moved = replace_parameter(system, "omega", omega)
        return jf.grazing_margin(moved, orbit, throw=False)

    return eqx.filter_vmap(one)(jnp.asarray(omegas))


@pytest.mark.slow
def test_every_lane_of_a_margin_has_its_own_outcome(sd):
    system, orbits = sd
    found = margins(system, lane(orbits, 1), [0.8, np.nan, 0.855])
    assert outcome_names(found.result).tolist() == ["successful", "nonfinite", "successful"]
    exact = [margin_exact(0.25, 0.0141, omega) for omega in (0.8, np.nan, 0.855)]
    np.testing.assert_allclose(found.value, exact, rtol=0, atol=1e-11)
    assert repr(found) == "GrazingMargin: a batch of shape (3,)"
    single = lane(found, 0)
    assert repr(single) == f"GrazingMargin: successful\n  margin {float(single.value):.12g}"
    assert "GrazingMargin: nonfinite: The state" in repr(lane(found, 1))
    assert "GrazingMargin in float32: successful" in repr(in_float32(single))


@pytest.mark.slow
def test_a_margin_that_is_not_found_is_an_error(sd):
    system, orbits = sd
    broken = replace_parameter(system, "omega", np.nan)
    with pytest.raises(eqx.EquinoxRuntimeError, match="is not finite"):
        jf.grazing_margin(broken, lane(orbits, 1))
    lost = jf.periodic_orbit(broken, jnp.array([1.5, 0.0]), throw=False)
    with pytest.raises(eqx.EquinoxRuntimeError, match="no approach to a surface"):
        jf.grazing_margin(system, lost)
    found = jf.grazing_margin(system, lost, throw=False)
    assert outcome_names(found.result) == "no_tangency_found" and np.isnan(float(found.value))


@pytest.mark.slow
@pytest.mark.parametrize("throw", [pytest.param(True, marks=pytest.mark.release), False])
def test_a_margin_has_its_derivatives_with_and_without_an_error(sd, throw):
    _, orbits = sd
    orbit = lane(orbits, 1)

    def margin(f0, zeta, omega):
        found = jf.grazing_margin(
            jf.systems.SDOscillator(omega=omega, f0=f0, zeta=zeta), orbit, throw=throw
        )
        return found if throw else found.value

    f0, zeta = jnp.float64(0.25), jnp.float64(0.0141)
    args, which = (f0, zeta, jnp.array([0.8, 0.855])), (0, 1, 2)
    exact = jax.vmap(jax.grad(margin_exact, which), (None, None, 0))(*args)
    for derivative in (jax.grad, jax.jacfwd):
        got = jax.jit(jax.vmap(derivative(margin, which), (None, None, 0)))(*args)
        np.testing.assert_allclose(got, exact, rtol=1e-8)


@pytest.mark.slow
def test_the_nearest_grazing_set_is_found_by_gradient(sd):
    """Projection onto the set margin = 0 by Newton along the gradient ends where the closed form
    of the margin vanishes."""
    _, orbits = sd
    orbit = lane(orbits, 1)
    margin = jax.jit(jax.value_and_grad(lambda s: jf.grazing_margin(s, orbit)))
    system = jf.systems.SDOscillator(omega=jnp.float64(0.8))
    for _ in range(8):
        value, slope = margin(system)
        size = slope.f0**2 + slope.omega**2
        system = eqx.tree_at(
            lambda s: (s.f0, s.omega),
            system,
            (system.f0 - value * slope.f0 / size, system.omega - value * slope.omega / size),
        )
    assert abs(margin_exact(system.f0, 0.0141, system.omega)) < 1e-12


@pytest.mark.release
@pytest.mark.long_run
def test_everything_that_happens_to_an_orbit_in_one_call():
    """Belt case 1 from 12 down to 3.9: three of the nine on [0.5, 20]."""
    system = replace_parameter(BELT, "omega", 12.0)
    orbit = jf.periodic_orbit(system, jnp.array([0.1, 0.0]), steps=60)
    route = jf.find_bifurcations(system, "omega", orbit, stop=3.9)
    assert [b.kind for b in route] == ["grazing-sliding", "switching-sliding", "crossing-sliding"]
    expected = [BELT_GRAZES[1], 7.952394749883, 4.217222740070]
    np.testing.assert_allclose([b.value for b in route], expected, rtol=0, atol=1e-8)
    assert "switching-sliding" in repr(route)


def with_a_graze(orbit, k):
    """The orbit with a touch told in the middle of the flight that its contact number k ends."""
    events = orbit.events
    middle = 0.5 * (events.ts[k - 1] + events.ts[k])
    inserted = jax.tree.map(lambda v: jnp.insert(v, k, v[k - 1], axis=0)[:-1], events)
    inserted = eqx.tree_at(
        lambda e: (e.ts, e.kinds),
        inserted,
        (inserted.ts.at[k].set(middle), inserted.kinds.at[k].set(int(EventKind.graze))),
    )
    return eqx.tree_at(lambda o: o.events, orbit, inserted)


@pytest.mark.slow
def test_a_touch_within_a_flight_hides_nothing():
    """The slip that is born in the adding-sliding bifurcation rises so little at first that its
    vertex is told as a touch."""
    system = replace_parameter(BELT, "omega", 1.402)
    orbit = jf.periodic_orbit(system, jnp.array([1.56, 1.0]), steps=60)
    slip = float(orbit.events.ts[3] - orbit.events.ts[2])
    for seen in (orbit, with_a_graze(orbit, 3)):
        reach, touch = tangency_candidates(seen, "adding-sliding")[0]
        assert reach == slip < 0.2
        assert touch.side == -1


@pytest.mark.release
@pytest.mark.long_run
def test_all_nine_bifurcations_of_the_belt():
    """Santhosh et al. name six of them; two lie 0.005 apart."""
    system = replace_parameter(BELT, "omega", 17.0)
    orbit = jf.periodic_orbit(system, jnp.array([0.6, 0.02]), steps=60)
    route = jf.find_bifurcations(system, "omega", orbit, stop=(0.5, 20.0))
    assert [b.kind for b in route] == [
        "grazing-sliding",
        "grazing-sliding",
        "adding-sliding",
        "adding-sliding",
        "crossing-sliding",
        "crossing-sliding",
        "crossing-sliding",
        "switching-sliding",
        "grazing-sliding",
    ]
    known = {0: BELT_GRAZES[0], 3: BELT_ADDS, 8: BELT_GRAZES[1]}
    np.testing.assert_allclose([b.value for b in route], BELT_CHANGES, rtol=0, atol=6e-4)
    for i, value in known.items():
        assert abs(float(route.bifurcations[i].value) - value) < 1e-9


class Neuron(jf.System):
    """x' = push − a x + cos t, reset to 0 at 1/√(1 + a²), where the orbit below it grazes at a push
    of 0. Beyond, it fires."""

    push: jax.Array
    leak: jax.Array
    period = 2 * jnp.pi
    slides: ClassVar[bool] = False

    @property
    def threshold(self):
        return 1 / jnp.sqrt(1 + self.leak**2)

    def vector_field(self, t, x, side):
        return self.push - self.leak * x + jnp.cos(t)

    def switching(self, t, x):
        return self.threshold - x[0]

    def reset(self, t, x, surface):
        return jnp.zeros_like(x)


@pytest.mark.release
def test_a_graze_that_ends_a_branch_at_a_value_of_zero_is_named():
    neuron = Neuron(jnp.asarray(-0.3), jnp.asarray(1.0))
    orbit = jf.periodic_orbit(neuron, jnp.zeros(1))
    (graze,) = jf.find_bifurcations(neuron, "push", orbit, stop=0.5)
    assert graze.kind == "grazing" and str(outcome_names(graze.result)) == "successful"
    np.testing.assert_allclose([graze.value, graze.t % np.pi], [0, np.pi / 4], rtol=0, atol=1e-14)
    # From the start of the branch too, where no value sets a scale; phase zero is another zero.
    found = jf.find_bifurcation(neuron, "push", orbit, "grazing")
    np.testing.assert_allclose(found.value, 0, atol=1e-14)


def firing_ends(leak):
    """The orbit touches the threshold at time s, is reset, and is there again after a period.

    push = a θ − cos s, and x(s + 2π) = p(s) (1 − q) = θ with q = exp(−2π a) and the particular
    solution p, so that sin(s − arctan(1/a)) = a q/(1 − q).
    """
    q = jnp.exp(-2 * jnp.pi * leak)
    s = jnp.arctan2(1, leak) + jnp.arcsin(leak * q / (1 - q))
    return leak / jnp.sqrt(1 + leak**2) - jnp.cos(s)


def firing(leak):
    neuron = Neuron(jnp.asarray(0.03), jnp.asarray(leak))
    orbit = jf.periodic_orbit(neuron, jnp.zeros(1), transient=20)
    assert int(orbit.num_events) == 1
    return neuron, orbit


@pytest.mark.release
@pytest.mark.parametrize("leak", [1.0, 0.5])
def test_an_orbit_that_fires_grazes_with_its_reset(leak):
    _, orbit = firing(leak)

    def value(leak):
        return jf.find_bifurcation(Neuron(jnp.asarray(0.03), leak), "push", orbit, "grazing").value

    found = jax.value_and_grad(value)(jnp.asarray(leak))
    right = jax.value_and_grad(firing_ends)(jnp.asarray(leak))
    np.testing.assert_allclose(found, right, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_the_branch_of_an_orbit_that_fires_ends_in_a_graze():
    """It is unstable at a small rate of approach, turns back, and ends there."""
    neuron, orbit = firing(0.5)
    fold, graze = jf.find_bifurcations(neuron, "push", orbit, stop=-0.3)
    assert fold.kind == "fold" and fold.value < graze.value
    assert graze.kind == "grazing" and bool(graze.tangency.struck)
    np.testing.assert_allclose(graze.value, firing_ends(0.5), rtol=0, atol=1e-13)


class SoftStop(jf.System):
    """A linear oscillator whose amplitude is that of a soft stop where gap = 0; the push is at its
    largest at a time of zero."""

    gap: jax.Array
    period = 2 * jnp.pi
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        force = jnp.cos(t) - x[1] - x[0] - 5 * jnp.where(side > 0, x[0] - 1 - self.gap, 0.0)
        return jnp.stack([x[1], force])

    def switching(self, t, x):
        return x[0] - 1 - self.gap


@pytest.mark.release
def test_a_touch_at_a_value_of_zero_is_named():
    """x = sin t."""
    stop = SoftStop(jnp.asarray(0.1))
    orbit = jf.periodic_orbit(stop, jnp.array([0.0, 1.0]))
    (touch,) = jf.find_bifurcations(stop, "gap", orbit, stop=-0.1)
    assert touch.kind == "grazing"
    np.testing.assert_allclose([touch.value, *touch.x], [0, 1, 0], rtol=0, atol=1e-13)


def test_flights_of_many_lengths_share_a_program():
    rows = np.arange(10.0).reshape(5, 2)
    more = np.asarray(filled(rows))
    np.testing.assert_array_equal(more, [*rows, rows[-1], rows[-1], rows[-1]])
    assert {filled(np.zeros(n)).shape for n in range(33, 65)} == {(64,)}


@pytest.mark.release
def test_a_kind_changes_where_the_acceleration_at_the_touch_vanishes():
    """On Σ the belt's d²H/dt² is −f0 ω sin ωt − γ1 v: at the point of codimension two it is 0."""
    system = replace_parameter(BELT, "omega", 7.8)
    orbit = jf.periodic_orbit(system, jnp.array([0.5, 0.3]), steps=60)
    found = jf.find_bifurcation(system, "omega", orbit, "switching-sliding")
    curve = jf.continue_bifurcation(system, ("omega", "f0"), found, stop=(4.5, 8.5))
    assert set(curve.kinds) == {"crossing-sliding", "switching-sliding"}
    (point,) = curve.points
    assert (point.before, point.after) == ("crossing-sliding", "switching-sliding")
    assert point.kind == "cusp"
    omega, f0 = curve.values.T
    bend = -f0 * omega * np.sin(omega * curve.ts) - 10.0
    visible = np.array(curve.kinds) == "crossing-sliding"
    assert np.all((bend > 0) == visible)
    assert abs(np.interp(0, bend[::-1], omega[::-1]) - point.values[0]) < 1e-3


def test_an_orbit_without_such_a_touch_says_so(sd):
    _, orbits = sd
    system = jf.systems.SDOscillator()
    found = jf.find_bifurcation(system, "omega", lane(orbits, 0), "adding-sliding", throw=False)
    assert outcome_names(found.result) == "no_tangency_found"
    assert np.isnan(float(found.value))
    assert found.kind == "undecided"


def test_a_touch_of_another_kind_is_named(sd):
    system, orbits = sd
    found = jf.find_bifurcation(system, "omega", lane(orbits, 0), "grazing-sliding", throw=False)
    assert outcome_names(found.result) == "other_kind"
    assert found.kind == "grazing"
    with pytest.raises(eqx.EquinoxRuntimeError, match="another kind"):
        jf.find_bifurcation(system, "omega", lane(orbits, 0), "grazing-sliding")


def test_a_failed_orbit_in_a_batch_harms_no_other():
    system, broken = sd_orbits([0.97 * SD_LOW, 0.8, 1.03 * SD_HIGH], [1.5, np.nan, 1.5])
    found = jf.find_bifurcation(system, "omega", broken, "grazing", throw=False)
    assert outcome_names(found.result).tolist() == ["successful", "no_tangency_found", "successful"]
    np.testing.assert_allclose(found.value, [SD_LOW, np.nan, SD_HIGH], rtol=0, atol=1e-11)


def test_a_bifurcation_is_found_under_jit(sd, sd_grazing):
    system, orbits = sd
    orbit = lane(orbits, 0)
    value = jax.jit(lambda s: jf.find_bifurcation(s, "omega", orbit, "grazing").value)
    np.testing.assert_allclose(value(system), sd_grazing.value, rtol=1e-14)
    with pytest.raises(ValueError, match="`orbit` must not be traced, got a traced Orbit"):
        eqx.filter_jit(jf.find_bifurcation)(system, "omega", orbit, "grazing")


def test_a_curve_that_does_not_begin_is_an_outcome(sd, sd_grazing):
    system, orbits = sd
    call = ("omega", "f0"), {"stop": (0.8, 0.9)}
    # With such a damping no orbit is near.
    far = eqx.tree_at(lambda b: b.orbit.system.zeta, sd_grazing, jnp.float64(-1.0))
    curve = jf.continue_bifurcation(system, call[0], far, **call[1], throw=False)
    assert outcome_names(curve.result) == "newton_stalled"
    np.testing.assert_allclose(curve.values, [[SD_LOW, 0.25]], rtol=1e-11)
    np.testing.assert_array_equal(curve.xs, far.x[None])
    assert curve.points == [] and curve.kinds == ("grazing",)
    assert curve.ended == ("no curve was found at (0.86671658, 0.25)",) * 2
    assert "newton_stalled: Newton's method cannot" in repr(curve)
    with pytest.raises(eqx.EquinoxRuntimeError, match="cannot reduce the residual"):
        jf.continue_bifurcation(system, call[0], far, **call[1])
    # One that was not found in the first place keeps its own outcome.
    none = jf.find_bifurcation(system, "omega", lane(orbits, 0), "adding-sliding", throw=False)
    curve = jf.continue_bifurcation(system, call[0], none, **call[1], throw=False)
    assert outcome_names(curve.result) == "no_tangency_found"


def test_bad_arguments_are_named(sd, sd_grazing):
    system, orbits = sd
    orbit = lane(orbits, 0)
    with pytest.raises(ValueError, match=r"`kind` must be one of grazing, .*got 'fold'"):
        jf.find_bifurcation(system, "omega", orbit, "fold")
    with pytest.raises(ValueError, match=r"`parameter` must be a parameter of SDOscillator"):
        jf.find_bifurcation(system, "freq", orbit, "grazing")
    with pytest.raises(
        ValueError, match=r"`orbit` must be a jaxfil.Orbit, got an object of type ndarray"
    ):
        jf.find_bifurcation(system, "omega", np.zeros(2), "grazing")
    with pytest.raises(ValueError, match=r"`orbit` must be a single Orbit"):
        jf.grazing_margin(system, orbits)
    with pytest.raises(ValueError, match=r"`parameters` must be the names of different parameters"):
        jf.continue_bifurcation(system, ("omega", "omega"), sd_grazing, stop=(0.8, 0.9))
    with pytest.raises(ValueError, match=r"`stop` must be \(low, high\) around"):
        jf.continue_bifurcation(system, ("omega", "f0"), sd_grazing, stop=(0.9, 1.0))
    assert BIFURCATION_KINDS[0] == "grazing"


def test_a_bifurcation_prints_its_conditions(sd_grazing):
    card = repr(sd_grazing)
    assert "grazing at omega = 0.86671658197" in card
    assert "d²H/dt² 0.75119" in card
    assert "Bifurcation in float32: grazing at omega = 0.8667" in repr(in_float32(sd_grazing))


class WallOnTheLeft(jf.System):
    """x'' + x'/10 + x = 0.3 cos 1.2t right of a wall at −0.7, where it bounces with e = 0.7."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -0.1 * x[1] - x[0] + 0.3 * jnp.cos(1.2 * t)])

    def switching(self, t, x):
        return x[0] + 0.7

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -0.7 * x[1]])

    @property
    def period(self):
        return 2 * np.pi / 1.2


@pytest.mark.release
@pytest.mark.parametrize("jitted", [False, True])
def test_the_margin_of_an_orbit_that_hits_is_no_maximum(jitted):
    """Without the wall it reaches A = 0.3/|1 − 1.44 + 0.12i| to either side: the search from the
    impact ends where H is largest, 0.7 + A."""
    system = WallOnTheLeft()
    orbit = jf.periodic_orbit(system, jnp.array([0.77384387, 0.41202521]))
    assert int(orbit.num_events) == 1
    margin = lambda s: jf.grazing_margin(s, orbit, throw=False)  # noqa: E731
    found = (eqx.filter_jit(margin) if jitted else margin)(system)
    assert outcome_names(found.result) == "no_tangency_found" and np.isnan(found.value)


class Follower(jf.System):
    """x follows cos 2(t − a) + 0.03 sin(t − a), whose least value is −1.03 at t = a + 3π/2. At a
    second surface, −sin(t − a − `shift`) = `cut` − 1.5 + `wall`, around that time or later, the
    orbit does not change."""

    late: jax.Array
    cut: jax.Array
    wall: jax.Array
    shift: jax.Array
    period = 2 * np.pi
    slides = False

    def vector_field(self, t, x, side):
        angle = t - self.late
        towards = jnp.cos(2 * angle) + 0.03 * jnp.sin(angle)
        return towards - 2 * jnp.sin(2 * angle) + 0.03 * jnp.cos(angle) - x

    def switching(self, t, x):
        gate = self.cut + jnp.sin(t - self.late - self.shift)
        return jnp.stack([x[0] + self.wall, gate - 1.5 + self.wall])


def follower(late, cut, shift=0.0):
    return Follower(*(jnp.float64(v) for v in (late, cut, 1.5, shift)))


@pytest.mark.parametrize(
    "late, cut, shift",
    [
        (0.1, 2.0, 0.0),
        (-0.1, 2.0, 0.0),
        (3.2, 0.54, 0.0),
        (-4.4, -0.54, 0.0),
        (0.1, 0.54, 0.95),
        (0.1, 0.54, 1.05),
        (0.1, 0.54, -1.05),
    ],
)
@pytest.mark.slow
def test_the_margin_is_that_of_the_lower_minimum(late, cut, shift):
    """Between the ends of steps, at which the other one is lower for one of these times; in a
    flight without the heights of the other one; in a flight past the end of the period; and 0.05
    after or before a contact, which is in the same step."""
    system = follower(late, cut, shift)
    orbit = jf.periodic_orbit(system, jnp.array([1.0]), steps=15)
    np.testing.assert_allclose(jf.grazing_margin(system, orbit), 0.47, rtol=0, atol=1e-7)


@pytest.mark.release
def test_the_margin_is_that_of_a_minimum_within_a_long_step():
    """The four ends of steps do not show it."""
    system = eqx.tree_at(lambda s: s.wall, follower(0.7, 4.0), jnp.float64(101.5))
    orbit = jf.periodic_orbit(system, jnp.array([1.0]), steps=2, stepper=jf.Taylor(32))
    np.testing.assert_allclose(jf.grazing_margin(system, orbit), 100.47, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_the_end_of_a_slide_is_no_graze():
    """H and its rate are zero there on every orbit that sticks, but for rounding."""
    values = np.linspace(1.2, 1.25, 24)
    orbits = belt_orbits(values)
    found = [jf.grazing_margin(lane(orbits.system, i), lane(orbits, i)) for i in range(values.size)]
    expected = [least_gap(omega) for omega in values]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


class Harvest(jf.System):
    """x' = −0.2π sin 2πt − (x − 1.5 − 0.1 cos 2πt), of which `taken` is removed, and the field
    raised by `more` for half of the time, at ticks. At a second surface nothing happens."""

    taken: jax.Array
    more: jax.Array
    slides = False
    period = 1.0
    clocks = (jf.Clock(0.5, 0.3),)

    def vector_field(self, t, x, side):
        w = 2 * jnp.pi * t
        raised = self.more * jnp.where(jnp.mod(t - 0.3, 1.0) < 0.5, 1.0, -1.0)
        return raised - 0.2 * jnp.pi * jnp.sin(w) - (x - 1.5 - 0.1 * jnp.cos(w))

    def switching(self, t, x):
        return jnp.stack([x[0], jnp.sin(2 * jnp.pi * (t - 0.1))])

    def tick(self, t, x, clock):
        return x - self.taken * jnp.where(jnp.sin(2 * jnp.pi * t) < 0, 1.0, 0.0)


@pytest.mark.release
@pytest.mark.parametrize("taken, more", [(0.3, 0.0), (0.0, 2.0)])
def test_a_least_value_at_a_tick_is_no_margin(taken, more):
    """Just after a removal, and at a corner; a minimum elsewhere is farther from the surface."""
    system = Harvest(jnp.float64(taken), jnp.float64(more))
    orbit = jf.periodic_orbit(system, jnp.array([1.3]), steps=50)
    found = jf.grazing_margin(system, orbit, throw=False)
    assert outcome_names(found.result) == "no_tangency_found" and np.isnan(found.value)


def test_a_flight_is_lost_where_another_surface_is_reached_for_a_short_while():
    """Before `wall` = 1.03, where the orbit would graze, the second surface is reached beside the
    tangency, for 1/100 of the period in the end. It is grazed at `wall` = 2.5 − `cut`."""
    system = follower(0.1, 0.47 + np.cos(0.03), 1.5 * np.pi / 16)
    orbit = jf.periodic_orbit(system, jnp.array([1.0]), steps=15)
    found = jf.find_bifurcation(system, "wall", orbit, "grazing")
    assert (int(orbit.num_events), int(found.tangency.surface)) == (0, 1)
    np.testing.assert_allclose(found.value, 2.03 - np.cos(0.03), rtol=0, atol=1e-9)


class Square(jf.System):
    """x'' + x' + x is the force for half a period T, from −T/4 on, and its negative for the other
    half, below a stop at 1."""

    force: jax.Array
    omega: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        sign = jnp.where(jnp.mod(t + self.period / 4, self.period) < self.period / 2, 1.0, -1.0)
        return jnp.stack([x[1], sign * self.force - x[1] - x[0]])

    def switching(self, t, x):
        return 1.0 - x[0]

    def reset(self, t, x, surface):
        return x.at[1].multiply(-0.5)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega

    @property
    def clocks(self):
        return (jf.Clock(self.period / 2, self.period / 4),)


@pytest.mark.slow
def test_a_field_may_jump_next_to_a_touch():
    """From −T/4 on x is 1 + e^(Bs)(z − 1) per force, and after half a period −z. The jump follows
    the touch by 1/100 of the period, and turns the guard as much as seven times faster."""
    matrix, one = np.array([[0.0, 1.0], [-1.0, -1.0]]), np.array([1.0, 0.0])
    for omega in (0.852357, 0.851211, 0.850064, 0.848915):
        half = scipy.linalg.expm(matrix * np.pi / omega)
        z = -np.linalg.solve(np.eye(2) + half, (np.eye(2) - half) @ one)
        flow = lambda s, z=z: one + scipy.linalg.expm(matrix * s) @ (z - one)  # noqa: E731
        time = scipy.optimize.brentq(lambda s, flow=flow: flow(s)[1], 2, np.pi / omega, xtol=1e-14)
        top = flow(time)[0]
        system = Square(jnp.float64(0.9 / top), jnp.float64(omega))
        orbit = jf.periodic_orbit(system, jnp.asarray(0.9 / top * flow(np.pi / omega / 2)))
        found = jf.find_bifurcation(system, "force", orbit, "grazing")
        np.testing.assert_allclose(found.value, 1 / top, rtol=0, atol=1e-11)


class Runaway(jf.System):
    """x' = 6x + cos t above −`wall`. A difference from the orbit −cos(t + a)/√37 grows by e^(12π)
    in a period."""

    wall: jax.Array
    slides = False
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return 6 * x + jnp.cos(t)

    def switching(self, t, x):
        return x[0] + self.wall


@pytest.mark.slow
def test_the_margin_of_an_unstable_orbit_is_found_in_segments():
    system = Runaway(jnp.float64(0.6))
    orbit = jf.periodic_orbit(system, jnp.array([-0.16]), segments=8, steps=160)
    margin = jf.grazing_margin(system, orbit)
    graze = jf.find_bifurcation(system, "wall", orbit, "grazing")
    least = 1 / np.sqrt(37)
    np.testing.assert_allclose([margin, graze.value], [0.6 - least, least], rtol=0, atol=1e-9)
    multiplier = np.exp(12 * np.pi)
    np.testing.assert_allclose(graze.orbit.multipliers, [multiplier], rtol=1e-9)


class Filter(jf.System):
    """y' = a cos t − c y, whose orbit has the amplitude a/√(1 + c²), below y = 1."""

    a: jax.Array
    c: jax.Array
    slides = False
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return self.a * jnp.cos(t) - self.c * x

    def switching(self, t, x):
        return 1.0 - x[0]


@pytest.mark.release
def test_a_margin_and_a_value_have_second_derivatives():
    a, c = jnp.float64(1.0), jnp.float64(0.8)
    orbit = jf.periodic_orbit(Filter(a, c), jnp.array([0.5]), steps=24)

    def margin(p):
        return jf.grazing_margin(Filter(*p), orbit, throw=False).value

    exact = jax.hessian(lambda p: 1 - p[0] / jnp.sqrt(1 + p[1] ** 2))(jnp.stack([a, c]))
    found = jax.jit(jax.jacfwd(jax.grad(margin)))(jnp.stack([a, c]))
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-9)

    def value(c):
        return jf.find_bifurcation(Filter(a, c), "a", orbit, "grazing", throw=False).value

    np.testing.assert_allclose(jax.grad(jax.grad(value))(c), (1 + c**2) ** -1.5, rtol=1e-8)


@pytest.mark.slow
def test_a_margin_has_derivatives_by_a_number_that_functions_close_over():
    """x'' + x'/2 + 2 x = k cos t has the amplitude k/|1 + i/2|, and a wall at 3."""

    def driven(k):
        class Driven(jf.System):
            period = 2 * np.pi
            slides = False

            def vector_field(self, t, x, side):
                return jnp.stack([x[1], k * jnp.cos(t) - 0.5 * x[1] - 2 * x[0]])

            def switching(self, t, x):
                return 3.0 - x[0]

        return Driven()

    orbit = jf.periodic_orbit(driven(1.0), jnp.array([0.8, 0.4]), steps=20)
    margin, slope = jax.value_and_grad(lambda k: jf.grazing_margin(driven(k), orbit))(1.0)
    np.testing.assert_allclose(margin, 3 - 1.25**-0.5, rtol=1e-9)
    np.testing.assert_allclose(slope, -(1.25**-0.5), rtol=1e-8)


class Bilinear(jf.System):
    """x'' + x'/10 + x + 8 (x − 1)₊ = A cos ωt, whose field is continuous."""

    a: jax.Array
    slides = False
    period = 2 * np.pi / 1.6

    def vector_field(self, t, x, side):
        spring = 4 * (1 + side) * (x[0] - 1)
        return jnp.stack([x[1], self.a * jnp.cos(1.6 * t) - x[0] - 0.1 * x[1] - spring])

    def switching(self, t, x):
        return x[0] - 1


@pytest.mark.slow
def test_a_continuous_field_has_no_sliding_bifurcation():
    """The linear amplitude is 1 at A = |1 − ω² + 0.1 iω|; the other side's rate is rounding."""
    grazing = np.hypot(1 - 1.6**2, 0.1 * 1.6)
    for start in (0.7, 0.9):
        system = Bilinear(jnp.array(start * grazing))
        orbit = jf.periodic_orbit(system, jnp.zeros(2), transient=60)
        (found,) = jf.find_bifurcations(system, "a", orbit, stop=1.1 * grazing)
        assert found.kind == "grazing"
        np.testing.assert_allclose(found.value, grazing, rtol=1e-12)
