"""Periodic orbits by shooting: known orbits from poor guesses, derivatives, outcomes."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from jaxfil.bifurcations.candidates import approaches
from jaxfil.model.outcomes import outcome_names
from tests.problems import PROBLEMS, closed_forms, tagged
from tests.problems.systems import belt
from tests.problems.values import (
    BELT_DAMPING,
    DEN_HARTOG_AMPLITUDE,
    SD_DAMPING,
    SLIP_STICK_PERIOD,
)
from tests.results import by_imaginary_part, in_float32, lane

S = jf.systems
CROSS, STICK, SLIP = EventKind.crossing, EventKind.stick, EventKind.slip
# A guess off by a fifth, with every pattern of signs.
OFF = jnp.asarray([[1.2, 1.2], [1.2, 0.8], [0.8, 1.2], [0.8, 0.8]])


BELT = tagged("orbit belt", but="twice")


@functools.cache
def belts():
    """All four orbits from four guesses each, in one call: axes (omega, guess)."""

    def orbit(omega, x0):
        return jf.periodic_orbit(belt(omega), x0, steps=100, throw=False)

    x0 = jnp.asarray([PROBLEMS[name].x0 for name in BELT])
    omegas = jnp.stack([PROBLEMS[name].system.omega for name in BELT])
    over_guesses = eqx.filter_vmap(orbit, in_axes=(None, 0))
    return eqx.filter_vmap(over_guesses)(omegas, x0[:, None] * OFF)


def one_belt(name, guess=0):
    return lane(belts(), (BELT.index(name), guess))


@pytest.mark.slow
@pytest.mark.parametrize("name", BELT)
@pytest.mark.parametrize("guess", range(4))
def test_belt_orbit_from_a_guess_off_by_a_fifth(name, guess):
    p, orbit = PROBLEMS[name], one_belt(name, guess)
    assert bool(orbit.result == RESULTS.successful)
    assert_allclose(orbit.x0, p.x0, rtol=0, atol=1e-10)
    assert orbit.residual < 1e-12
    count = len(p.ts)
    assert_array_equal(orbit.num_events, count)
    assert_array_equal(orbit.events.kinds[:count], p.kinds)
    assert_allclose(orbit.events.ts[:count], p.ts, rtol=0, atol=1e-10)
    digits = max(p.digits, 1e-10)
    assert_allclose(by_imaginary_part(orbit.multipliers), p.multipliers, rtol=0, atol=digits)
    # The damping alone is the trace of the field where nothing sticks or crosses.
    if not p.kinds:
        determinant = np.prod(orbit.multipliers)
        assert_allclose(determinant, np.exp(BELT_DAMPING * p.t1), rtol=1e-8)
    if STICK in p.kinds:
        assert abs(orbit.multipliers).min() < 1e-12


@pytest.mark.slow
def test_belt_with_a_cubic_spring_after_a_transient():
    # Non-sliding; both multipliers have the rate -0.24525, half the damping.
    p = PROBLEMS["cubic belt 4.56"]
    system, x0 = p.system, jnp.asarray(p.x0)

    def orbit(x0):
        return jf.periodic_orbit(system, x0, steps=100, transient=30, throw=False)

    found = eqx.filter_vmap(orbit)(x0 * OFF)
    assert (found.result == RESULTS.successful).all()
    assert_allclose(found.x0, np.broadcast_to(x0, (4, 2)), rtol=0, atol=1e-10)
    assert_array_equal(found.num_events, 0)
    for multipliers in found.multipliers:
        assert_allclose(by_imaginary_part(multipliers), p.multipliers, rtol=0, atol=1e-8)
    assert found.stable.all()


SD = jnp.asarray(PROBLEMS["symmetric sd"].x0)


@functools.cache
def sd_orbits():
    """The symmetric crossing orbit of the SD oscillator at 0.7, from four guesses; and a fifth
    time, as it is seen from t = 1 on."""

    def orbit(x0, t0):
        return jf.periodic_orbit(S.SDOscillator(omega=0.7), x0, t0=t0, throw=False)

    guesses = jnp.append(SD * OFF, jnp.asarray([[2.5, -1.2]]), axis=0)
    return eqx.filter_vmap(orbit)(guesses, jnp.asarray([0.0, 0.0, 0.0, 0.0, 1.0]))


@functools.cache
def sd_orbit():
    return lane(sd_orbits(), 0)


def test_sd_oscillator_from_guesses_off_by_a_fifth():
    found = sd_orbits()
    assert (found.result == RESULTS.successful).all()
    assert_allclose(found.x0[:4], np.broadcast_to(SD, (4, 2)), rtol=0, atol=1e-10)
    assert_array_equal(found.events.kinds[:, :3], [[CROSS, CROSS, EventKind.none]] * 5)
    # Known to five digits; their product exactly, as crossings keep areas.
    p = PROBLEMS["symmetric sd"]
    for multipliers in found.multipliers:
        assert_allclose(by_imaginary_part(multipliers), p.multipliers, rtol=0, atol=p.digits)
        assert_allclose(np.prod(multipliers), np.exp(SD_DAMPING * p.t1), rtol=1e-8)


def test_an_orbit_seen_from_another_phase():
    # The same curve; the forcing's phase is that of t0.
    again = lane(sd_orbits(), 4)
    assert_allclose(again.x0, sd_orbit().states(jnp.asarray([1.0]))[0], rtol=0, atol=1e-10)
    end = again.states(jnp.asarray([2 * np.pi / 0.7]))[0]
    assert_allclose(end, sd_orbit().x0, rtol=0, atol=1e-10)


def test_a_trajectory_is_a_smooth_line_and_closes():
    orbit = sd_orbit()
    sol = orbit.trajectory(periods=2)
    seen = np.isfinite(sol.ts)
    ts, xs = np.asarray(sol.ts)[seen], np.asarray(sol.xs)[seen]
    assert seen.all() and int(sol.num_events) == 4
    # A line through the states turns by small angles, but for two at each of the four crossings.
    strokes = np.diff(xs / np.ptp(xs, axis=0), axis=0)
    turns = np.diff(np.unwrap(np.arctan2(strokes[:, 1], strokes[:, 0])))
    assert np.sort(abs(turns))[-9] < np.radians(3)
    assert_allclose([ts[0], ts[-1]], [0, 4 * np.pi / 0.7], rtol=1e-14)
    assert_allclose(xs[[0, -1]], np.broadcast_to(orbit.x0, (2, 2)), rtol=0, atol=1e-10)
    away = abs(xs[:, 0]) > 1e-9
    assert_array_equal(np.sign(xs[away, 0]), np.asarray(sol.modes)[seen, 0][away])


@pytest.mark.slow
def test_extremes_lie_between_the_steps():
    # Symmetric: x(t + T/2) = -x(t). Where x' has a maximum, x'' = 0: x = sgn x + f cos - 2 z x'.
    least, most = sd_orbit().extremes()
    assert_allclose(least, -most, rtol=1e-9)
    ts = jnp.linspace(0.0, 2 * np.pi / 0.7, 4001)
    xs = np.asarray(sd_orbit().states(ts))
    assert np.all(most >= xs.max(axis=0) - 1e-12)
    # Samples h apart miss a smooth maximum by x'' h²/8 at most, a kink of x' by more.
    assert_allclose(most[0], xs[:, 0].max(), rtol=0, atol=3 * (ts[1] ** 2) / 8)


@pytest.mark.slow
def test_highest_speeds_of_the_belt():
    # At 1.3 and 9.1 the belt's own speed.
    for name in BELT:
        highest = one_belt(name).extremes()[1][1]
        assert_allclose(highest, PROBLEMS[name].highest, rtol=0, atol=1e-9)


def test_an_orbit_tells_what_it_is():
    card = repr(sd_orbit())
    assert "Orbit of SDOscillator: successful" in card and "stable" in card
    assert "crossing, crossing" in card and "8.97597901026" in card
    assert "batch of shape (5,)" in repr(sd_orbits())
    assert "no contacts" in repr(one_belt("belt 17"))
    assert "Orbit of SDOscillator in float32: successful" in repr(in_float32(sd_orbit()))


# Its start at t = 0: the solution is taken from where it turns, at the phase of the forcing there.
GUESS = jnp.asarray([2.0, 1.5])


def turning(orbit):
    count = int(orbit.num_events)
    return np.asarray(orbit.events.xs)[:count]


@pytest.mark.slow
@pytest.mark.parametrize("segments", [1, 3])
def test_den_hartog(segments):
    amplitude, multipliers = closed_forms.den_hartog()
    assert_allclose(amplitude, DEN_HARTOG_AMPLITUDE, rtol=1e-10)
    orbit = jf.periodic_orbit(S.DenHartog(), GUESS, segments=segments, steps=60)
    assert_allclose(np.sort(turning(orbit)[:, 0]), [-amplitude, amplitude], rtol=0, atol=1e-9)
    assert_allclose(
        by_imaginary_part(orbit.multipliers), by_imaginary_part(multipliers), rtol=0, atol=1e-9
    )
    assert_allclose(orbit.monodromy, single().monodromy, rtol=0, atol=1e-9)
    assert_allclose(orbit.x0, single().x0, rtol=0, atol=1e-11)
    assert_allclose(orbit.events.ts[:2], single().events.ts[:2], rtol=0, atol=1e-11)
    assert orbit.starts.shape == (segments, 2)
    third = jnp.arange(float(segments)) * orbit.period / segments
    assert_allclose(orbit.starts, single().states(third), rtol=0, atol=1e-10)


@pytest.mark.slow
def test_the_contacts_of_all_segments_count():
    """The orbit has two turning points, in two of three segments."""
    options = dict(segments=3, steps=60, max_events=1, throw=False, compact=True)
    orbit = jf.periodic_orbit(S.DenHartog(), GUESS, **options)
    assert outcome_names(orbit.result) == "max_events_reached"


@functools.cache
def single():
    return jf.periodic_orbit(S.DenHartog(), GUESS, steps=60)


def test_convergence_is_quadratic():
    errors = []
    for steps in range(1, 9):
        orbit = jf.periodic_orbit(S.DenHartog(), GUESS, steps=60, newton_steps=steps, throw=False)
        errors.append(float(np.max(abs(orbit.x0 - single().x0))))
    tail = [e for e in errors if 1e-13 < e < 0.3]
    assert len(tail) >= 3 and errors[-1] < 1e-13
    orders = [
        np.log(c / b) / np.log(b / a) for a, b, c in zip(tail, tail[1:], tail[2:], strict=False)
    ]
    assert orders[-1] > 1.8


class Slipping(jf.System):
    """Stick–slip on a belt of speed v: x1'' = -x1 + F(v - x1'), F(w) = ±1/(1 + c|w|)."""

    v: jax.Array
    c: jax.Array

    def vector_field(self, t, x, side):
        w = (self.v - x[1]) * -side
        return jnp.stack([x[1], -x[0] - side / (1 + self.c * w)])

    def switching(self, t, x):
        return x[1] - self.v


@pytest.mark.slow
def test_slip_stick():
    orbit = jf.periodic_orbit(S.SlipStick(), jnp.asarray([1.1, 0.3]), period=8.0)
    assert_allclose(orbit.period, SLIP_STICK_PERIOD, rtol=0, atol=1e-9)
    first, second = sorted(abs(orbit.multipliers))
    assert first < 1e-12
    assert_allclose(second, 1, rtol=0, atol=1e-9)
    assert bool(orbit.stable)
    rows = {int(k): x for k, x in zip(orbit.events.kinds, orbit.events.xs, strict=True) if k}
    before = PROBLEMS["slip-stick"].before
    for kind, x in zip([STICK, SLIP], before, strict=True):
        assert_allclose(rows[kind], x, rtol=0, atol=1e-9)


def test_the_period_zero_is_no_answer():
    # Every state closes after no time at all.
    orbit = jf.periodic_orbit(S.SlipStick(), jnp.asarray([1.1, 0.3]), period=0.2, throw=False)
    assert bool(orbit.result == RESULTS.newton_stalled)


def central(f, at, h=1e-4):
    """f' by central differences of the fourth order."""
    values = [np.asarray(f(at + k * h)) for k in (-2.0, -1.0, 1.0, 2.0)]
    return np.tensordot([1, -8, 8, -1], values, 1) / (12 * h)


@pytest.mark.release
def test_derivatives_of_a_forced_orbit():
    def start(p):
        orbit = jf.periodic_orbit(S.DenHartog(friction=p[0], omega=p[1]), GUESS, steps=60)
        return jnp.append(orbit.x0, orbit.period)

    p = jnp.asarray([0.3, 0.8])
    forward = jax.jacfwd(start)(p)
    assert_allclose(jax.jacrev(start)(p), forward, rtol=1e-12, atol=1e-13)
    for i in range(2):
        slope = central(lambda q, i=i: start(p.at[i].set(q)), p[i])
        assert_allclose(forward[:, i], slope, rtol=0, atol=1e-7)
    assert_allclose(forward[2], [0, -2 * np.pi / 0.8**2], rtol=1e-12)


@pytest.mark.slow
def test_derivatives_of_an_autonomous_orbit():
    # It sticks. x0 moves at right angles to the field at the guess, which depends on the parameters
    # too; the period does not.
    def found(p):
        system = Slipping(*p)
        orbit = jf.periodic_orbit(system, jnp.asarray([1.1, 0.3]), period=8.0)
        return jnp.append(orbit.x0, orbit.period)

    p = jnp.asarray([0.2, 1.0])
    assert_allclose(found(p)[2], SLIP_STICK_PERIOD, rtol=0, atol=1e-9)
    forward = jax.jacfwd(found)(p)
    for i in range(2):
        slope = central(lambda q, i=i: found(p.at[i].set(q)), p[i])
        assert_allclose(forward[2, i], slope[2], rtol=1e-6)


class Valve(jf.System):
    """x' = a + k|x| + f cos 2πt, of which everything is known while x keeps its sign s:
    x = c e^(skt) - a/(sk) + f (-sk cos 2πt + 2π sin 2πt)/(k² + 4π²)."""

    a: jax.Array
    k: jax.Array
    f: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        push = self.f * jnp.cos(2 * jnp.pi * t)
        return jnp.stack([self.a + self.k * side * x[0] + push])

    def switching(self, t, x):
        return x[0]

    @property
    def period(self):
        return jnp.ones((), self.a.dtype)


def valve(a, k, f=0.3):
    return Valve(*(jnp.asarray(v) for v in (a, k, f)))


def valves(a, k, x0, newton_steps=50):
    def orbit(a, k, x0):
        return jf.periodic_orbit(
            valve(a, k), x0[None], stepper=jf.RK4(), newton_steps=newton_steps, throw=False
        )

    return eqx.filter_vmap(orbit)(*(jnp.asarray(v) for v in (a, k, x0)))


NAN = float("nan")
LANES = [  # a, k, guess, outcome
    (-0.5, 1.0, -0.9, "successful"),
    (0.5, 1.0, -0.9, "newton_stalled"),  # x' > 0 but for the forcing, whose mean is zero
    (-0.5, 1.0, NAN, "nonfinite"),
    (-0.5, 1.0, 0.8, "successful"),
    (0.5, 0.0, 0.1, "newton_singular"),  # the period map is x + 1/2
    (NAN, 1.0, 0.4, "nonfinite"),
    (-1.0, 2.0, 0.6, "successful"),
]


@pytest.mark.slow
def test_every_lane_has_its_own_outcome():
    a, k, x0 = (np.asarray(column) for column in list(zip(*LANES, strict=True))[:3])
    orbits = valves(a, k, x0)
    assert_array_equal(outcome_names(orbits.result), [lane[3] for lane in LANES])
    good = np.asarray([lane[3] == "successful" for lane in LANES])
    s, rate = np.sign(x0)[good], k[good]
    want = -a[good] / (s * rate) - 0.3 * s * rate / (rate**2 + 4 * np.pi**2)
    assert_allclose(orbits.x0[good, 0], want, rtol=0, atol=1e-6)
    assert_allclose(orbits.multipliers[good, 0], np.exp(s * rate), rtol=1e-6)
    assert_array_equal(orbits.stable[good], s < 0)
    assert not orbits.stable[~good].any()
    assert not np.isfinite(np.asarray(orbits.multipliers)[[2, 5]]).any()
    # Bit for bit what they are among good neighbours.
    i = np.flatnonzero(good)[np.arange(len(LANES)) % good.sum()]
    alone = valves(a[i], k[i], x0[i])
    assert_array_equal(orbits.x0[good], alone.x0[: good.sum()])


def test_a_budget_of_two_steps_is_an_outcome():
    # All on one side, where the map is linear: one step, and one to see it. From the other side, or
    # after the third, it takes more.
    x0 = [-0.9, -0.8, -0.7, 0.05, 0.9, 0.8, -0.6]
    names = outcome_names(valves([-0.5] * 7, [1.0] * 7, x0, newton_steps=2).result)
    assert names[3] == "newton_max_steps_reached"
    assert (names[[0, 1, 2, 4, 5, 6]] == "successful").all()


def test_two_periods_of_the_forcing():
    orbit = jf.periodic_orbit(valve(-0.5, 1.0), jnp.asarray([-0.9]), periods=2, stepper=jf.RK4())
    assert_allclose(orbit.period, 2)
    assert_allclose(orbit.multipliers, np.exp([-2.0]), rtol=1e-6)


def test_single_failures_are_errors_that_say_why():
    with pytest.raises(RuntimeError, match="no solution near"):
        jf.periodic_orbit(valve(0.5, 1.0), jnp.asarray([-0.9]), periods=2, stepper=jf.RK4())


class Spring(jf.System):
    """x'' + x = cos ωt: no orbit at ω = 1, where the period map is the identity and a shift, known
    to rounding only."""

    omega: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.cos(self.omega * t) - x[0]])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def test_a_linear_oscillator_in_resonance_has_no_orbit():
    def orbit(omega):
        return jf.periodic_orbit(Spring(omega), jnp.asarray([1.0, 0.0]), throw=False)

    orbits = eqx.filter_vmap(orbit)(jnp.asarray([1.0, 0.8]))
    assert_array_equal(outcome_names(orbits.result), ["newton_singular", "successful"])
    assert_allclose(orbits.x0[1], [1 / (1 - 0.64), 0], rtol=0, atol=1e-9)


