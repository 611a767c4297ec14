"""Lyapunov exponents: closed forms, known multipliers, and how an average says it is none."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS
from jaxfil.exponents import batch_means
from jaxfil.exponents.frame import generic_frame
from jaxfil.integrate.system import lowered
from jaxfil.integrate.system.components import pack
from jaxfil.model.outcomes import outcome_names
from tests.problems import PROBLEMS
from tests.problems.systems import cubic_belt
from tests.problems.values import BELT_DAMPING, CUBIC_LYAPUNOV, SD_DAMPING


class Linear(jf.System):
    """x' = Ax, without a surface."""

    matrix: jax.Array

    def vector_field(self, t, x, side):
        return self.matrix @ x


class MovingTable(jf.System):
    """A ball above a table that moves as a(t): an impact turns v - a' into -e(v - a')."""

    e: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -1.0 - 0.1 * x[1]])

    def switching(self, t, x):
        return x[0] - 0.2 * jnp.sin(t)

    def reset(self, t, x, surface):
        rise = 0.2 * jnp.cos(t)
        return jnp.stack([x[0], rise - self.e * (x[1] - rise)])


def spectra(systems, x0, **counts):
    """A lane for each system and state."""
    return eqx.filter_vmap(lambda s, x: jf.lyapunov_spectrum(s, x, **counts))(systems, x0)


def stacked(make, **leaves):
    return eqx.filter_vmap(lambda kw: make(**kw))({k: jnp.asarray(v) for k, v in leaves.items()})


def test_decay():
    # x' = -x: -1. Known at once, so that the error is rounding.
    found = jf.lyapunov_spectrum(
        Linear(-jnp.eye(1)), jnp.ones(1), periods=100, transient=0, interval=0.5, stepper=jf.RK4()
    )
    assert_allclose(found.exponents, [-1.0], rtol=1e-9)
    assert_allclose(found.running[:, 0], -1.0, rtol=1e-9)
    assert_allclose(found.times[jnp.array([0, -1])], [1.5, 50.0])
    assert found.settled and found.result == RESULTS.successful
    assert_array_equal(found.x0, [1.0])


def test_eigenvalues_and_a_contraction_that_rounding_hides():
    # Triangular: exponents are the diagonal. Over an interval of 1 the second direction shrinks by
    # e^-50 against the first; over 0.1 it is seen.
    systems = Linear(jnp.array([[[0.3, 1.0], [0.0, -1.2]], [[0.3, 1.0], [0.0, -50.0]]]))
    x0 = jnp.ones((2, 2))
    run = {"periods": 200, "transient": 400, "steps": 40, "stepper": jf.RK4()}
    for interval, second in ((0.1, [-1.2, -50.0]), (1.0, [-1.2, np.nan])):
        found = spectra(systems, x0, interval=interval, **run)
        assert_allclose(found.exponents[:, 0], 0.3, rtol=0, atol=1e-6)
        assert_allclose(found.exponents[:, 1], second, rtol=2e-4)
        assert_array_equal(found.settled, np.isfinite(second))


class Kicked(jf.System):
    """x0' = -0.1 x0 + x1, x1' = -20 x1, and a third one that decays, or slides with a `pull`; once
    a period of 2 the second is multiplied by `keep`, and 1 is added to it."""

    keep: jax.Array
    pull: jax.Array
    period = 2.0

    @property
    def clocks(self):
        return (jf.Clock(2.0, 0.5),)

    def vector_field(self, t, x, side):
        return jnp.stack([-0.1 * x[0] + x[1], -20 * x[1], -self.pull * side - x[2]])

    def switching(self, t, x):
        return x[2]

    def tick(self, t, x, clock):
        return jnp.stack([x[0], self.keep * x[1] + 1, x[2]])


