"""Harmonic balance: against closed forms, against shooting, and at the rate that theory gives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import brentq

import jaxfil as jf
from jaxfil import RESULTS
from jaxfil.model.outcomes import outcome_names
from jaxfil.orbits.galerkin import Galerkin
from tests.oracles.compilations import Counter
from tests.problems import closed_forms

S = jf.systems
OMEGA = 0.7
# The symmetric orbit of the SD oscillator at 0.7 by its first harmonic, roughly.
ROUGH = jnp.asarray([[0.0, 0.0], [3.0, 0.0], [0.0, -2.1]])


def series(harmonics, omega=OMEGA, **kwargs):
    return jf.harmonic_balance(S.SDOscillator(omega=omega), ROUGH, harmonics, **kwargs)


def missing(top):
    """The sum of all harmonics of position and velocity above the highest: sgn x is a square wave,
    Σ 4/(πk) over odd k in its own phase, and dividing by kΩ integrates it."""
    k = np.arange(top + 2, 20_000, 2)
    return np.asarray([np.sum(4 / (np.pi * k * (k * OMEGA) ** p)) for p in (2, 1)])


@pytest.fixture(scope="module")
def orbit():
    return jf.periodic_orbit(S.SDOscillator(omega=OMEGA), jnp.asarray([3.0, 0.6]))


def test_the_error_falls_at_the_rate_of_a_jump_in_acceleration(orbit):
    # sgn x is a square wave, in its own phase Σ 4/(πk) over odd k: the position's harmonics are
    # 4/(πk (kΩ)²), the velocity's 4/(πk kΩ), and what is left out is the mean-square error.
    ts = np.linspace(0.0, 2 * np.pi / OMEGA, 4001)[:-1]
    exact = np.asarray(orbit.states(jnp.asarray(ts)))
    errors = {}
    for top in (9, 39):
        got = np.asarray(jax.vmap(series(top).evaluate)(jnp.asarray(ts)))
        errors[top] = np.sqrt(np.mean((got - exact) ** 2, axis=0))
        k = np.arange(top + 2, 20_000, 2)
        tail = [4 / (np.pi * k * (k * OMEGA) ** 2), 4 / (np.pi * k * k * OMEGA)]
        want = [np.sqrt(np.sum(c**2) / 2) for c in tail]
        assert_allclose(errors[top], want, rtol={9: 0.1, 39: 0.02}[top])
    # A fourfold number of harmonics: K^(-5/2) and K^(-3/2).
    assert_allclose(np.log(errors[9] / errors[39]) / np.log(4), [2.5, 1.5], rtol=0, atol=0.1)


def test_a_linear_system_is_solved_exactly():
    # x'' + x = cos Ωt: x = cos Ωt/(1 - Ω²), from a guess that is nothing.
    found = jf.harmonic_balance(S.DenHartog(friction=0.0), lambda t: jnp.zeros(2), 5)
    amplitude = 1 / (1 - 0.8**2)
    want = np.zeros((6, 2))
    want[1] = amplitude, 0.8 * amplitude
    assert_allclose(found.amplitudes, want, rtol=0, atol=1e-12)
    assert found.num_steps <= 3 and found.harmonics == 5
    t = 1.7
    exact = [amplitude * np.cos(0.8 * t), -0.8 * amplitude * np.sin(0.8 * t)]
    assert_allclose(found.evaluate(t), exact, rtol=0, atol=1e-12)
    assert "5 harmonics of 2 components" in repr(found) and "successful" in repr(found)


def test_friction_takes_from_the_amplitude_what_den_hartog_says():
    # sgn x' switches where the series
    # of x' is zero: too early by its own missing harmonics, all in phase there. So the error falls
    # as Σ 1/k² over odd k > K, or 1/2K.
    amplitude, _ = closed_forms.den_hartog()
    guess = lambda t: jnp.stack([2.7 * jnp.cos(0.8 * t), -2.2 * jnp.sin(0.8 * t)])  # noqa: E731
    ts = jnp.linspace(0.0, 2.5 * np.pi, 4001)
    errors = []
    for top in (20, 40):
        found = jf.harmonic_balance(S.DenHartog(), guess, top)
        highest = float(jax.vmap(found.evaluate)(ts)[:, 0].max())
        errors.append(highest - amplitude)
    assert_allclose(errors[0] / errors[1], 2, rtol=0.01)
    assert abs(2 * errors[1] - errors[0]) < 5e-5


def test_a_batch_over_the_forcing(orbit):
    omegas = jnp.asarray([0.65, 0.7, 0.75, 0.7])
    guesses = jnp.broadcast_to(ROUGH, (4, 3, 2)).at[3, 1, 0].set(jnp.nan)

    def solve(omega, guess):
        system = S.SDOscillator(omega=omega)
        return jf.harmonic_balance(system, guess, 19, throw=False)

    found = eqx.filter_vmap(solve)(omegas, guesses)
    assert_array_equal(outcome_names(found.result), ["successful"] * 3 + ["nonfinite"])
    starts = eqx.filter_vmap(lambda one: one.evaluate(0.0))(found)
    assert np.all(abs(starts[1] - orbit.x0) < missing(19))
    # Galerkin's first equation, by hand: (1 - Ω² + 2iζΩ) X1 = f0 + S1, where |S1| = 4/π for any
    # square wave of two equal parts.
    cosine, sine = np.asarray(found.coefficients[:3, 1:3, 0]).T
    first = cosine - 1j * sine
    w = np.asarray(omegas[:3])
    square = (1 - w**2 + 2j * 0.0141 * w) * first - 0.25
    assert_allclose(abs(square), 4 / np.pi, rtol=1e-10)
    assert "batch of shape (4,), 19 harmonics" in repr(found)


def test_a_single_failure_is_an_error():
    found = series(9, newton_steps=1, throw=False)
    assert bool(found.result == RESULTS.newton_max_steps_reached)
    with pytest.raises(RuntimeError, match="number of steps"):
        series(9, newton_steps=1)


@pytest.mark.slow
def test_from_an_orbit_and_over_two_periods(orbit):
    found = jf.harmonic_balance(orbit.system, orbit, 19)
    assert found.num_steps <= 4
    assert np.all(abs(found.evaluate(0.0) - orbit.x0) < missing(19))
    # Every other harmonic of twice the period: the same orbit.
    twice = jf.harmonic_balance(orbit.system, orbit, 38, periods=2)
    assert_allclose(twice.period, 2 * found.period, rtol=1e-15)
    assert_allclose(twice.amplitudes[::2], found.amplitudes, rtol=0, atol=1e-9)
    assert_allclose(twice.amplitudes[1::2], 0, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_smoothed_belt_that_sticks():
    # Analytic, so that the series converges fast; shooting knows nothing of it.
    belt = jf.smoothed(S.BeltFriction(gamma1=10.0, gamma2=0.0, omega=1.3), 0.5)
    orbit = jf.periodic_orbit(belt, jnp.asarray([1.5, 0.9]), steps=200)
    found = jf.harmonic_balance(belt, orbit, 30)
    assert_allclose(found.evaluate(0.0), orbit.x0, rtol=0, atol=1e-6)


def test_a_first_call_compiles_a_few_programs():
    counter = Counter()
    counter.watch()
    wave = jax.jit(lambda t: jnp.stack([3 * jnp.cos(OMEGA * t), -2.1 * jnp.sin(OMEGA * t)]))
    # No other test has as many harmonics: what it compiles is its own.
    found = jf.harmonic_balance(S.SDOscillator(omega=OMEGA), wave, 14)
    found.evaluate(1.0), found.amplitudes
    jf.harmonic_balance(S.SDOscillator(omega=OMEGA), found.coefficients[:11], 14)
    assert counter.counts["compilations"] <= 16


@pytest.mark.parametrize("omega", [1.3, 2.44])
def test_the_jacobian_is_the_derivative_of_the_residual(omega):
    # Through zeros of H that move with the coefficients.
    system = S.BeltFriction(gamma1=10.0, gamma2=0.0, omega=omega)
    balance = Galerkin(system, jnp.asarray(2 * jnp.pi / omega), 9, 2, 24)
    c = np.zeros((9, 2))
    c[1:7] = np.asarray([[0.8, 1.5], [0.3, 2.0], [0.1, 0.2], [-0.1, 0.3], [0.05, 0.1], [0.0, -0.2]])
    equations = eqx.filter_jit(Galerkin.with_derivative)
    jacobian = equations(balance, jnp.asarray(c).ravel())[1]
    assert jnp.sum(balance._quadrature(jnp.asarray(c))[3].crosses) >= 2
    for i in range(c.size):
        step = np.zeros(c.size)
        step[i] = 1e-4
        at = [
            np.asarray(equations(balance, jnp.asarray(c.ravel() + k * step))[0])
            for k in (-2, -1, 1, 2)
        ]
        slope = np.tensordot([1, -8, 8, -1], at, 1) / 12e-4
        assert_allclose(jacobian[:, i], slope, rtol=0, atol=1e-7)


class Helped(jf.System):
    """y' = cos t − y, and + j where y > d."""

    d: jax.Array
    j: jax.Array
    period = 2 * np.pi
    slides = False

    def vector_field(self, t, x, side):
        return jnp.cos(t) - x + jnp.where(side < 0, self.j, 0.0)

    def switching(self, t, x):
        return self.d - x[0]