class Forced(jf.System):
    """x' = −k x + a cos t; at k = 0 every start is periodic."""

    k: jax.Array
    a: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return -self.k * x + self.a * jnp.cos(t)


def test_a_lane_without_an_orbit_takes_nothing_from_the_gradient_of_others():
    def total(a):
        def start(k):
            orbit = jf.periodic_orbit(Forced(k, a), jnp.array([0.3]), compact=True, throw=False)
            return orbit.x0[0], orbit.result

        starts, results = jax.vmap(start)(jnp.asarray([0.5, 0.0, 1.0]))
        return jnp.where(results == RESULTS.successful, starts, 0.0).sum(), results

    slope, results = jax.jit(jax.grad(total, has_aux=True))(0.7)
    assert_array_equal(outcome_names(results), ["successful", "newton_singular", "successful"])
    # x = a (k cos t + sin t)/(1 + k²).
    assert_allclose(slope, 0.5 / 1.25 + 1 / 2, rtol=1e-10)


@pytest.mark.release
def test_an_orbit_of_a_negative_period_is_told():
    def orbit(omega):
        system = S.ImpactOscillator(omega=omega, damping=1.0)
        return jf.periodic_orbit(system, jnp.zeros(2), stepper=jf.RK4(), throw=False)

    found = eqx.filter_vmap(orbit)(jnp.asarray([0.5, -0.5]))
    assert_array_equal(outcome_names(found.result), ["successful", "invalid_period"])


