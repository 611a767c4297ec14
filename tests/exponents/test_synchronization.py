"""Drive and response: sliding on intersections, and exponents without a derivative."""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS
from jaxfil.integrate.surfaces import filippov, weights as sliding_weights
from jaxfil.integrate.surfaces.corners import Corners, corner_sides
from jaxfil.integrate.system import lowered
from jaxfil.integrate.system.components import Components
from jaxfil.model.parameter import cast
from tests.problems.systems import Guided
from tests.problems.values import CUBIC_LYAPUNOV

BELT = jf.systems.BeltFriction(omega=4.6)
PERIOD = 2 * np.pi / 4.6
# A state of sticking chaos at ω = 4.6 that has just stuck, and leaves the belt 0.17 later.
STUCK = np.array([-0.0724302, 1.0])
START = 20 * PERIOD + 0.93566


class Decay(jf.System):
    """x' = ax, y' = (a - 1)y, without a surface."""

    a: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([self.a * x[0], (self.a - 1) * x[1]])


class Brakes(jf.System):
    """Two brakes: x' = -sgn x, y' = -2 sgn y. Both states stop at zero."""

    def vector_field(self, t, x, side):
        return -jnp.array([1.0, 2.0]) * side

    def switching(self, t, x):
        return x


class Sawtooth(jf.System):
    """x' = (τ - c) x, τ the time since a tick: λ1 is its mean, T/2 - c."""

    tooth: jax.Array

    def vector_field(self, t, x, side):
        return (jnp.mod(t - 0.1, self.tooth) - 0.25) * x

    @property
    def period(self):
        return 3 * self.tooth

    @property
    def clocks(self):
        return (jf.Clock(self.tooth, 0.1),)


@jax.jit
@jax.vmap
def pair_end(z, coupling, t0, t1, dt):
    """Where belt and belt end, and what happened."""
    pair = jf.drive_response(BELT, coupling)
    sol = jf.solve(pair, z, t0, t1, dt, stepper=jf.RK4(), max_events=None, throw=False)
    return sol.x_final, sol.num_events, sol.result


def ends(z, coupling, t0, t1, dt):
    """`pair_end` for 8 lanes, so that all share one compiled program."""
    z = jnp.broadcast_to(jnp.asarray(z, float), (8, 4))
    rest = (jnp.broadcast_to(jnp.asarray(v, float), (8,)) for v in (coupling, t0, t1, dt))
    x, events, result = pair_end(z, *rest)
    assert np.all(result == RESULTS.successful)
    return np.array(x), np.array(events)


def test_what_belongs_to_what():
    pair = jf.drive_response(BELT, 0.3)
    built = lowered.build(cast(pair, jnp.float64), jnp.zeros(4), compact=False)
    assert built.m == 2 and built.slides and built.structure.separate
    assert built.structure.switched == ((), (0,), (), (1,))
    smooth = jf.drive_response(Decay(jnp.asarray(-0.1)), 0.3)
    assert lowered.build(cast(smooth, jnp.float64), jnp.zeros(4), compact=False).m == 0
    assert not jf.drive_response(jf.systems.SDOscillator(), 0.3).slides
    assert pair.period == BELT.period


def test_a_surface_that_another_side_steers_is_not_separate():
    class Crossed(Brakes):
        def switching(self, t, x):
            return jnp.stack([x[0] + x[1], x[0] - x[1]])

    x = jnp.ones(2)
    assert lowered.build(cast(Brakes(), x.dtype), x, compact=False).structure.separate
    built = lowered.build(Crossed(), x, compact=False)
    assert not built.structure.separate and built.structure.affine and len(corner_sides(built)) == 3


def test_separate_surfaces_have_the_weights_and_modes_of_all_four_corners():
    # Rates of which the j-th depends on side j alone: four corners hold the numbers of two.
    draw = np.random.default_rng(0)
    rates = jnp.asarray(draw.normal(size=(500, 2, 2)))
    modes = jnp.asarray(draw.integers(-1, 2, size=(500, 2)), float)
    on = jnp.asarray(draw.uniform(size=(500, 2)) < 0.8)

    @jax.jit
    @jax.vmap
    def both(rate, mode, on):
        above, below = tuple(rate[0]), tuple(rate[1])
        four = [above, (above[0], below[1]), (below[0], above[1]), below]
        mode, on, one = Components(mode), Components(on), jnp.ones(())

        def all_of(rows):
            rows = Corners(map(Components, rows))
            weights = sliding_weights.weights(mode, rows)
            determinant = sliding_weights.determinant(mode, rows, weights)
            return (weights, determinant), filippov.choose(None, rows, None, mode, on, one, on)

        return [all_of(rows) for rows in ([above, below], four)]

    two, four = both(rates, modes, on)
    jax.tree.map(ft.partial(assert_allclose, rtol=1e-12), two[0], four[0])
    assert_array_equal(two[1][1], four[1][1])
    decided = two[1][1] == 1
    assert 100 < decided.sum() < 500
    chosen, expected = (jnp.stack(found[1][0].parts)[:, decided] for found in (two, four))
    assert_array_equal(chosen, expected)