def test_what_rounding_hides_is_not_lost_by_a_kick_or_a_slide():
    # Within a period the second direction shrinks by e^-40 against the first. It is lost where the
    # kick sets it, and the third is where it slides, with a new frame after each step.
    keep, pull = jnp.array([[1.0, 0.0], [0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]).T
    run = {"periods": 4, "transient": 24, "steps": 80, "stepper": jf.RK4()}
    found = spectra(Kicked(keep, pull), jnp.tile(jnp.array([0.0, 0.0, 1.0]), (4, 1)), **run)
    second = [[-1.0, np.nan], [-1.0, -np.inf], [-20.0, -np.inf], [-np.inf, -np.inf]]
    assert_allclose(found.exponents[:, 0], -0.1, rtol=1e-3)
    assert_allclose(found.exponents[:, 1:], second, rtol=2e-3)
    assert np.all(found.result == RESULTS.successful)


class Servo(jf.System):
    """x' = A cos t − side, with a sensor of x that has a gain."""

    gain: jax.Array
    force: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return (self.force * jnp.cos(t) - side)[None]

    def switching(self, t, x):
        return self.gain * x[0]


def test_a_state_that_is_lost_as_a_whole_is_lost_in_any_unit():
    # It sticks to x = 0 for a part of each period, or for good, and forgets all of its state.
    systems = stacked(Servo, gain=[1.0, 3.0, 0.1, 3.0, 0.2], force=[1.4, 1.4, 1.4, 0.5, 0.5])
    run = {"periods": 4, "transient": 2, "steps": 20, "stepper": jf.RK4()}
    found = spectra(systems, jnp.full((5, 1), 0.2), **run)
    assert_array_equal(found.exponents, -np.inf)


class Ball(MovingTable):
    """On a table that never leaves it behind, and no drag: it comes to rest and lies for good."""

    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])


@pytest.mark.release
def test_a_ball_that_lies_on_a_moving_table_has_lost_both_directions():
    systems = stacked(Ball, e=[0.5, 0.85])
    run = {"periods": 3, "transient": 8, "steps": 20, "stepper": jf.RK4(), "compact": True}
    found = spectra(systems, jnp.tile(jnp.array([0.5, 0.0]), (2, 1)), **run)
    assert np.all(found.result == RESULTS.successful)
    assert_array_equal(found.exponents, -np.inf)


def test_the_derivative_of_an_exponent():
    def largest(a):
        system = Linear(-a * jnp.eye(1))
        return jf.lyapunov_spectrum(
            system, jnp.ones(1), periods=3, transient=0, interval=0.5, stepper=jf.RK4()
        ).exponents[0]

    value, slope = jax.jvp(largest, (jnp.asarray(0.2),), (jnp.asarray(1.0),))
    assert_allclose([value, slope], [-0.2, -1.0], rtol=1e-9)


def sd_run(omega, x0, periods):
    return spectra(
        stacked(jf.systems.SDOscillator, omega=omega), x0, periods=periods, transient=100
    )


@pytest.mark.slow
@pytest.mark.long_run
def test_the_sd_oscillator():
    # Divergence -2ζ on both sides, and crossings keep the volume. At Ω = 0.7 the
    # one-sided orbit has both exponents -ζ; at 0.87 chaos, 0.08889(4), from an independent code.
    one_sided = 1 + 0.25 / (1 - 0.7**2)
    omega = [0.7, 0.87, 0.87, 0.87, 0.95, 1.0, np.nan, 1.25]
    x0 = jnp.array([[0.3 + 0.05 * i, 0.1] for i in range(8)]).at[0].set([one_sided, 0.02])
    found = sd_run(omega, x0, 1000)
    good = np.isfinite(omega)
    assert_array_equal(found.result == RESULTS.successful, good)
    assert np.all(np.isnan(found.exponents[~good])) and not np.any(found.settled[~good])
    assert_allclose(found.exponents[good].sum(axis=1), SD_DAMPING, rtol=0, atol=1e-8)
    assert_allclose(found.exponents[0], SD_DAMPING / 2, rtol=0, atol=1e-4)
    error = found.standard_error[1:4, 0]
    assert np.all(abs(found.exponents[1:4, 0] - 0.08889) < 3 * error)
    assert np.all((error > 5e-4) & (error < 5e-3))
    assert np.all(found.settled[:4])
    assert_array_equal(found.x0, x0)


# Sticks, crosses, sticks for a moment, free.
ORBITS = [PROBLEMS[name] for name in ("belt 1.3", "belt 2.44", "belt 9.1", "cubic belt 4.56")]