@pytest.mark.parametrize(
    "change, message",
    [
        ({"x0": jnp.zeros((2, 2))}, r"`x0` must be of shape \(n,\)"),
        ({"system": S.SlipStick}, "`system` must be an instance"),
        (
            {"system": S.SlipStick()},
            "`period` must be a guess of the period, since SlipStick is auto",
        ),
        ({"system": S.SlipStick(), "period": -1.0}, "`period` must be a positive number, got -1"),
        ({"system": S.SlipStick(), "period": 9.0, "periods": 2}, "`periods` and `transient`"),
        ({"period": 9.0}, "`period` must be None, since SDOscillator has"),
        ({"periods": 0}, "`periods` must be an integer of at least 1, got 0"),
        ({"steps": 2.5}, "`steps` must be an integer of at least 1, got 2.5"),
        ({"segments": 0}, "`segments` must be an integer of at least 1, got 0"),
        ({"transient": -1}, "`transient` must be an integer of at least 0, got -1"),
        ({"newton_steps": 0}, "`newton_steps` must be an integer of at least 1, got 0"),
        ({"max_events": None}, "`max_events` must be an integer of at least 1, got None"),
        ({"stepper": "RK4"}, "`stepper` must be jaxfil.RK4"),
        ({"t0": "now"}, "`t0` must be a number, got 'now'"),
    ],
)
def test_bad_calls(change, message):
    call = {"system": S.SDOscillator(), "x0": jnp.zeros(2)} | change
    with pytest.raises(ValueError, match=message):
        jf.periodic_orbit(call.pop("system"), call.pop("x0"), **call)


