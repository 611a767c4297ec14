"""Branches of orbits: folds, period doublings, changes of the contacts, where a branch ends."""

import functools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.figure
import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.optimize import brentq, fsolve, minimize_scalar

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names
from tests.oracles.sticking_map import slope, stick_map
from tests.pictures import made
from tests.problems import PROBLEMS, closed_forms
from tests.problems.systems import ShakenTable, belt, cubic_belt
from tests.problems.values import BELT_ADDS, BELT_CHANGES, BELT_GRAZES, BELT_HIGHEST, SD_GRAZES

matplotlib.use("Agg")

S = jf.systems
ZETA = closed_forms.ZETA


def of_kind(branch, kind):
    return [point for point in branch.points if point.kind == kind]


class Symmetric:
    """The symmetric crossing orbit of the SD oscillator, x(t + T/2) = -x(t), in closed form.

    From an upward zero on, x = 1 + e^(-ζt)(A cos dt + B sin dt) + Re(R e^(i(Ωt + φ))). The forced
    part is odd under half a period, so that the rest must be: two linear equations for A and B.
    Then x = 0 at the start, 1 + A + |R| cos(φ + arg R) = 0, has two solutions, which meet in a
    fold."""

    def __init__(self, omega):
        self.omega = omega
        self.half = np.pi / omega
        self.response = closed_forms.response(omega)
        d = np.sqrt(1 - ZETA**2)
        c, s = np.cos(d * self.half), np.sin(d * self.half)
        # The free part and its rate, by its own start (p, q), after half a period.
        decay = np.exp(-ZETA * self.half)
        self.free = decay * np.asarray([[c + ZETA / d * s, s / d], [-s / d, c - ZETA / d * s]])
        self.a, self.rate = np.linalg.solve(self.free + np.eye(2), [-2.0, 0.0])

    @property
    def excess(self):
        """Positive where both orbits exist, zero at the fold."""
        return abs(self.response) - abs(1 + self.a)

    def multipliers(self, which):
        angle = which * np.arccos(-(1 + self.a) / abs(self.response))
        speed = self.rate - self.omega * abs(self.response) * np.sin(angle)
        # Down through x = 0 at the speed -v, x'' jumps by -2: the saltation matrix.
        jump = np.asarray([[1, 0], [2 / speed, 1]])
        return np.linalg.eigvals(jump @ self.free @ jump @ self.free)


@functools.cache
def sd_branch():
    orbit = jf.periodic_orbit(S.SDOscillator(omega=0.7), jnp.asarray([2.97, 0.62]))
    return jf.continue_orbit(S.SDOscillator(), "omega", orbit, stop=(0.68, 1.0))