def test_synchronised_stays_synchronised_exactly():
    # Forty periods of sticking chaos, with one clock for both and with the contacts of one.
    z = np.concatenate([STUCK, STUCK])
    x, events = ends(z, np.linspace(0, 0.7, 8), START, START + 40 * PERIOD, PERIOD / 100)
    assert_array_equal(x[:, :2], x[:, 2:])
    assert np.all(events > 20)


def test_order_through_slides_on_the_intersection():
    # Both stick and both leave, at different times, in between a slide on the intersection.
    z = np.concatenate([STUCK, STUCK - [0.01, 0]])
    steps = np.array([50, 100, 200, 400, 800, 1600, 3200, 12800])
    x, events = ends(z, 0.3, START, START + 1.5 * PERIOD, 1.5 * PERIOD / steps)
    assert np.all(events == events[-1]) and events[-1] >= 2
    error = np.abs(x[:-1] - x[-1]).max(axis=1)
    order = np.log2(error[:-1] / error[1:])
    assert np.all(order[-2:] > 3.8), order


def test_leaving_the_belt_together_keeps_the_distance():
    # The masses leave within 1e-6 down to 1e-13 of each other. Their distance after is the tangent
    # carried by the derivative of one mass; taking them for one at the exit loses it.
    apart = np.array([1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13])
    z = np.concatenate([STUCK, STUCK]) + apart[:, None] * [0, 0, 1, 0]
    x, _ = ends(z, 0.0, START, START + PERIOD, PERIOD / 100)
    found = (x[:, 2:] - x[:, :2]) / apart[:, None]

    def one(shift):
        x0 = jnp.asarray(STUCK) + jnp.array([1.0, 0.0]) * shift
        sol = jf.solve(BELT, x0, START, START + PERIOD, PERIOD / 100, stepper=jf.RK4())
        return sol.x_final

    _, tangent = jax.jvp(one, (0.0,), (1.0,))
    assert np.linalg.norm(tangent) > 10
    assert_allclose(found[:5], np.tile(tangent, (5, 1)), rtol=1e-4, atol=1e-4)
    assert_allclose(found, np.tile(tangent, (8, 1)), rtol=0.02, atol=0.02)


@pytest.mark.slow
def test_the_derivative_through_the_intersection():
    z = jnp.concatenate([jnp.asarray(STUCK), jnp.asarray(STUCK) - jnp.array([0.01, 0.0])])
    t1, direction = START + PERIOD, jnp.array([1.0, 0.0, -0.4, 0.0])

    def end(shift):
        pair = jf.drive_response(BELT, 0.3 + 2 * shift)
        dt = PERIOD / 3200
        return jf.solve(pair, z + shift * direction, START, t1, dt, stepper=jf.RK4()).x_final

    _, slope = jax.jvp(end, (0.0,), (1.0,))
    move = 1e-6 * np.array([1.0, -1.0, 0, 0, 0, 0, 0, 0])
    shifted = np.array(z) + move[:, None] * np.array(direction)
    x, _ = ends(shifted, 0.3 + 2 * move, START, t1, PERIOD / 3200)
    assert_allclose(slope, (x[0] - x[1]) / 2e-6, rtol=1e-6, atol=1e-6)


def test_two_surfaces_become_four():
    pair = jf.drive_response(Brakes(), 0.0)
    sol = jf.solve(pair, jnp.array([0.5, -1.5, 0.25, 1.0]), 0.0, 1.0, 0.1, stepper=jf.RK4())
    count = int(sol.num_events)
    assert_allclose(np.unique(np.round(sol.events.ts[:count], 12)), [0.25, 0.5, 0.75])
    assert_array_equal(sol.modes[-1], [0, 0, 0, 0])
    assert_array_equal(sol.xs[-1], np.zeros(4))