class Rest(jf.System):
    """x'' + x'/10 + x + c x³ = 0: all comes to rest at zero, forced or not."""

    c: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - 0.1 * x[1] - self.c * x[0] ** 3])

    @property
    def period(self):
        return 2.0


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("guess", [[1.0, 0.5], [1e-3, 1.0], [0.0, 0.0]])
@pytest.mark.parametrize("cubic", [0.0, 1.0])
def test_an_orbit_that_is_zero_is_found(cubic, guess, dtype):
    orbit = jf.periodic_orbit(Rest(jnp.asarray(cubic)), jnp.asarray(guess, dtype), steps=20)
    assert_allclose(orbit.x0, 0, rtol=0, atol=1024 * np.finfo(dtype).eps ** 1.5)
    # The linear system's multipliers, two periods of 1 with |μ| = exp(-0.05 T).
    assert_allclose(abs(orbit.multipliers), np.exp(-0.1), rtol=32 * np.finfo(dtype).eps ** 0.75)


class Unexcited(jf.System):
    """A mass that is shaken, and one that comes to rest at 1/5, where its speed is the rounding of
    its force."""

    k: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        force = jnp.cos(t) - 4 * x[0] - x[2], -self.k * (x[1] - 0.2) - x[3]
        return jnp.stack([x[2], x[3], *force])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.slow