@pytest.mark.slow
@pytest.mark.long_run
def test_sd_oscillator_folds_where_the_closed_form_does():
    (fold,) = of_kind(sd_branch(), "fold")
    exact = brentq(lambda w: Symmetric(w).excess, 0.9, 0.99, xtol=1e-15)
    assert_allclose(exact, 0.932, rtol=0, atol=1e-3)
    assert_allclose(fold.value, exact, rtol=0, atol=1e-8)
    assert_allclose(max(abs(fold.orbit.multipliers)), 1, rtol=0, atol=1e-5)
    assert_allclose(sd_branch().values.max(), exact, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_sd_oscillator_has_a_saddle_beyond_the_fold():
    orbits = sd_branch().at(0.9)
    assert len(orbits) == 2
    for which, orbit in zip((-1, 1), orbits, strict=True):
        exact = Symmetric(0.9).multipliers(which)
        assert_allclose(
            np.sort_complex(orbit.multipliers), np.sort_complex(exact), rtol=0, atol=1e-8
        )
    assert_allclose(max(orbits[1].multipliers.real), 1.24332, rtol=0, atol=5e-6)
    assert bool(orbits[0].stable) and not bool(orbits[1].stable)


@pytest.mark.slow
def test_a_branch_that_ends_says_so():
    # The one-sided orbit: amplitude f0/√((1 - Ω²)² + (2ζΩ)²), grazes at amplitude 1 and is gone.
    x0 = jnp.asarray(closed_forms.one_sided(0.85))
    orbit = jf.periodic_orbit(S.SDOscillator(omega=0.85), x0)
    branch = jf.continue_orbit(S.SDOscillator(), "omega", orbit, stop=0.95)
    assert branch.ended[1].startswith("no orbit was found beyond 0.8667165")
    assert branch.ended[1].endswith(" (the shortest step leads away from it)")
    assert_allclose(branch.values[-1], SD_GRAZES[0], rtol=0, atol=1e-8)
    assert branch.ended[0] == "start at 0.85" and not branch.points
    assert outcome_names(branch.result) == "successful"
    assert branch.stable.all()


STEPS = 100


@pytest.mark.slow
def test_belt_begins_to_stick_where_its_orbit_grazes():
    # Grazing-sliding of the orbit that slips for ever.
    orbit = jf.periodic_orbit(belt(12.0), jnp.asarray([0.55, 0.0]), steps=STEPS)
    branch = jf.continue_orbit(belt(12.0), "omega", orbit, stop=9.0)
    (point,) = branch.points
    assert point.kind == "contacts" and (len(point.before), len(point.after)) == (0, 2)
    assert_allclose(point.value, BELT_GRAZES[1], rtol=0, atol=1e-9)
    assert branch.ended == ("start at 12", "omega = 9 was reached")
    assert isinstance(branch.values, np.ndarray)
    assert branch.stable.all() and branch.values[-1] == 9.0
    (orbit,) = branch.at(9.1)
    assert_allclose(orbit.x0, PROBLEMS["belt 9.1"].x0, rtol=0, atol=1e-10)
    assert "contacts at 10.9049758221: 0 to 2 contacts" in repr(branch)


@pytest.mark.release
def test_belt_adds_a_slide():
    orbit = jf.periodic_orbit(belt(1.5), jnp.asarray([1.6, 1.0]), steps=STEPS)
    branch = jf.continue_orbit(belt(1.5), "omega", orbit, stop=1.6)
    values = [p.value for p in of_kind(branch, "contacts")]
    assert_allclose(values, [BELT_ADDS], rtol=0, atol=1e-9)
    (orbit,) = branch.at(1.55)
    assert_allclose(orbit.extremes()[1][1], BELT_HIGHEST[1.55], rtol=0, atol=1e-9)


@pytest.mark.release
@pytest.mark.long_run
def test_belt_from_one_end_to_the_other():
    orbit = jf.periodic_orbit(belt(12.0), jnp.asarray([0.55, 0.0]), steps=STEPS)
    branch = jf.continue_orbit(belt(12.0), "omega", orbit, stop=(0.5, 20.0), max_step=0.05)
    assert (branch.values[0], branch.values[-1]) == (0.5, 20.0)
    values = [p.value for p in of_kind(branch, "contacts")]
    assert_allclose(values, BELT_CHANGES, rtol=0, atol=6e-4)
    exact = [BELT_GRAZES[0], BELT_ADDS, BELT_GRAZES[1]]
    assert_allclose([values[0], values[3], values[8]], exact, rtol=0, atol=1e-9)
    for omega, speed in BELT_HIGHEST.items():
        (orbit,) = branch.at(omega)
        assert_allclose(orbit.extremes()[1][1], speed, rtol=0, atol=1e-9)


@functools.cache
def cubic_branch():
    """The sticking orbits of the belt with a cubic spring, from 4.56 round their fold."""
    system = cubic_belt(4.56)
    orbit = jf.periodic_orbit(system, jnp.asarray([0.08, 0.48]), steps=STEPS)
    return jf.continue_orbit(system, "omega", orbit, stop=(4.4, 4.56))


def sticking_at(orbit):
    """A time at which an orbit sticks, and x1 then: the middle of the longest stick."""
    count = int(orbit.num_events)
    ts, after = np.asarray(orbit.events.ts)[:count], np.asarray(orbit.events.modes)[:count, 0]
    ends = np.append(ts[1:], ts[0] + float(orbit.period))
    longest = np.argmax(np.where(after == 0, ends - ts, 0))
    t = 0.5 * (ts[longest] + ends[longest]) % float(orbit.period)
    return t, float(orbit.states(jnp.asarray([t, t]))[0, 0])


@pytest.mark.parametrize(
    ("kind", "multiplier", "near"),
    [pytest.param("fold", 1, 4.4566, marks=pytest.mark.release), ("period-doubling", -1, 4.4964)],
)
@pytest.mark.slow
def test_belt_with_a_cubic_spring(kind, multiplier, near):
    (point,) = of_kind(cubic_branch(), kind)
    assert_allclose(point.value, near, rtol=0, atol=1e-4)
    t0, x1 = sticking_at(point.orbit)

    def equations(z):
        return [stick_map(z[0], t0, z[1]) - z[1], 0.1 * (slope(z[0], t0, z[1]) - multiplier)]

    omega, _ = fsolve(equations, [near, x1], xtol=1e-11)
    assert_allclose(point.value, omega, rtol=0, atol=1e-7)


def test_both_sticking_orbits_are_unstable():
    orbits = cubic_branch().at(4.56)
    assert len(orbits) == 2
    assert not any(bool(orbit.stable) for orbit in orbits)
    for orbit in orbits:
        assert abs(orbit.multipliers).min() < 1e-12
        t0, x1 = sticking_at(orbit)
        largest = orbit.multipliers[jnp.argmax(abs(orbit.multipliers))]
        assert_allclose(stick_map(4.56, t0, x1), x1, rtol=0, atol=1e-9)
        assert_allclose(largest.real, slope(4.56, t0, x1), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_the_doubled_branch_leaves_from_the_period_doubling():
    (point,) = of_kind(cubic_branch(), "period-doubling")
    system = cubic_belt(4.5)
    doubled = jf.continue_orbit(system, "omega", point, stop=4.51, max_points=12)
    assert doubled.periods == 2
    orbit = doubled.orbits
    assert_allclose(orbit.period, 4 * np.pi / doubled.values, rtol=1e-12)
    # Beside the point the two sections lie on both sides of the single orbit's, and the multiplier
    # is near 1 = (-1)². Halfway, it is another state.
    assert_allclose(doubled.values[0], point.value, rtol=0, atol=1e-2)
    assert abs(np.asarray(orbit.multipliers[0])).max() == pytest.approx(1, abs=0.2)
    t0, x1 = sticking_at(
        jf.periodic_orbit(cubic_belt(doubled.values[-1]), orbit.x0[-1], periods=2, steps=STEPS)
    )
    omega = doubled.values[-1]
    once = stick_map(omega, t0, x1)
    assert abs(once - x1) > 1e-4
    assert_allclose(stick_map(omega, t0, once), x1, rtol=0, atol=1e-8)


@pytest.mark.release
def test_round_the_grazing_of_a_wall():
    # Where the orbit touches the wall at x = 1.
    grazing = closed_forms.wall_amplitude(1.2)
    response = 0.45 / (1 - 1.2**2 + 0.12j)
    system = S.ImpactOscillator(omega=1.2, amplitude=0.45)
    x0 = jnp.asarray([response.real, (1.2j * response).real])
    orbit = jf.periodic_orbit(system, x0)
    branch = jf.continue_orbit(system, "amplitude", orbit, stop=(0.4, 0.5))
    point = of_kind(branch, "contacts")[0]
    assert_allclose(point.value, grazing, rtol=0, atol=1e-8)
    assert (len(point.before), len(point.after)) == (0, 1)
    beyond = branch.orbits.num_events[point.index + 1 :]
    assert len(beyond) > 3 and (beyond == 1).all()
    assert (branch.orbits.residual < 1e-10).all()


@pytest.mark.slow
def test_an_impacting_orbit_comes_to_its_graze():
    """Both branches lie below the amplitude of the graze, and the way round its corner is acute: a
    short step arrives beyond it, on the other branch. Nearer than the square root of rounding no
    impact is seen."""
    response = 0.43 / (1 - 1.2**2 + 0.12j)
    system = S.ImpactOscillator(omega=1.2, amplitude=0.43)
    orbit = jf.periodic_orbit(system, jnp.asarray([-0.9704, 0.3308]))
    assert int(orbit.num_events) == 1
    branch = jf.continue_orbit(system, "amplitude", orbit, stop=(0.42, 0.5))
    (point,) = of_kind(branch, "contacts")
    assert_allclose(point.value, closed_forms.wall_amplitude(1.2), rtol=0, atol=1e-10)
    assert (len(point.before), len(point.after)) == (1, 0)
    # On to the orbit that does not touch the wall.
    (free,) = [o for o in branch.at(0.43) if int(o.num_events) == 0]
    assert_allclose(free.x0, [response.real, (1.2j * response).real], rtol=0, atol=1e-9)
    assert branch.ended == ("amplitude = 0.42 was reached",) * 2


def amplitude_of_impacts(speed):
    """By hand, of a wall at 1, a resonance at 1, damping 0.1 and restitution 0.8: the force at
    which the orbit with one impact a period leaves the wall with a speed. A flight, of one period,
    is e^{-ct/2} (a cos + b sin) + P cos t + Q sin t."""
    c, e, period = 0.1, 0.8, 2 * np.pi
    w = np.sqrt(1 - c * c / 4)
    decay, cos, sin = np.exp(-c * period / 2), np.cos(w * period), np.sin(w * period)
    rates = [
        [-c / 2, w, 0, 1],
        [decay * (-c / 2 * cos - w * sin), decay * (-c / 2 * sin + w * cos), 0, 1],
    ]
    rows = [[1, 0, 1, 0], [decay * cos, decay * sin, 1, 0], *rates]
    _, _, p, q = np.linalg.solve(rows, [1, 1, -speed, speed / e])
    return c * np.hypot(p, q)


@pytest.mark.release
def test_a_branch_goes_on_where_a_resonance_grazes():
    """The orbit with an impact begins at the graze, A = 0.1, turns at a fold 3e-5 below, and goes
    on above: the way round that corner is so sharp that no guess close by finds it."""
    system = jf.systems.ImpactOscillator(omega=1.0, amplitude=0.08)
    orbit = jf.periodic_orbit(system, jnp.array([0.0, 0.5]), steps=40)
    branch = jf.continue_orbit(system, "amplitude", orbit, stop=(0.07, 0.102))
    assert "no orbit" not in "".join(branch.ended)
    points = {p.kind: p.value for p in branch.points}
    assert_allclose(points["contacts"], 0.1, rtol=0, atol=1e-9)
    # In an orbit with one impact a period the last speed is e times the one before.
    speeds = 0.8 * branch.orbits.events.xs[:, 0, 1]
    hits = np.array([len(s) == 1 for s in branch.sequences])
    exact = [amplitude_of_impacts(v) for v in speeds[hits]]
    assert_allclose(branch.values[hits], exact, rtol=0, atol=1e-11)
    least = minimize_scalar(amplitude_of_impacts, bounds=(1e-3, 0.3), options={"xatol": 1e-9})
    assert_allclose(points["fold"], least.fun, rtol=0, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [0.0, -0.03])
def test_a_parameter_goes_to_zero_and_through_it(stop):
    # Below the wall x'' + c x' + x = A cos Ωt: without damping the response has no phase.
    response = lambda c: 0.3 / (1 - 1.2**2 + 1.2j * np.asarray(c))  # noqa: E731
    z = response(0.1)
    system = S.ImpactOscillator(omega=1.2, amplitude=0.3)
    orbit = jf.periodic_orbit(system, jnp.asarray([z.real, -1.2 * z.imag]), steps=16)
    branch = jf.continue_orbit(system, "damping", orbit, stop=stop, max_step=0.1)
    assert branch.ended[1] == f"damping = {stop:g} was reached"
    z = response(branch.values)
    exact = np.stack([z.real, -1.2 * z.imag], axis=1)
    assert_allclose(branch.orbits.x0, exact, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_force_goes_through_zero_and_the_orbit_with_it():
    z = 0.3 / (1 - 1.2**2 + 0.12j)
    system = S.ImpactOscillator(omega=1.2, amplitude=0.3)
    orbit = jf.periodic_orbit(system, jnp.asarray([z.real, -1.2 * z.imag]), steps=16)
    branch = jf.continue_orbit(system, "amplitude", orbit, stop=-0.1, max_step=0.1)
    assert branch.ended[1] == "amplitude = -0.1 was reached"
    exact = np.outer(branch.values / 0.3, [z.real, -1.2 * z.imag])
    assert_allclose(branch.orbits.x0, exact, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_special_point_is_drawn_on_the_curve():
    # Between the orbits number 1 and 2, halfway.
    orbit = sd_branch().points[0].orbit
    point = jf.SpecialPoint("contacts", 1.5, orbit, 2, (), (), np.zeros(3))
    orbits = SimpleNamespace(x0=np.asarray([[0.0, 0], [1, 0], [4, 0]]), system=S.SDOscillator())
    told = {"parameter": "a", "values": np.arange(3.0), "points": [point]}
    branch = made(jf.Branch, **told, orbits=orbits, stable=np.ones(3, bool))
    marker = jf.plot.branch(branch, ax=matplotlib.figure.Figure().subplots()).lines[-1]
    assert marker.get_xydata().tolist() == [[1.5, 2.5]]


@pytest.mark.slow
def test_a_branch_draws_itself():
    branch = sd_branch()
    ax = branch.plot(component=1)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Ω", "x' at t0")
    labels = [line.get_label() for line in ax.lines]
    assert labels == ["stable", "unstable", "fold"]
    solid, dashed, fold = ax.lines
    assert (solid.get_linestyle(), dashed.get_linestyle()) == ("-", "--")
    x0 = np.asarray(branch.orbits.x0)[:, 1]
    (at,) = (point.value for point in of_kind(branch, "fold"))
    for line, kept in ((solid, branch.stable), (dashed, ~branch.stable)):
        x, y = line.get_data()
        np.testing.assert_array_equal(x[x != at], branch.values)
        np.testing.assert_array_equal(y[x != at][kept], x0[kept])
        assert np.isfinite(y[x == at])  # the style changes at the fold
    assert fold.get_xdata() == [at]
    _, own = plt.subplots()
    assert jf.plot.branch(branch, ax=own, extremes=True) is own
    least, most = branch.extremes()
    assert_allclose(least, -most, rtol=1e-8)
    assert len(own.lines) == 6
    plt.close("all")
    with pytest.raises(ValueError, match="`component` must be an integer from 0 to 1, got 2"):
        branch.plot(component=2)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"system": S.SDOscillator}, "`system` must be an instance"),
        ({"parameter": "omegaa"}, "`parameter` must be a parameter of SDOscillator, one of f0"),
        ({"orbit": jnp.zeros(2)}, "`orbit` must be a single Orbit or a SpecialPoint"),
        ({"orbit": "batch"}, "`orbit` must be a single Orbit or a SpecialPoint"),
        ({"orbit": "fold"}, "`orbit` must be a period doubling or a branch point, got a fold"),
        ({"stop": "there"}, r"`stop` must be a number or a pair \(low, high\), got 'there'"),
        ({"stop": float("nan")}, "`stop` must be a number or a pair"),
        ({"stop": (0.1, 0.2, 0.3)}, "`stop` must be a number or a pair"),
        ({"stop": (0.8, 0.9)}, r"`stop` must be \(low, high\) around the value"),
        ({"max_points": 0}, "`max_points` must be an integer of at least 1, got 0"),
        ({"max_step": -0.1}, "`max_step` must be a positive number, got -0.1"),
    ],
)
def test_bad_calls(change, message):
    branch = sd_branch()
    first = branch.at(branch.values[0])[0]
    call = {"system": S.SDOscillator(), "parameter": "omega", "orbit": first, "stop": 0.8} | change
    special = {"batch": branch.orbits, "fold": of_kind(branch, "fold")[0]}
    orbit = call["orbit"]
    call["orbit"] = special[orbit] if isinstance(orbit, str) else orbit
    with pytest.raises(ValueError, match=message):
        jf.continue_orbit(call.pop("system"), call.pop("parameter"), call.pop("orbit"), **call)