def belts():
    """The orbits above, chaos at ω = 4.6 from rest, and a transient that ends."""
    systems = [*(p.system for p in ORBITS), cubic_belt(4.6), cubic_belt(4.5635)]
    x0 = [*(p.x0 for p in ORBITS), (0.0, 0.0), (0.0, 0.0)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *systems), jnp.asarray(x0)


@pytest.mark.slow
@pytest.mark.long_run
def test_the_belt():
    systems, x0 = belts()
    found = spectra(systems, x0, periods=1000, transient=40)
    assert np.all(found.result == RESULTS.successful)
    for i, p in enumerate(ORBITS):
        multipliers = np.sort(np.abs(p.multipliers))[::-1]
        rates = np.log(np.maximum(multipliers, 1e-300)) / p.t1
        if multipliers[1] == 0:
            assert_allclose(found.exponents[i, 0], rates[0], rtol=1e-8)
            assert found.exponents[i, 1] == -np.inf and found.standard_error[i, 1] == 0
        else:
            assert_allclose(found.exponents[i], rates, rtol=0, atol=2e-3)
            assert_allclose(found.exponents[i].sum(), rates.sum(), rtol=2e-6)
        assert found.settled[i]
    # Half the divergence αg twice.
    assert_allclose(found.exponents[3].sum(), BELT_DAMPING, rtol=2e-6)
    # Sticking chaos.
    assert abs(found.exponents[4, 0] - CUBIC_LYAPUNOV) < 3 * found.standard_error[4, 0]
    assert found.exponents[4, 1] == -np.inf and found.settled[4]
    # From rest at 4.5635 the motion sticks at first and ends on the orbit that never does.
    assert found.settled[5]
    assert_allclose(found.exponents[5], BELT_DAMPING / 2, rtol=0, atol=5e-3)
    early = spectra(systems, x0, periods=200, transient=0)
    assert not early.settled[5] and early.exponents[5, 1] == -np.inf


ONCE = {"periods": 1, "transient": 0, "steps": 400, "stepper": jf.RK4()}


def rows_of(frame):
    """The vectors of a frame, as the rows of a matrix."""
    return np.array([pack(v, float) for v in frame] if isinstance(frame, tuple) else frame)


def by_differences(system, x0, t1):
    """(1/t1) log of the diagonal of R in J Q = Q' R, J by central differences."""
    frame = rows_of(generic_frame(lowered.build(system, x0, compact=False)))
    move = 1e-6

    @jax.jit
    @jax.vmap
    def end(x):
        return jf.solve(system, x, 0.0, t1, t1 / 400, stepper=jf.RK4()).x_final

    ends = end(jnp.concatenate([x0 + move * frame, x0 - move * frame]))
    change = np.array(ends[:2] - ends[2:]).T / (2 * move)
    return np.log(np.abs(np.diag(np.linalg.qr(change)[1]))) / t1


def test_new_numbers_trace_nothing():
    count = 0

    class Counted(Linear):
        def vector_field(self, t, x, side):
            nonlocal count
            count += 1
            return self.matrix @ x

    def run(a, periods, transient):
        return jf.lyapunov_spectrum(
            Counted(a * jnp.eye(1)),
            jnp.ones(1),
            periods=periods,
            transient=transient,
            interval=a,
            stepper=jf.RK4(),
        )

    run(jnp.asarray(0.5), 40, 4)
    before = count
    run(jnp.asarray(0.7), 90, 0)
    assert count <= before + 1  # a look at its shapes, at the door


@pytest.mark.release
def test_an_impact_on_a_moving_table():
    # One impact, at a time that depends on the initial state, with a reset that depends on time.
    system, x0 = MovingTable(jnp.asarray(0.8)), jnp.array([1.0, 0.0])
    found = jf.lyapunov_spectrum(system, x0, **ONCE, interval=2.0)
    assert_allclose(found.exponents, by_differences(system, x0, 2.0), rtol=0, atol=1e-7)
    # Volume: shrinks by e² at the impact, by exp(-0.1 t) between.
    assert_allclose(found.exponents.sum(), np.log(0.8) - 0.1, rtol=1e-7)
    assert found.settled and np.isnan(found.standard_error).all()