def test_a_component_that_is_zero_but_for_the_rounding_of_others(dtype):
    """x = (3 cos t + sin t)/10."""

    def one(k, guess):
        return jf.periodic_orbit(Unexcited(k), guess, throw=False)

    k, guess = np.linspace(1, 12, 64), np.random.default_rng(0).uniform(0, 1, (64, 4))
    guess[::2, 1:] = 0
    k, guess = (jnp.asarray(v, dtype) for v in (k, guess))
    found = eqx.filter_jit(eqx.filter_vmap(one))(k, guess)
    assert outcome_names(found.result).tolist() == ["successful"] * 64
    error = 256 * np.finfo(dtype).eps + 1e-9
    assert_allclose(found.x0, np.tile([0.3, 0.2, 0.1, 0.0], (64, 1)), rtol=0, atol=error)


@pytest.mark.parametrize("wall, damping", [(-1.0, 0.1), (-9.0, 0.0)])
@pytest.mark.slow
def test_an_orbit_behind_a_wall_is_told(wall, damping):
    """It hits the wall from behind, or stands still at t0, where no wall would change it."""
    behind = S.ImpactOscillator(amplitude=2.0, omega=1.2, wall=wall, damping=damping)
    orbit = jf.periodic_orbit(behind, jnp.asarray([1.0, 0.0]), throw=False)
    assert outcome_names(orbit.result) == "behind_surface" and not bool(orbit.stable)
    with pytest.raises(Exception, match="lies behind a surface that throws back"):
        jf.periodic_orbit(behind, jnp.asarray([1.0, 0.0]))


class Curved(jf.System):
    """An oscillator behind a circle that throws back with e = e₀ |s|^(−p) at a speed s."""

    e0: jax.Array
    p: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[2], x[3], jnp.cos(t) - 4 * x[0] - x[2], -9 * (x[1] - 0.2) - x[3]])

    def switching(self, t, x):
        return x[0] ** 2 + x[1] ** 2 - 4

    def reset(self, t, x, surface):
        normal = x[:2] / jnp.sqrt(x[:2] @ x[:2])
        speed = normal @ x[2:]
        size = jnp.sqrt(speed**2 + 1e-12)
        thrown = (1 + self.e0 * size**-self.p) * speed * normal
        return jnp.concatenate([x[:2], x[2:] - thrown])


@pytest.mark.slow
def test_an_orbit_behind_a_curved_wall_is_told():
    """With e constant, or falling with the speed."""

    def one(e0, p):
        return jf.periodic_orbit(Curved(e0, p), jnp.zeros(4), throw=False).result

    e0, p = jnp.array([0.8, 0.7, 0.3]), jnp.array([0.0, 0.2, 0.05])
    found = eqx.filter_jit(eqx.filter_vmap(one))(e0, p)
    assert outcome_names(found).tolist() == ["behind_surface"] * 3


class Heated(jf.System):
    """x' = 30 − 4 sin t − x + h u, with a heater u that is put off at x = 22 and on at x = 18, as a
    product, which has the derivative of a wall with e = 0."""

    h: jax.Array
    slides = False
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([30 - 4 * jnp.sin(t) - x[0] + self.h * x[1], 0 * t])

    def switching(self, t, x):
        return jnp.stack([22 - x[0], x[0] - 18])

    def reset(self, t, x, surface):
        return x.at[1].set(jnp.where(surface == 0, 0.0, 1.0))


@pytest.mark.slow
def test_an_orbit_above_the_threshold_of_a_heater():
    """In summer x = 30 + 2 (cos t − sin t)."""
    orbit = jf.periodic_orbit(Heated(jnp.array(25.0)), jnp.array([30.0, 0.0]))
    assert_allclose(orbit.x0, [32.0, 0.0], rtol=0, atol=1e-10)
    assert_array_equal(orbit.first_mode, [-1, 1])