# The orbits of the SD oscillator are none of this one's.
OTHER = S.SDOscillator(f0=0.4, zeta=-1.0)


@pytest.mark.parametrize("start", ["orbit", "period doubling"])
def test_an_orbit_of_another_system_is_an_outcome(start):
    first = sd_branch().at(0.7)[0]
    doubling = jf.SpecialPoint("period-doubling", 0.7, first, 0, (), (), np.zeros(3))
    given = {"orbit": first, "period doubling": doubling}[start]
    branch = jf.continue_orbit(OTHER, "omega", given, stop=0.8, throw=False)
    assert outcome_names(branch.result) == "newton_stalled"
    assert_allclose(branch.values, [0.7], rtol=1e-15)
    assert_array_equal(branch.orbits.x0, first.x0[None])
    assert isinstance(branch.values, np.ndarray)
    assert branch.points == [] and branch.ended == ("no branch was found at 0.7",) * 2
    assert "newton_stalled: Newton's method cannot" in repr(branch)
    with pytest.raises(eqx.EquinoxRuntimeError, match="cannot reduce the residual"):
        jf.continue_orbit(OTHER, "omega", given, stop=0.8)
    with pytest.raises(ValueError, match="`stop` must be a number or a pair"):
        jf.continue_orbit(OTHER, "omega", given, stop=np.nan, throw=False)