@pytest.mark.slow
def test_impacts_of_each_half():
    # A ball from height h first hits the floor at √(2h/g); uncoupled halves are two single runs.
    ball = jf.systems.BouncingBall()
    pair = jf.drive_response(ball, 0.0)
    z = jnp.array([10.0, 0.0, 5.0, 0.0])
    sol = jf.solve(pair, z, 0.0, 2.5, 0.1, stepper=jf.RK4(), max_events=8)
    assert sol.events.surfaces[:2].tolist() == [1, 0]
    assert_allclose(sol.events.ts[:2], np.sqrt(2 * np.array([5.0, 10.0]) / 9.8), rtol=1e-12)
    for h, half in ((10.0, sol.x_final[:2]), (5.0, sol.x_final[2:])):
        hit = np.sqrt(2 * h / 9.8)
        up, since = 0.9 * 9.8 * hit, 2.5 - hit
        assert since < 2 * up / 9.8
        assert_allclose(half, [up * since - 4.9 * since**2, up - 9.8 * since], rtol=1e-10)


def test_the_threshold_of_a_linear_system_and_its_bias():
    # |x − y| falls as exp((a − ε)t) along x, faster along y, from 1 % of |x| at once: what
    # synchronises within T has ε ≥ a + log(d0/tolerance)/T.
    a, time, grid = -0.02, 400.0, jnp.linspace(-0.05, 0.15, 201)
    run = {"periods": 100, "transient": 0, "interval": 4.0, "stepper": jf.RK4()}
    x0 = jnp.array([1.0, 0.0])
    found = jf.synchronization_exponent(Decay(jnp.asarray(a)), x0, grid, tolerance=1e-9, **run)
    assert found.time == time and np.all(found.results == RESULTS.successful)
    unit = np.random.default_rng(0).normal(size=2)
    part = 0.01 * abs(unit[0]) / np.linalg.norm(unit)
    assert_allclose(found.exponent, a + np.log(part / 1e-9) / time, rtol=0, atol=1.1e-3)
    assert_allclose(found.bias, 0.0005 + np.log(1e-2 / 1e-9) / time, rtol=1e-6)
    first = int(np.argmax(found.synchronized))
    assert np.all(found.synchronized[first:]) and grid[first] == found.exponent
    assert np.all(found.distances[:first] > 1e-9)
    none = jf.synchronization_exponent(Decay(jnp.asarray(a)), x0, grid - 1, tolerance=1e-9, **run)
    assert np.isnan(none.exponent) and not np.any(none.synchronized)


@pytest.mark.parametrize(
    "a, size, transient", [(-0.1, 1.0, 200), (0.01, 1e-9, 0), (0.01, 1e200, 0)]
)
def test_the_threshold_does_not_depend_on_the_size_of_the_drive(a, size, transient):
    """The drive of the first has decayed to 1e-35."""
    run = {"periods": 100, "interval": 4.0, "stepper": jf.RK4(), "tolerance": 1e-9}
    system, x0, grid = Decay(jnp.asarray(a)), jnp.array([size, 0.0]), jnp.linspace(-0.1, 0.1, 201)
    found = jf.synchronization_exponent(system, x0, grid, transient=transient, **run)
    unit = np.random.default_rng(0).normal(size=2)
    part = 0.01 * abs(unit[0]) / np.linalg.norm(unit)
    assert_allclose(found.exponent, a + np.log(part / 1e-9) / 400, rtol=0, atol=1.1e-3)
    # The size is that of a period, in which the drive grows.
    assert_allclose(found.tolerance, 1e-9 * size * np.exp(4 * a * transient), rtol=0.05)