class Stove(jf.System):
    """x' = −x + cos t + h, with a stove h that is lit at x = lo, and goes out at x = 9."""

    lo: jax.Array
    slides = False
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.cos(t) - x[0] + x[1], 0 * x[1]])

    def switching(self, t, x):
        return jnp.stack([x[0] - self.lo, 9 - x[0]])

    def reset(self, t, x, surface):
        return x.at[1].set(jnp.where(surface == 0, 1.0, 0.0))


@pytest.mark.slow
def test_an_orbit_from_below_a_threshold_that_it_passes_through():
    """Lit again while lit, it has x = 1 + (cos t + sin t)/2, which is below 0.7 at first."""
    orbit = jf.periodic_orbit(Stove(jnp.asarray(0.7)), jnp.array([0.4, 1.0]), t0=1.5 * np.pi)
    assert_array_equal(orbit.first_mode, [-1, 1])
    assert_allclose(orbit.x0, [0.5, 1.0], rtol=0, atol=1e-9)
    assert_allclose(np.sort(abs(orbit.multipliers)), [0, np.exp(-2 * np.pi)], rtol=0, atol=1e-12)


class Thermostat(jf.System):
    """Heats from lo to hi and cools back, towards 35 and 10."""

    lo: jax.Array
    hi: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([10.0 - x[0] + 25.0 * x[1], 0 * x[1]])

    def switching(self, t, x):
        return jnp.stack([self.hi - x[0], x[0] - self.lo])

    def reset(self, t, x, surface):
        return jnp.stack([x[0], jnp.where(surface == 0, 0.0, 1.0)])


@pytest.mark.release
@pytest.mark.parametrize("guess", [0.7, 1.0, 1.3, 2.0])
def test_the_period_of_a_thermostat_is_prime(guess):
    system = Thermostat(jnp.asarray(18.0), jnp.asarray(22.0))
    orbit = jf.periodic_orbit(system, jnp.asarray([20.0, 1.0]), period=guess)
    exact = np.log(17 / 13) + np.log(12 / 8)
    assert_allclose(orbit.period, exact, rtol=1e-12)


@pytest.mark.release
def test_the_derivative_of_a_prime_period_is_that_of_the_orbit_found():
    def period(hi):
        system = Thermostat(jnp.asarray(18.0), hi)
        return jf.periodic_orbit(system, jnp.asarray([20.0, 1.0]), period=1.3).period

    found = jax.value_and_grad(period)(jnp.asarray(22.0))
    # T = log((hi - 10)/(lo - 10)) + log((35 - lo)/(35 - hi))
    exact = np.log(17 / 13) + np.log(12 / 8), 1 / 12 + 1 / 13
    assert_allclose(found, exact, rtol=1e-11)


class TwoSpeeds(jf.System):
    """The circle of radius one, faster by w where x < 0: T = π + π/w."""

    w: jax.Array

    def vector_field(self, t, x, side):
        pull, rate = 1 - x[0] ** 2 - x[1] ** 2, jnp.where(side > 0, 1.0, self.w)
        return jnp.stack([pull * x[0] - rate * x[1], pull * x[1] + rate * x[0]])

    def switching(self, t, x):
        return x[0]


@pytest.mark.parametrize("times", [1, 3])
def test_the_period_is_prime_where_contacts_have_a_component_of_zero(times):
    period = np.pi + np.pi / 1.7
    guess = times * period + 0.05
    orbit = jf.periodic_orbit(TwoSpeeds(jnp.asarray(1.7)), jnp.array([1.05, 0.1]), period=guess)
    assert_allclose(orbit.period, period, rtol=1e-11)


class Turning(jf.System):
    """The circle of radius one, once in 2π."""

    def vector_field(self, t, x, side):
        pull = 1 - x[0] ** 2 - x[1] ** 2
        return jnp.stack([pull * x[0] - x[1], pull * x[1] + x[0]])


@pytest.mark.parametrize("times", [1, 2, 3])
def test_the_period_of_a_smooth_orbit_is_prime(times):
    orbit = jf.periodic_orbit(Turning(), jnp.asarray([1.1, 0.0]), period=2 * np.pi * times + 0.1)
    assert_allclose(orbit.period, 2 * np.pi, rtol=1e-9)


class Daily(jf.System):
    """u = y − 300 becomes mu + 0.4 u if u < 0, and mu − 1.5 u if u > 0, once in a unit of time: mu
    times 0.4 is mapped to itself, and mu times −0.3125 and 0.875 to each other."""

    mu: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.ones_like(x[0]), jnp.zeros_like(x[1])])

    def switching(self, t, x):
        return 1 - x[0]

    def reset(self, t, x, surface):
        u = x[1] - 300
        return jnp.stack([0 * x[0], 300 + self.mu + jnp.where(u < 0, 0.4 * u, -1.5 * u)])


@pytest.mark.parametrize(
    ("guess", "u", "period"), [(2.0, -0.3125, 2), (4.0, 0.875, 2), (2.0, 0.4, 1)]
)
@pytest.mark.slow
def test_an_orbit_of_twice_the_period_beside_another_one(guess, u, period):
    system, mu = Daily(jnp.asarray(0.02)), 0.02
    x0 = jnp.array([0.45, 300 + mu * u])
    orbit = jf.periodic_orbit(system, x0, period=guess, steps=8, stepper=jf.RK4())
    assert_allclose(orbit.period, period, rtol=1e-12)
    assert_allclose(orbit.x0[1], x0[1], rtol=0, atol=1e-12)


class Pushed(jf.System):
    """x'' = cos t − k x − c x', whose orbit is a sum of sines."""

    k: jax.Array
    c: jax.Array
    period = 2 * jnp.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.cos(t) - self.k * x[0] - self.c * x[1]])