@pytest.mark.parametrize("omega, x", [(0.7, np.nan), (np.nan, 1.0)])
def test_an_orbit_that_was_not_found_keeps_its_outcome(omega, x):
    lost = jf.periodic_orbit(S.SDOscillator(omega=omega), jnp.asarray([x, 0.0]), throw=False)
    found = jf.find_bifurcations(S.SDOscillator(), "omega", lost, stop=0.8, throw=False)
    assert outcome_names(found.result) == outcome_names(found.branch.result) == "nonfinite"
    assert len(found) == 0 and "nonfinite: The state" in repr(found)
    with pytest.raises(eqx.EquinoxRuntimeError, match="is not finite"):
        jf.find_bifurcations(S.SDOscillator(), "omega", lost, stop=0.8)


def thrown_once(a, phase, t0):
    """The state at t0 of the ball that is hit once a period at a phase, and flies with a speed of
    π: a cos(phase) = π/3."""
    since = (t0 - phase) % (2 * np.pi)
    return np.array([a * np.sin(phase) + np.pi * since - since**2 / 2, np.pi - since])


@pytest.mark.slow
@pytest.mark.parametrize("t0", [pytest.param(0.0, marks=pytest.mark.release), 0.3])
def test_an_impact_passes_the_phase_of_shooting(t0):
    # x(t0) jumps there, at the fold itself for t0 = 0, and the orbit does not.
    a, fold = 1.2, np.pi / 3
    system, start = ShakenTable(jnp.asarray(a), 0.5), thrown_once(a, np.arccos(fold / a), t0)
    orbit = jf.periodic_orbit(system, jnp.asarray(start), t0=t0)
    branch = jf.continue_orbit(system, "a", orbit, stop=(0.8, 1.7))
    assert branch.ended == ("a = 1.7 was reached",) * 2
    assert [point.kind for point in branch.points] == ["fold", "period-doubling"]
    right = [fold, np.hypot(fold, 2.5 / 2.25)]
    assert_allclose([point.value for point in branch.points], right, rtol=1e-8, atol=0)
    meets = fold / np.cos(t0)
    for value, x0 in zip(branch.values, np.asarray(branch.orbits.x0), strict=True):
        if abs(value - meets) > 1e-6:
            phase = np.arccos(np.minimum(fold / value, 1.0))
            seen = [thrown_once(value, p, t0) for p in (phase, -phase)]
            assert min(abs(x0 - x).max() for x in seen) < 1e-6