def helped(p):
    """One harmonic of the orbit that is above d for a part β/π of the period: the force of the
    surface is j β/π + g cos τ there, with τ the phase from its middle and g = 2 j sin β/π."""
    d, j = p

    def parts(beta):
        g = 2 * j * np.sin(beta) / np.pi
        amplitude = (g + np.sqrt(2 - g**2)) / 2  # of (A − g)² + A² = 1
        return g, amplitude, d - j * beta / np.pi - amplitude * np.cos(beta)

    beta = brentq(lambda beta: parts(beta)[2], 0.9, 1.6, xtol=1e-15)
    g, amplitude, _ = parts(beta)
    middle = np.arctan2(amplitude, amplitude - g)
    return np.array([j * beta / np.pi, amplitude * np.cos(middle), amplitude * np.sin(middle)])


P = np.array([0.7, 1.0])


def solved(p, guess):
    found = jf.harmonic_balance(Helped(p[0], p[1]), guess, 1, throw=False)
    return found.coefficients[:, 0]


@pytest.mark.parametrize("away", [0.0, 0.02])
def test_coefficients_have_the_derivatives_of_the_closed_form(away):
    guess = jnp.asarray(helped(P)[:, None] + away)
    assert_allclose(solved(jnp.asarray(P), guess), helped(P), rtol=0, atol=1e-12)
    steps = 1e-4 * np.eye(2)
    exact = np.stack([(helped(P + h) - helped(P - h)) / 2e-4 for h in steps], axis=1)
    for derivative in (jax.jacfwd, jax.jacrev):
        found = jax.jit(derivative(solved))(jnp.asarray(P), guess)
        assert_allclose(found, exact, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_coefficients_have_second_derivatives():
    guess, steps = jnp.asarray(helped(P)[:, None]), 1e-3 * np.eye(2)
    pairs = [[helped(P + g + h) - helped(P + g - h) for h in steps] for g in steps]
    other = [[helped(P - g + h) - helped(P - g - h) for h in steps] for g in steps]
    exact = np.moveaxis((np.array(pairs) - np.array(other)) / 4e-6, 2, 0)
    found = jax.jit(jax.hessian(solved))(jnp.asarray(P), guess)
    assert_allclose(found, exact, rtol=0, atol=1e-4)


class Biased(jf.System):
    """x'' + x + k sgn x = A sin 2t + bias, with a clock that ticks at phase 0, or without."""

    a: jax.Array
    bias: jax.Array
    clocked: bool = eqx.field(static=True)
    period = np.pi

    def vector_field(self, t, x, side):
        force = self.a * jnp.sin(2 * t) + self.bias
        return jnp.stack([x[1], force - x[0] - 0.5 * side])

    def switching(self, t, x):
        return x[0]

    @property
    def clocks(self):
        return (jf.Clock(np.pi / 2),) if self.clocked else ()


@pytest.mark.parametrize("clocked", [False, True])
def test_a_zero_at_phase_0_is_a_crossing(clocked):
    """The series is −X sin 2t, X = (A + 2/π)/3; the mean of sgn (c + x) is 2c/πX for small c."""

    def mean(bias, a):
        size = (a + 2 / jnp.pi) / 3
        guess = jnp.array([[0.0, 0.0], [0.0, -2.0], [-1.0, 0.0]]) * size
        found = jf.harmonic_balance(Biased(a, bias, clocked), guess, 1, throw=False)
        return found.coefficients[0, 0]

    amplitudes = jnp.linspace(0.7, 1.5, 9)
    slopes = jax.jit(jax.vmap(jax.grad(mean), (None, 0)))(0.0, amplitudes)
    assert_allclose(slopes, 1 / (1 + 3 / (jnp.pi * amplitudes + 2)), rtol=0, atol=1e-9)


@pytest.mark.parametrize("late", [0.0, 0.2])
def test_a_pass_within_one_cell_is_seen(late):
    """Where a sine reaches d for an angle 2β only, which is 1/10 of a cell."""
    beta = 0.025
    d = np.cos(beta)
    c = np.array([0.0, np.cos(late), np.sin(late)])
    # x' − cos t + x, without the force j/2π ∫ (1, 2 cos, 2 sin) over the pass.
    expected = np.array([0.0, c[1] + c[2] - 1, c[2] - c[1]])
    expected -= np.array([beta, 2 * np.sin(beta) * c[1], 2 * np.sin(beta) * c[2]]) / np.pi
    galerkin = Galerkin(Helped(jnp.float64(d), jnp.float64(1.0)), jnp.float64(2 * np.pi), 3, 1, 12)
    found = eqx.filter_jit(Galerkin.with_derivative)(galerkin, jnp.asarray(c))[0]
    assert_allclose(found, 2 * np.pi * expected, rtol=0, atol=1e-12)


class Waves(jf.System):
    """x' = −x + sgn(0.6 − cos kt), with the mean 1 − 2 arccos(0.6)/π."""

    k: jax.Array
    slides = False
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return side - x

    def switching(self, t, x):
        return 0.6 - jnp.cos(self.k * t)


def test_crossings_that_the_grid_does_not_resolve_are_told():
    """In 16 cells, of 6 and of 26 zeros."""

    def balanced(k):
        return jf.harmonic_balance(Waves(k), jnp.zeros((5, 1)), harmonics=2, throw=False)

    found = eqx.filter_vmap(balanced)(jnp.array([3.0, 13.0]))
    assert outcome_names(found.result).tolist() == ["successful", "step_too_long"]
    mean = 1 - 2 * np.arccos(0.6) / np.pi
    assert_allclose(found.coefficients[0, :, 0], [mean, 0, 0, 0, 0], rtol=0, atol=1e-12)


class Pulsed(jf.System):
    """x' = −x and + 1 during the first part of each of `many` pulses in a period."""

    part: jax.Array
    many: int = eqx.field(static=True)
    period = 1.0

    def vector_field(self, t, x, side):
        return jnp.where(jnp.mod(self.many * t, 1.0) < self.part, 1.0, 0.0) - x

    @property
    def clocks(self):
        return jf.Clock(1 / self.many), jf.Clock(1 / self.many, self.part / self.many)


@pytest.mark.parametrize("many", [1, 40])
def test_a_field_that_jumps_at_ticks(many):
    """The harmonics of the pulses are balanced one by one. Of one pulse, two ends are on the grid,
    and one is beside it."""

    def exact(part):
        k = many * np.arange(1, 3)
        of_pulses = many * (1 - np.exp(-2j * np.pi * k / many * part)) / (1j * np.pi * k)
        x = np.where(k <= 2, of_pulses / (1 + 2j * np.pi * k), 0)
        return np.concatenate([[part], *((v.real, -v.imag) for v in x)])

    def found(part):
        balanced = jf.harmonic_balance(Pulsed(part, many), jnp.zeros((5, 1)), 2, throw=False)
        return balanced.coefficients[:, 0]

    parts = jnp.array([0.37, 0.5, 0.625, 0.5 + 1e-13])
    values, slopes = jax.vmap(lambda part: jax.jvp(found, (part,), (jnp.ones_like(part),)))(parts)
    for part, value, slope in zip(parts.tolist(), values, slopes, strict=True):
        assert_allclose(value, exact(part), rtol=0, atol=1e-13)
        near = (exact(part + 1e-3) - exact(part - 1e-3)) / 2e-3
        assert_allclose(slope, near, rtol=0, atol=1e-5)


class Kicked(jf.System):
    """A kick of one each period."""

    period = 2 * np.pi
    clocks = (jf.Clock(2 * np.pi, 1.0),)

    def vector_field(self, t, x, side):
        return -x + jnp.cos(t)

    def tick(self, t, x, clock):
        return x + 1


@pytest.mark.parametrize(
    "change, message",
    [
        ({"system": S.SlipStick()}, "`system` must be forced, but the period of SlipStick is None"),
        ({"system": S.SDOscillator}, "`system` must be an instance"),
        ({"guess": jnp.zeros((4, 2))}, r"`guess` must be .* got shape \(4, 2\)"),
        ({"guess": jnp.zeros(3)}, r"`guess` must be .* got shape \(3,\)"),
        ({"guess": lambda t: jnp.cos(t)}, r"`guess` must return a state, .* got \(\)"),
        ({"guess": lambda t: jnp.zeros((2, 1))}, r"`guess` must return a state, .* got \(2, 1\)"),
        ({"system": S.ImpactOscillator()}, "`system` must have no `reset`, since a Fourier series"),
        ({"system": Kicked()}, "`system` must have no `tick`, since a Fourier series"),
        ({"harmonics": 0}, "`harmonics` must be an integer of at least 1, got 0"),
        ({"periods": 0.5}, "`periods` must be an integer of at least 1, got 0.5"),
        ({"newton_steps": 0}, "`newton_steps` must be an integer of at least 1, got 0"),
    ],
)
def test_bad_calls(change, message):
    call = {"system": S.SDOscillator(), "guess": ROUGH, "harmonics": 3} | change
    with pytest.raises(ValueError, match=message):
        jf.harmonic_balance(call.pop("system"), call.pop("guess"), call.pop("harmonics"), **call)