@pytest.mark.slow
def test_second_derivatives_of_an_orbit():
    def start(p):
        return jf.periodic_orbit(Pushed(p[0], p[1]), jnp.zeros(2), steps=30).x0

    def exact(p):
        k, c = p
        below = (k - 1) ** 2 + c * c
        return jnp.stack([(k - 1) / below, c / below])

    p = jnp.array([2.0, 0.3])
    found, right = (jax.jit(jax.jacfwd(jax.jacfwd(f)))(p) for f in (start, exact))
    assert_allclose(found, right, rtol=0, atol=1e-9)


@pytest.mark.release
def test_second_derivative_of_a_period():
    def period(lo):
        room = Thermostat(lo, jnp.array(22.0))
        return jf.periodic_orbit(room, jnp.array([20.0, 1.0]), period=0.7).period

    def exact(lo):
        return jnp.log(12.0 / (lo - 10.0)) + jnp.log((35.0 - lo) / 13.0)

    lo, one = jnp.array(18.0), jnp.array(1.0)

    @jax.jit
    def slopes(lo):
        return jax.jvp(lambda lo: jax.jvp(period, (lo,), (one,))[1], (lo,), (one,))

    first, second = slopes(lo)
    assert_allclose(first, jax.grad(exact)(lo), rtol=1e-11, atol=0)
    assert_allclose(second, jax.grad(jax.grad(exact))(lo), rtol=1e-9, atol=0)


class Repelling(jf.System):
    """x'' = k² x + cos t, whose one orbit of 2π is −cos t/(1 + k²)."""

    k: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.k**2 * x[0] + jnp.cos(t)])