class Firing(jf.System):
    """v' = I + cos(2πt)/2 − v, from 1 to 0 at once. It fires at the time θ of each period where
    (1 − 1/e) (I + q(θ)/2) = 1."""

    drive: jax.Array
    slides = False
    period = 1.0

    def vector_field(self, t, x, side):
        return self.drive + 0.5 * jnp.cos(2 * jnp.pi * t) - x

    def switching(self, t, x):
        return 1 - x[0]

    def reset(self, t, x, surface):
        return 0 * x


def firing_at(theta):
    """The drive of this θ, and v at t = 0."""
    q = lambda t: (np.cos(2 * np.pi * t) + 2 * np.pi * np.sin(2 * np.pi * t)) / (1 + 4 * np.pi**2)  # noqa: E731
    drive = 1 / (1 - np.exp(-1)) - 0.5 * q(theta)
    return drive, drive + 0.5 * q(0) - (drive + 0.5 * q(theta)) * np.exp(-(-theta % 1))


@pytest.mark.slow
def test_orbits_at_values_where_a_contact_passes_the_phase_of_shooting():
    """v(0) jumps from 0 to 1 between two neighbours; another orbit has a v(0) between."""
    drive, v = firing_at(-0.1)
    orbit = jf.periodic_orbit(Firing(jnp.asarray(drive)), jnp.asarray([v]), steps=20)
    branch = jf.continue_orbit(orbit.system, "drive", orbit, stop=firing_at(0.1)[0])
    i = int(np.argmax(abs(np.diff(branch.orbits.x0[:, 0]))))
    assert abs(branch.orbits.x0[i + 1, 0] - branch.orbits.x0[i, 0]) > 0.9
    for theta in (-2e-4, 2e-4, 8e-4, 1.5e-3):
        drive, v = firing_at(theta)
        (found,) = branch.at(drive)
        assert_allclose(found.x0, [v], rtol=0, atol=1e-9)
        assert bool(found.stable)