@pytest.mark.slow
def test_sticking_to_a_moving_belt():
    system, x0 = jf.systems.MovingBelt(), jnp.array([3.0, 0.0])
    found = jf.lyapunov_spectrum(system, x0, **ONCE, interval=12.0)
    # It sticks at 9.483, slips at 9.765 (tests.problems), and has lost a direction by then.
    assert found.exponents[1] == -np.inf
    assert_allclose(found.exponents[0], by_differences(system, x0, 12.0)[0], rtol=0, atol=1e-7)


@jax.jit
@jax.vmap
def averages(growth):
    return batch_means.averages(growth, jnp.arange(1.0, 33) * 10)


def settled(growth):
    return bool(averages(growth[None])[3][0])


def test_a_steady_average_and_a_transient_that_ends():
    noise = np.random.default_rng(0).normal(size=(4000, 32, 1))
    assert np.mean(averages(9 + noise)[3]) > 0.997
    for k in (1, 8, 16, 30):
        change = np.where(np.arange(32) < k, 10.0, 0.0)[:, None]
        assert not settled(9 + noise[0] + change)
    tiny = np.where(np.arange(32) < 1, 1e-3, 0.0)[:, None]
    assert settled(9 + tiny), "less than a factor e in all"


def test_directions_lost_for_a_while():
    lost = np.full((32, 1), -np.inf)
    assert settled(lost)
    assert not settled(np.where(np.arange(32)[:, None] < 1, lost, 3.0))
    at_random = np.random.default_rng(1).uniform(size=(32, 1)) < 0.5
    assert settled(np.where(at_random, lost, 3.0))


def test_the_standard_error_is_that_of_independent_batches():
    mean, _, error, _ = averages(np.random.default_rng(2).normal(size=(4000, 32, 1)))
    assert_allclose(np.std(mean), np.sqrt(np.mean(error**2)), rtol=0.03)
    assert_allclose(np.std(mean), np.sqrt(32) / 320, rtol=0.03)


class Forced(jf.System):
    """x' = cos ωt − x, without a surface: soonest compiled."""

    omega: jax.Array

    @property
    def period(self):
        return 2 * jnp.pi / self.omega

    def vector_field(self, t, x, side):
        return jnp.cos(self.omega * t) - x


@pytest.mark.slow
def test_a_negative_period_is_told():
    few = {"periods": 20, "transient": 1, "steps": 20, "stepper": jf.RK4()}

    @eqx.filter_jit
    @eqx.filter_vmap
    def lanes(omega):
        system, x0 = Forced(omega), jnp.asarray([0.1])
        drive = jf.synchronization_exponent(system, x0, couplings=[0.1], **few)
        verbs = jf.lyapunov_spectrum, jf.transverse_exponent
        found = [verb(system, x0, **few) for verb in verbs]
        return [(each.result, each.running) for each in found], drive.results

    found, drive = lanes(jnp.asarray([1.0, -1.0]))
    for result, running in found:
        assert outcome_names(result).tolist() == ["successful", "invalid_period"]
        assert np.isnan(running[1]).all() and np.isfinite(running[0]).all()
    assert outcome_names(drive).tolist() == [["successful"], ["invalid_period"]]


@pytest.mark.parametrize(
    "change, message",
    [
        ({"system": 3}, "`system` must be an instance of jaxfil.System"),
        ({"x0": np.zeros((2, 2))}, r"`x0` must be of shape \(n,\)"),
        ({"periods": 0}, "`periods` must be an integer of at least 1"),
        ({"transient": -1}, "`transient` must be an integer of at least 0"),
        ({"steps": 2.5}, "`steps` must be an integer of at least 1"),
        ({"periods": 2**30}, "must make fewer than"),
        ({"interval": -1.0}, "`interval` must be a positive number"),
        (
            {"system": jf.systems.CoulombOscillator()},
            "`interval` must be a positive number, since Coul",
        ),
        ({"stepper": "rk4"}, "`stepper` must be"),
    ],
)
def test_bad_calls(change, message):
    call = {"system": jf.systems.BeltFriction(), "x0": np.zeros(2), **change}
    with pytest.raises(ValueError, match=message):
        jf.lyapunov_spectrum(call.pop("system"), call.pop("x0"), **call)