@pytest.mark.slow
def test_an_orbit_in_segments_is_that_of_its_segments():
    """A single run would grow by e^44."""
    orbit = jf.periodic_orbit(Repelling(jnp.asarray(7.0)), jnp.zeros(2), segments=8, steps=200)
    ts = jnp.linspace(0.0, 2 * np.pi, 11)
    assert_allclose(orbit.states(ts)[:, 0], -np.cos(ts) / 50, rtol=0, atol=1e-13)
    low, high = orbit.extremes()
    assert_allclose([low[0], high[0]], [-0.02, 0.02], rtol=0, atol=1e-12)
    run = orbit.trajectory(2)
    assert run.num_events == 0 and bool(run.result == jf.RESULTS.successful)
    assert_allclose(run.xs[:, 0], -np.cos(run.ts) / 50, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_extremes_lie_within_a_step_as_long_as_the_period():
    steps = {"steps": 1, "stepper": jf.Taylor(40)}
    orbit = jf.periodic_orbit(Repelling(jnp.asarray(0.5)), jnp.zeros(2), t0=1.0, **steps)
    low, high = orbit.extremes()
    assert_allclose([low, high], [[-0.8, -0.8], [0.8, 0.8]], rtol=0, atol=1e-12)


class Dosed(jf.System):
    """x' = −k x, with 365 doses of 1 + 0.8 cos 2π(t − 0.8) in a period of 1."""

    rate: jax.Array
    period = 1.0
    clocks = (jf.Clock(1 / 365, 0.5 / 365),)

    def vector_field(self, t, x, side):
        return -self.rate * x

    def tick(self, t, x, clock):
        return x + 1 + 0.8 * jnp.cos(2 * jnp.pi * (t - 0.8))


class Lagging(jf.System):
    """x' = −x + √2 sin t, beside a surface below, so that x = sin(t − π/4)."""

    level: jax.Array
    period = 2 * np.pi
    slides = False

    def vector_field(self, t, x, side):
        return jnp.sqrt(2.0) * jnp.sin(t) - x

    def switching(self, t, x):
        return x[0] + self.level


def test_extremes_of_an_orbit_with_many_ticks():
    times, rates = (np.arange(365) + 0.5) / 365, np.array([20.0, 40.0])
    doses, fade = 1 + 0.8 * np.cos(2 * np.pi * (times - 0.8)), np.exp(-rates / 365)
    left = fade[:, None] ** (365 - np.arange(365))
    before = [np.sum(doses * left, axis=1) / (1 - fade**365)]
    for dose in doses[:-1]:
        before.append((before[-1] + dose) * fade)
    low, high = np.min(before, axis=0), np.max(np.add(before, doses[:, None]), axis=0)

    def extremes(rate, x0):
        return jf.periodic_orbit(Dosed(rate), x0[None], throw=False).extremes()

    found = eqx.filter_vmap(extremes)(jnp.asarray(rates), jnp.asarray(before[0]))
    assert_allclose(np.squeeze(found), [low, high], rtol=1e-10)


@pytest.mark.slow
def test_an_orbit_by_a_tolerance_has_all_of_its_steps():
    """Of a method of order five, hundreds. Its lowest point is at t = 7π/4."""
    steps = dict(steps=jf.Adaptive(rtol=1e-13, atol=1e-13), stepper=diffrax.Tsit5())
    orbit = jf.periodic_orbit(Lagging(jnp.asarray(1.2)), jnp.array([-0.7]), **steps)
    assert_allclose(orbit.extremes(), [[-1.0], [1.0]], rtol=0, atol=1e-8)
    assert_allclose(jf.grazing_margin(orbit.system, orbit), 0.2, rtol=0, atol=1e-8)
    dense = orbit.dense()
    ends = [np.asarray(v.ts)[np.isfinite(v.ts)] for v in (dense, jax.jit(jf.Orbit.dense)(orbit))]
    assert_array_equal(*ends)
    assert len(ends[0]) > 440 and ends[0][-1] == 2 * np.pi


class Geared(jf.System):
    """x = cos(6t + ψ) + 0.01 cos(t + χ), beside a surface above."""

    psi: jax.Array
    chi: jax.Array
    period = 2 * np.pi
    slides = False

    def vector_field(self, t, x, side):
        six, one = 6 * t + self.psi, t + self.chi
        force = jnp.cos(six) - 6 * jnp.sin(six) + 0.01 * (jnp.cos(one) - jnp.sin(one))
        return force - x

    def switching(self, t, x):
        return 1.02 - x[0]


# The tops differ by less than what a cubic through both ends of a step is off by.
PSI, CHI = 0.03 + np.pi / 6 * np.arange(12), 1 + 0.37 * np.arange(12)


def turns():
    """The times and values at which x of `Geared` turns."""
    psi, chi = PSI[:, None], CHI[:, None]
    t = (np.pi * np.arange(12) - psi) / 6
    for _ in range(3):  # Newton's method
        slope = -6 * np.sin(6 * t + psi) - 0.01 * np.sin(t + chi)
        t = t - slope / (-36 * np.cos(6 * t + psi) - 0.01 * np.cos(t + chi))
    return t, np.cos(6 * t + psi) + 0.01 * np.cos(t + chi)


@functools.cache
def geared():
    def found(psi, chi, x0):
        return jf.periodic_orbit(Geared(psi, chi), x0, throw=False)

    x0 = np.cos(PSI) + 0.01 * np.cos(CHI)
    return eqx.filter_vmap(found)(*(jnp.asarray(v) for v in (PSI, CHI, x0[:, None])))


@pytest.mark.slow
def test_the_highest_of_tops_of_nearly_equal_height():
    low, high = eqx.filter_jit(eqx.filter_vmap(jf.Orbit.extremes))(geared())
    _, values = turns()
    assert_allclose(low[:, 0], np.min(values, axis=1), rtol=0, atol=1e-6)
    assert_allclose(high[:, 0], np.max(values, axis=1), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_margin_is_that_of_the_highest_top():
    times, values = turns()
    for i in range(12):
        (nearest,) = approaches(lane(geared(), i))
        off = 2 * np.pi * nearest.tangency.phase - times[i, np.argmax(values[i])]
        assert_allclose(np.sin(off / 2), 0, rtol=0, atol=1e-6)


class Teeth(jf.System):
    """x' = −x + t mod 1, without a period of its own."""

    clocks = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        return jnp.mod(t, 1.0) - x


@pytest.mark.release
def test_clocks_need_a_period():
    with pytest.raises(ValueError, match="`system` must have a `period`, a common one of its clo"):
        jf.periodic_orbit(Teeth(), jnp.zeros(1), period=1.0)


@pytest.mark.slow
def test_derivatives_by_a_number_that_functions_close_over():
    """x' = -x + cos wt, which never meets its surface, begins at 1/(1 + w²); its mean is 0, and its
    first cosine has that amplitude."""

    def forced(w):
        field = lambda t, x: jnp.stack([-x[0] + jnp.cos(w * t)])  # noqa: E731
        return jf.piecewise(field, field, lambda t, x: x[0] - 9.0, period=2 * jnp.pi / w)

    def shot(w):
        return jf.periodic_orbit(forced(w), jnp.array([0.4]), steps=20, stepper=jf.Taylor(16)).x0[0]

    def balanced(w):
        return jf.harmonic_balance(forced(w), jnp.zeros((3, 1)), harmonics=1).coefficients[1, 0]

    w = jnp.array([1.0, 1.3])
    for start in (shot, balanced):
        value, slope = jax.vmap(jax.value_and_grad(start))(w)
        assert_allclose(value, 1 / (1 + w**2), rtol=1e-10)
        assert_allclose(slope, -2 * w / (1 + w**2) ** 2, rtol=1e-10)
        assert_allclose(jax.jacfwd(start)(1.0), -0.5, rtol=1e-10)


class OfTwoClocks(jf.System):
    """Doses at the ticks of two clocks, whose common period is 0.6."""

    period = 0.3

    def vector_field(self, t, x, side):
        return -x

    def tick(self, t, x, clock):
        return x + 1.0

    @property
    def clocks(self):
        return jf.Clock(0.3), jf.Clock(0.2)


class OfHalfTheForce(jf.System):
    """A force of twice the period."""

    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return -x + jnp.cos(t / 2)


@pytest.mark.parametrize(
    "system, told",
    [
        (OfTwoClocks(), "a common one of its clocks"),
        (OfHalfTheForce(), "a period of its functions"),
    ],
)
def test_a_period_of_something_else_is_refused(system, told):
    """A fixed point of the map over it is no orbit; one over two of them is."""
    with pytest.raises(ValueError, match=f"`period` of {type(system).__name__} must be {told}"):
        jf.periodic_orbit(system, jnp.array([0.5]))
    orbit = jf.periodic_orbit(system, jnp.array([0.5]), periods=2)
    later = jf.solve(system, orbit.x0, 0.0, 4 * system.period, system.period / 40).x_final
    assert_allclose(later, orbit.x0, rtol=0, atol=1e-9)