class Dripping(jf.System):
    """A drop grows with V' = 1 and falls at 1 + h/2, with h := r h (1 − h)."""

    r: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.ones_like(t), jnp.zeros_like(t)])

    def switching(self, t, x):
        return 1 + 0.5 * x[1] - x[0]

    def reset(self, t, x, surface):
        return jnp.stack([0 * x[0], self.r * x[1] * (1 - x[1])])


@pytest.mark.slow
def test_a_doubled_orbit_with_resets_does_not_return_to_its_start():
    """A straight line over a reset passes nearer to the start than the orbit does. The logistic map
    doubles at 3 and 1 + √6."""
    steps = {"steps": 8, "stepper": jf.RK4()}
    start = jnp.array([0.3, 1 - 1 / 2.9])
    orbit = jf.periodic_orbit(Dripping(jnp.float64(2.9)), start, period=1.33, **steps)
    single = jf.continue_orbit(orbit.system, "r", orbit, stop=3.1)
    (point,) = single.points
    doubled = jf.continue_orbit(orbit.system, "r", point, stop=3.5)
    assert doubled.ended[1] == "r = 3.5 was reached"
    assert [p.kind for p in doubled.points] == ["period-doubling"]
    assert_allclose([point.value, doubled.points[0].value], [3, 1 + np.sqrt(6)], rtol=1e-9)