def test_the_bias_has_half_of_the_step_of_the_grid_that_the_exponent_lies_in():
    """What synchronises has ε ≥ 0.0195 or so. Where the lowest coupling does already, or none does,
    no step holds the exponent, and nothing is known of how far off the answer is."""
    run = {"periods": 100, "transient": 0, "interval": 4.0, "stepper": jf.RK4(), "tolerance": 1e-9}
    grids = jnp.array([[-0.3, 0.0, 0.06], [0.0, 0.04, 0.5], [0.03, 0.1, 0.4], [-0.9, -0.5, -0.4]])
    system, x0 = Decay(jnp.asarray(-0.02)), jnp.array([1.0, 0.0])
    found = [jf.synchronization_exponent(system, x0, grid, **run) for grid in grids]
    assert_array_equal([f.exponent for f in found], [0.06, 0.04, 0.03, np.nan])
    late = np.log(1e-2 / 1e-9) / 400
    assert_allclose([f.bias for f in found], [0.03 + late, 0.02 + late, np.nan, np.nan], rtol=1e-12)
    told = [repr(f).splitlines()[0] for f in found]
    assert told[1] == "Synchronization: exponent 0.04, biased by about 0.06"
    assert told[2] == "Synchronization: exponent at most 0.03, the lowest of the couplings"
    assert told[3] == "Synchronization: no exponent, for no coupling synchronises"


def test_the_rate_of_a_linear_system():
    run = {"periods": 200, "transient": 10, "interval": 0.5, "stepper": jf.RK4()}
    system, x0 = Decay(jnp.asarray(0.02)), jnp.array([1.0, 1.0])
    for coupling in (0.0, 0.7):
        found = jf.transverse_exponent(system, x0, coupling=coupling, **run)
        assert_allclose(found.running[-1], found.exponent)
        later = found.exponent * 100 - found.running[15] * found.times[15]
        assert_allclose(later / (100 - found.times[15]), 0.02, rtol=0, atol=1e-6)
        assert found.result == RESULTS.successful and np.isfinite(found.standard_error)
    lost = jf.transverse_exponent(system, x0, coupling=60.0, **run)
    assert np.isnan(lost.exponent) and not lost.settled


@pytest.mark.release
@pytest.mark.long_run
def test_sticking_chaos_by_its_rate():
    # At ω = 4.6; 32 initial states, ε on both sides of it.
    x0 = jnp.asarray([[0.002 * i, 0.002 * i] for i in range(32)])
    couplings = jnp.asarray([0.2, 0.6] * 16)
    run = {"periods": 500, "transient": 200, "compact": True}
    found = eqx.filter_vmap(lambda x, c: jf.transverse_exponent(BELT, x, coupling=c, **run))(
        x0, couplings
    )
    exponents, errors = np.array(found.exponent), np.array(found.standard_error)
    chaotic = exponents > 0  # from some states it ends on the orbit that does not stick
    assert np.all(found.result == RESULTS.successful) and chaotic.sum() > 20
    away = np.abs(exponents - CUBIC_LYAPUNOV)[chaotic]
    assert np.mean(away < 3 * errors[chaotic]) > 0.9
    assert abs(exponents[chaotic].mean() - CUBIC_LYAPUNOV) < 3 * errors[chaotic].mean() / np.sqrt(
        chaotic.sum()
    )


@pytest.mark.parametrize(
    "change, message",
    [
        ({"couplings": 0.3}, r"`couplings` must be of shape \(c,\)"),
        ({"couplings": [0.4, 0.3]}, "`couplings` must be ascending"),
        ({"tolerance": 0.0}, "`tolerance` must be a positive number"),
        ({"tolerance": 0.02}, "`tolerance` must be below 0.01, the distance at which"),
        ({"periods": 0}, "`periods` must be an integer of at least 1"),
        ({"system": jf.systems.CoulombOscillator()}, "`interval` must be a positive number"),
        ({"x0": np.zeros((2, 2))}, r"`x0` must be of shape \(n,\)"),
    ],
)
def test_bad_calls(change, message):
    call = {"system": BELT, "x0": np.zeros(2), "couplings": [0.3, 0.4], **change}
    first = [call.pop(name) for name in ("system", "x0", "couplings")]
    with pytest.raises(ValueError, match=message):
        jf.synchronization_exponent(*first, **call)
    with pytest.raises(ValueError, match="`system` must be an instance"):
        jf.drive_response(BELT.omega, 0.3)


def test_a_pair_has_the_clocks_of_its_system():
    """Steps end on ticks, which are no grid points: the rate then has the order of the stepper."""
    saw = Sawtooth(jnp.array(0.3))
    options = {"periods": 10, "transient": 1, "steps": 7, "stepper": jf.RK4(), "compact": True}
    found = jf.transverse_exponent(saw, jnp.ones(1), coupling=0.2, **options)
    assert_allclose(found.exponent, 0.15 - 0.25, rtol=0, atol=1e-7)
    assert jf.drive_response(saw, 0.2).clocks == saw.clocks