class Ticked(jf.System):
    """x' = −x, and x + 1 at the time late in each period, without a surface."""

    late: jax.Array
    period = 1.0

    def vector_field(self, t, x, side):
        return -x

    def tick(self, t, x, clock):
        return x + 1

    @property
    def clocks(self):
        return (jf.Clock(1.0, self.late),)


def test_a_tick_passes_the_phase_of_shooting():
    system = Ticked(jnp.float64(0.2))
    orbit = jf.periodic_orbit(system, jnp.ones(1), steps=8)
    branch = jf.continue_orbit(system, "late", orbit, stop=-0.3, max_step=0.2)
    assert branch.values[-1] == -0.3
    away = abs(branch.values) > 1e-6
    highest = 1 / (1 - np.exp(-1))
    exact = highest * np.exp(-np.mod(-branch.values[away], 1))
    assert_allclose(branch.orbits.x0[away, 0], exact, rtol=1e-7)


class Thermostat(jf.System):
    """A room that cools towards 10 and warms towards 35, switched at 18 and `high`."""

    high: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([10.0 - x[0] + 25.0 * x[1], 0 * x[1]])

    def switching(self, t, x):
        return jnp.stack([self.high - x[0], x[0] - 18.0])

    def reset(self, t, x, surface):
        return jnp.stack([x[0], jnp.where(surface == 0, 0.0, 1.0)])


@pytest.mark.release
def test_a_contact_passes_the_state_from_which_an_autonomous_orbit_is_shot():
    """The branch starts from 20 degrees, and its orbits end below."""
    system = Thermostat(jnp.float64(20.5))
    orbit = jf.periodic_orbit(system, jnp.array([20.0, 1.0]), period=0.45, steps=8)
    branch = jf.continue_orbit(system, "high", orbit, stop=19.0, max_step=0.2)
    assert branch.values[-1] == 19.0
    exact = np.log((branch.values - 10) / 8) + np.log(17 / (35 - branch.values))
    assert_allclose(branch.orbits.period, exact, rtol=1e-8)


class TwoLinear(jf.System):
    """Two oscillators on their own, x'' + a x' + k x = cos t and y'' + c y' + 2 y = cos t."""

    a: jax.Array
    k: jax.Array
    c: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        first = jnp.cos(t) - self.a * x[1] - self.k * x[0]
        return jnp.stack([x[1], first, x[3], jnp.cos(t) - self.c * x[3] - 2 * x[2]])


@pytest.mark.slow
@pytest.mark.parametrize("name, start, stop, found", [("k", 0.05, 0.005, 0), ("c", 0.3, -0.3, 1)])
def test_pairs_of_multipliers_are_told_apart(name, start, stop, found):
    """One pair is outside of the circle. It turns real where k = a²/4; the other pair crosses the
    circle where c = 0."""
    system = TwoLinear(*map(jnp.asarray, (-0.2, 0.05, 0.3)))
    orbit = jf.periodic_orbit(system, jnp.zeros(4))
    branch = jf.continue_orbit(system, name, orbit, stop=stop)
    points = [p.value for p in branch.points if p.kind == "neimark-sacker"]
    assert_allclose(points, [0.0] * found, rtol=0, atol=1e-8)


class Multiplied(jf.System):
    """x is multiplied by A + p B at each tick."""

    p: jax.Array
    a: jax.Array
    b: jax.Array
    period = 1.0
    clocks = (jf.Clock(1.0, 0.5),)

    def vector_field(self, t, x, side):
        return jnp.zeros_like(x)

    def tick(self, t, x, clock):
        return (self.a + self.p * self.b) @ x


def entry(i, j):
    return np.eye(3)[:, [i]] * np.eye(3)[[j]]


@pytest.mark.parametrize(
    "a, b, stop, found",
    [
        # Two multipliers −p.
        (0.3 * entry(2, 2), -entry(0, 0) - entry(1, 1), 1.2, [("period-doubling", 1.0)]),
        # μ² − 1.999 μ + p, whose real roots meet at p = 1.999²/4.
        (
            entry(0, 1) + 1.999 * entry(1, 1),
            -entry(1, 0),
            1.2,
            [("branch-point", 0.999), ("neimark-sacker", 1.0)],
        ),
        # μ² − p μ + 1, whose roots stay on the circle.
        (entry(0, 1) - entry(1, 0), entry(1, 1), 1.5, []),
    ],
)
def test_several_multipliers_cross_the_circle_at_once_or_none(a, b, stop, found):
    system = Multiplied(*(jnp.asarray(v) for v in (0.85, a, b)))
    orbit = jf.periodic_orbit(system, jnp.zeros(3), steps=2, stepper=jf.RK4())
    branch = jf.continue_orbit(system, "p", orbit, stop=stop)
    assert [p.kind for p in branch.points] == [kind for kind, _ in found]
    assert_allclose([p.value for p in branch.points], [v for _, v in found], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    "a, kind",
    [
        (entry(0, 1) - entry(1, 0), "neimark-sacker"),
        (-entry(0, 0) - entry(1, 1), "period-doubling"),
    ],
)
def test_multipliers_cross_the_circle_in_steps_as_short_as_their_distance(a, kind):
    """Two multipliers of size p, as of a resonator with Q = 10⁶."""
    system = Multiplied(jnp.asarray(1 - 5e-7), 0 * a, jnp.asarray(a))
    orbit = jf.periodic_orbit(system, jnp.zeros(3), steps=2, stepper=jf.RK4())
    branch = jf.continue_orbit(system, "p", orbit, stop=1 + 5e-7, max_step=2e-8)
    (point,) = branch.points
    assert point.kind == kind
    assert_allclose(point.value, 1, rtol=0, atol=1e-12)
    assert_array_equal(branch.stable, branch.values < 1)
    before, after = branch.values[point.index - 1 : point.index + 1]
    assert before < point.value < after


class Invaded(jf.System):
    """x' = cos t − x, y' = (r + x − c y − d y²) y; its orbit y = 0 has a multiplier exp(2πr)."""

    r: jax.Array
    c: jax.Array
    d: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        rate = self.r + x[0] - self.c * x[1] - self.d * x[1] ** 2
        return jnp.stack([jnp.cos(t) - x[0], rate * x[1]])


@pytest.mark.parametrize("c, d", [(1.0, 0.0), (0.0, 1.0)])
def test_a_branch_goes_on_where_one_of_its_equations_vanishes(c, d):
    """At r = 0 the end of y has the derivatives 1 by y and 0 by r."""
    system = Invaded(jnp.float64(-0.2), jnp.float64(c), jnp.float64(d))
    orbit = jf.periodic_orbit(system, jnp.array([0.5, 0.0]), steps=16)
    branch = jf.continue_orbit(system, "r", orbit, stop=0.2, max_step=0.1)
    assert branch.values[-1] == 0.2
    largest = np.max(abs(branch.orbits.multipliers), axis=1)
    assert_allclose(largest, np.exp(2 * np.pi * branch.values), rtol=1e-6)
    (point,) = branch.points
    assert point.kind == "branch-point"
    assert_allclose(point.value, 0, rtol=0, atol=1e-9)
    crossing = jf.continue_orbit(system, "r", point, stop=(-0.2, 0.2), max_step=0.2)
    # u = y⁻ᵏ has the equation u' = k − k (r + x) u, k = 1 if d = 0 and otherwise 2, on which the
    # orbit has the integral of r + x = A(t) with x = (cos t + sin t)/2.
    k, period = 1 + d, 2 * np.pi
    for r, y in zip(crossing.values[::4], crossing.orbits.x0[::4, 1], strict=True):

        def grown(s, r=r):
            return np.exp(k * (r * (s - period) + (np.sin(s) - np.cos(s) + 1) / 2))

        u = k * quad(grown, 0, period)[0] / (1 - np.exp(-k * r * period))
        assert_allclose(y**-k, u, rtol=1e-5)


class Neurons(jf.System):
    """x' = 1.3 − x for two neurons, each of which returns from 1 to 0 and adds `kick` to the other
    one."""

    kick: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return 1.3 - x

    def switching(self, t, x):
        return 1 - x

    def reset(self, t, x, surface):
        fires = jnp.stack([surface == 0, surface == 1])
        return jnp.where(fires, 0.0, x + self.kick)


@pytest.mark.slow
@pytest.mark.parametrize("kick, stop", [(0.05, -0.05), (-0.04, 0.06)])
def test_branches_cross_where_all_phases_are_orbits(kick, stop):
    """In turn they fire after τ each, e^(−τ) = E with 1.3 E² − kick E = 0.3. Without a kick every
    difference of their phases is an orbit, and the second multiplier passes through 1."""
    E = (kick + np.sqrt(kick**2 + 1.56)) / 2.6
    x = 1.3 + (np.array([0.0, 1.3 * (1 - E) + kick]) - 1.3) * E**0.3
    orbit = jf.periodic_orbit(
        Neurons(jnp.float64(kick)), jnp.asarray(x), period=-2 * np.log(E), steps=24
    )
    branch = jf.continue_orbit(orbit.system, "kick", orbit, stop=stop, max_step=0.2)
    (point,) = branch.points
    assert point.kind == "branch-point" and branch.values[-1] == stop
    assert_allclose(point.value, 0, rtol=0, atol=1e-11)