def test_a_spectrum_stays_between_the_ticks_of_its_system():
    """The rounding of a tick decides nothing, in the orbit as in the exponent."""

    def run(tooth):
        options = {
            "interval": 3 * tooth,
            "periods": 40,
            "transient": 4,
            "steps": 7,
            "compact": True,
        }
        found = jf.lyapunov_spectrum(Sawtooth(tooth), jnp.ones(1), **options)
        return found.exponents[0], found.x_final[0]

    (exponent, end), (slope, _) = jax.jvp(run, (jnp.array(0.3),), (jnp.array(1.0),))
    assert_allclose(exponent, 0.15 - 0.25, rtol=0, atol=1e-10)
    assert_allclose(end, np.exp(-0.1 * 44 * 0.9), rtol=1e-10)
    assert_allclose(slope, 0.5, rtol=0, atol=1e-8)


class Lag(jf.System):
    """x' = cos(t − π/4) − x, which settles on sin(t)/√2, zero at the end of each period."""

    rate: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return (jnp.cos(t - jnp.pi / 4) - self.rate * x[0])[None]


def test_a_drive_that_is_zero_where_it_is_sampled_has_a_transverse_exponent():
    options = {"periods": 40, "steps": 40, "transient": 40}
    found = jf.transverse_exponent(Lag(jnp.array(1.0)), jnp.array([0.3]), **options)
    # The distance, 4e-7 at first, shrinks by e^(-2π) in a period, and is known to eps.
    assert_allclose(found.exponent, -1.0, rtol=0, atol=1e-7)


class Skewed(jf.System):
    """Rates −1/10 and −1, along directions that are nearly the same, and a force."""

    angle: jax.Array

    def vector_field(self, t, x, side):
        drive = jnp.stack([jnp.cos(t), jnp.sin(2 * t)])
        slope = 0.9 / jnp.tan(self.angle)
        return jnp.stack([-0.1 * x[0] + slope * x[1], -x[1]]) + drive

    @property
    def period(self):
        return 2 * np.pi


@pytest.mark.parametrize("angle", [0.05, 1.0, 2.5])
def test_turning_into_the_growing_direction_is_no_growth(angle):
    """Of a linear system the rate is that of each period, once the pair has turned: in 10 periods
    of the transient's last quarter to e^(−0.9·20π) = 3e-25."""
    run = {"periods": 20, "transient": 40, "steps": 24, "coupling": 0.05}
    found = jf.transverse_exponent(Skewed(jnp.asarray(angle)), jnp.ones(2), **run)
    assert_allclose(found.exponent, -0.1, rtol=0, atol=1e-8)
    assert_allclose(found.running, -0.1, rtol=0, atol=1e-7)


class Struck(jf.System):
    """A ball on a table at B sin(t + φ), with gravity one and a restitution of 1/2."""

    phase: jax.Array
    slides = False
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])

    def switching(self, t, x):
        return x[0] - 1.2 * jnp.sin(t + self.phase)

    def reset(self, t, x, surface):
        rise = 1.2 * jnp.cos(t + self.phase)
        return jnp.stack([x[0], rise - 0.5 * (x[1] - rise)])


@pytest.mark.slow
def test_impacts_at_the_ends_of_intervals_are_no_growth():
    # At B cos φ = π/3 it is struck once a period with the velocity π, here at the times 2πk. Its
    # multipliers are complex, so their modulus is the restitution.
    phase = np.arccos(np.pi / 3 / 1.2)
    x0 = jnp.array([1.2 * np.sin(phase), np.pi])
    run = {"periods": 100, "transient": 20, "steps": 20, "compact": True}
    found = jf.transverse_exponent(Struck(jnp.asarray(phase)), x0, **run)
    assert found.result == RESULTS.successful
    assert_allclose(found.exponent, np.log(0.5) / (2 * np.pi), rtol=0, atol=0.02)


@pytest.mark.release
def test_a_response_that_lies_on_a_wall_is_put_back_onto_it():
    # A chord between two points of the wall, longer than between them, ends behind it.
    x0 = jnp.array([0.0, 0.0, 0.0])
    run = {"periods": 10, "transient": 12, "steps": 20, "compact": True, "stepper": jf.RK4()}
    found = jf.transverse_exponent(Guided(jnp.asarray(0.4)), x0, **run)
    assert found.result == RESULTS.successful
    assert_allclose(found.exponent, -0.3, rtol=0, atol=1e-5)
