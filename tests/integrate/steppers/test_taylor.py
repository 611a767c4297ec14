"""Steps by power series: exact ends, derivatives, batches, and the modes that have no series."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS
from tests.problems import PROBLEMS

# Crossings, sticks, one of two surfaces, an intersection slid on, impacts, rest, a touch.
NAMES = (
    "coulomb by everything",
    "rotating by everything",
    "belt 1.3",
    "sd",
    "box by everything",
    "relays by everything",
    "leave by everything",
    "ball that comes to rest",
    "ball by everything",
    "den hartog",
    "grazing touch",
    "filippov spiral",
)
QUICKER = (
    "rotating by everything",
    "leave by everything",
    "ball that comes to rest",
    "grazing touch",
)
EPS = float(np.finfo(float).eps)
BELT = jf.systems.BeltFriction()
X0 = jnp.array([0.1, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [v if v in QUICKER else pytest.param(v, marks=pytest.mark.release) for v in NAMES],
)
def test_ends_of_the_bank_are_exact(name):
    p = PROBLEMS[name]
    x0 = jnp.asarray(p.x0, float)
    sol = jf.solve(p.system, x0, p.t0, p.t1, p.dt, stepper=jf.Taylor(16), max_events=64)
    exact = p.flow(p.system, x0, p.t0, p.t1) if p.end is None else p.end
    steps = int(sol.stats["num_steps"])
    # Rounding of each step, magnified by what contacts magnify: at most tenfold in the bank.
    bound = 10 * EPS * (steps + 64) * max(1.0, float(np.max(np.abs(exact))))
    assert_allclose(sol.x_final, exact, rtol=0, atol=bound)


def belt_end(x0, stepper, dt):
    return jf.solve(BELT, x0, 0.0, 3.0, dt, stepper=stepper, max_events=None).x_final


@pytest.mark.release
def test_derivatives_of_both_orders_through_sticks():
    @jax.jit
    def slopes(x, first, second):
        """Along the first direction, and of that along the second."""

        def slope(x):
            return jax.jvp(lambda x: belt_end(x, jf.Taylor(12), 0.01), (x,), (first,))[1]

        return jax.jvp(slope, (x,), (second,))

    def both(x, second):
        columns = [slopes(x, first, second) for first in jnp.eye(2)]
        return (np.stack(column, axis=1) for column in zip(*columns, strict=True))

    along, step = jnp.array([1.0, 0.0]), 1e-5
    found, curvature = both(X0, along)
    # The same motion by another method, at steps at which its own error is below 1e-11.
    other = jax.jit(jax.jacfwd(lambda x: belt_end(x, diffrax.Dopri8(), 0.005)))
    assert_allclose(found, other(X0), rtol=1e-9, atol=1e-11)
    ahead, back = (next(both(X0 + d * along, along)) for d in (step, -step))
    assert_allclose(curvature, (ahead - back) / (2 * step), rtol=1e-5, atol=1e-6)


@pytest.mark.release
def test_all_ways_to_save_agree():
    ts = jnp.linspace(0.0, 3.0, 17)

    def run(saveat):
        return jf.solve(BELT, X0, 0.0, 3.0, 0.02, stepper=jf.Taylor(14), saveat=saveat)

    at_times = run(diffrax.SaveAt(ts=ts)).xs
    dense = run(diffrax.SaveAt(dense=True)).evaluate(ts)
    assert_allclose(at_times, dense, rtol=0, atol=1e-9)


@pytest.mark.release
def test_a_lane_does_not_depend_on_its_batch():
    sd = jf.systems.SDOscillator()
    omegas = np.linspace(0.6, 1.3, 70)

    def samples(omegas, stepper, steps, compact=False):
        return jf.bifurcation_diagram(
            sd, "omega", omegas, jnp.array([0.3, 0.1]), transient=6, samples=3, steps=steps,
            stepper=stepper, progress=False, compact=compact,
        )  # fmt: skip

    whole = samples(omegas, jf.Taylor(12), 16)
    assert whole.successful.all()
    assert_array_equal(whole.xs[3:7], samples(omegas[3:7], jf.Taylor(12), 16).xs)
    exact = samples(omegas, diffrax.Dopri8(), 64, compact=True)
    # Nine periods: errors of 1e-11 a step grow by what a crossing near a corner magnifies.
    assert np.median(np.abs(whole.xs - exact.xs)) < 1e-10


@pytest.mark.release
def test_sticking_lanes_of_a_batch():
    omegas = np.linspace(4.2, 4.7, 40)

    def samples(stepper, steps, compact):
        return jf.bifurcation_diagram(
            BELT, "omega", omegas, jnp.zeros(2), transient=4, samples=2, steps=steps,
            stepper=stepper, progress=False, compact=compact,
        )  # fmt: skip

    found, exact = samples(jf.Taylor(16), 60, False), samples(diffrax.Dopri8(), 160, True)
    assert found.successful.all()
    assert np.median(np.abs(found.xs - exact.xs)) < 1e-10


@pytest.mark.slow
def test_single_precision():
    x0 = jnp.array([0.3, 0.1], jnp.float32)
    sd = jf.systems.SDOscillator()
    sol = jf.solve(sd, x0, 0.0, 10.0, 0.25, stepper=jf.Taylor(8))
    exact = jf.solve(sd, x0.astype(float), 0.0, 10.0, 0.05).x_final
    assert sol.x_final.dtype == jnp.float32
    assert_allclose(sol.x_final, exact, rtol=0, atol=1e-5)


class Saturated(jf.System):
    """A spring that stiffens at x = 0, where no surface says so."""

    def vector_field(self, t, x, side):
        spring = x[0] + 50 * jnp.maximum(x[0], 0.0)
        return jnp.stack([x[1], 0.3 * jnp.cos(t) - spring])


def test_a_kink_that_no_surface_tells_of_is_halved():
    x0 = jnp.array([1.0, 0.0])
    sol = jf.solve(Saturated(), x0, 0.0, 20.0, 0.2, stepper=jf.Taylor(12))
    exact = jf.solve(Saturated(), x0, 0.0, 20.0, jf.Adaptive(1e-11, 1e-12)).x_final
    assert sol.stats["num_halvings"] > 0
    assert_allclose(sol.x_final, exact, rtol=0, atol=0.05)
    fine = jf.Adaptive(1e-10, 1e-11)
    sol = jf.solve(Saturated(), x0, 0.0, 20.0, fine, stepper=jf.Taylor(12))
    assert_allclose(sol.x_final, exact, rtol=0, atol=1e-6)


class Stop(jf.System):
    """A mass on a spring of stiffness 1, and a stop of stiffness 400 from x = `at` on, of which no
    surface tells."""

    at: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - 400 * jnp.maximum(x[0] - self.at, 0.0)])


def held_by_a_stop(at, t):
    """The motion from (0, 1): sines off the stop and on it, in turns."""
    if at >= 1:
        return np.array([np.sin(t), np.cos(t)])
    v, w, low = np.sqrt(1 - at**2), np.sqrt(401.0), at / 401
    first = np.arcsin(at)
    stay, free = 2 * np.arctan2(v / w, low) / w, np.pi + 2 * first
    since = t - first if t < first else (t - first) % (stay + free)
    if since < 0 or since >= stay:
        angle = t if t < first else np.pi - first + since - stay
        return np.array([np.sin(angle), np.cos(angle)])
    size, phase = np.hypot(low, v / w), w * (since - stay / 2)
    return np.array([at - low + size * np.cos(phase), -w * size * np.sin(phase)])


@pytest.mark.slow
def test_with_a_tolerance_a_step_ends_at_a_kink_that_it_would_pass_twice():
    # A stop that the error at the end of a step does not show, one that is only touched, to
    # rounding too, one that is not reached, and one that the motion starts on.
    stops = jnp.array([0.98, 0.999999, 1 - 1e-14, 1.0, 1.0000001, 0.5, 0.0])

    def end(at):
        x0, tolerance = jnp.array([0.0, 1.0]), jf.Adaptive(1e-10, 1e-12)
        sol = jf.solve(Stop(at), x0, 0.0, 32.0, tolerance, stepper=jf.Taylor())
        return sol.x_final, sol.stats["num_steps"]

    found, steps = jax.jit(jax.vmap(end))(stops)
    exact = [held_by_a_stop(float(at), 32.0) for at in stops]
    # Each of 10 turns passes through the stop with a speed that its error divides by.
    assert_allclose(found, exact, rtol=0, atol=2e-8)
    assert np.all(steps < 250)
    slope = jax.jacfwd(lambda at: end(at)[0])(jnp.array(0.98))
    across = held_by_a_stop(0.98 + 1e-6, 32.0) - held_by_a_stop(0.98 - 1e-6, 32.0)
    assert_allclose(slope, across / 2e-6, rtol=1e-6)


class Strips(jf.System):
    """A force of 0.2 up to x = 1, 0 up to x = 2 and −0.2 after it, and numbers that decay."""

    slides = False

    def vector_field(self, t, x, side):
        return jnp.concatenate([jnp.stack([x[1], -0.1 * (side[0] + side[1])]), -x[2:]])

    def switching(self, t, x):
        return jnp.stack([x[0] - 1.0, x[0] - 2.0])


@pytest.mark.parametrize("others", [0, pytest.param(11, marks=pytest.mark.release)])
@pytest.mark.slow
def test_a_number_may_be_switched_by_several_surfaces_that_are_only_crossed(others):
    x0 = jnp.concatenate([jnp.array([0.0, 1.0]), jnp.ones(others)])
    sol = jf.solve(Strips(), x0, 0.0, 3.0, 0.05, stepper=jf.Taylor())
    # v² = 1.4 between the surfaces, which takes 1/v, and the speed before them is 1 + 0.2 t.
    v = np.sqrt(1.4)
    rest = 3.0 - (v - 1) / 0.2 - 1 / v
    exact = [2 + v * rest - 0.1 * rest**2, v - 0.2 * rest, *[np.exp(-3.0)] * others]
    assert_allclose(sol.x_final, exact, rtol=0, atol=1e-13)


class Springs(jf.System):
    """A spring of stiffness 50 on one side of q = 0, written in several ways, and a quadratic
    drag."""

    which: jax.Array

    def vector_field(self, t, x, side):
        q, v = x
        ways = [
            jnp.maximum(q, 0.0),
            (q > 0).astype(float) * q,
            jnp.where((q > 0) & (q < 5), q, 0.0),
            jnp.where(q > 0, 1.0, 0.0) * q,
            jax.lax.cond(q > 0, lambda q: q, lambda q: 0 * q, q),
            0.5 * (1 + jnp.sign(q)) * q,
            jnp.round(q + 0.5) * q,
            jnp.where(q == 0, 0.0, jnp.maximum(q, 0.0)),
        ]
        drag = 9.81 - 0.5 * jnp.sign(v) * v**2
        return jnp.stack([v, self.which @ jnp.stack([*(-50.0 * way for way in ways), drag])])


def test_a_start_on_a_kink_takes_the_part_ahead_however_it_is_written():
    which, t1 = np.repeat(np.eye(9), 2, axis=0), 0.06
    speeds = np.array([1.0, -1.0] * 8 + [0.0, 0.0])

    @jax.jit
    @jax.vmap
    def end(which, v):
        x0 = jnp.stack([0.0, v])
        return jf.solve(Springs(which), x0, 0.0, t1, 0.02, stepper=jf.Taylor()).x_final

    w, fall = 50.0**0.5, (0.5 / 9.81) ** 0.5
    held, free = [np.sin(w * t1) / w, np.cos(w * t1)], [-t1, -1.0]
    dropped = [np.log(np.cosh(9.81 * fall * t1)) / 0.5, np.tanh(9.81 * fall * t1) / fall]
    exact = np.stack([held, free] * 8 + [dropped] * 2)
    assert_allclose(end(which, speeds), exact, rtol=0, atol=1e-13)


class Bent(jf.System):
    """Numbers whose fields have a kink at zero inside of a function with its own derivative, and at
    one inside of an exponent, and a surface whose rate is the same on both sides."""

    def vector_field(self, t, x, side):
        relu = -jax.nn.relu(x[0]) - 1.0
        drag = -(jnp.abs(x[1]) ** jnp.where(jnp.abs(x[1]) > 1.0, 2.0, 1.0))
        outside = -2.0 * (1 + side) * (x[2] - jnp.sign(x[2]))
        return jnp.stack([relu, drag, x[3], outside])

    def switching(self, t, x):
        return jnp.abs(x[2]) - 1.0


@pytest.mark.slow
def test_kinks_inside_of_functions_exponents_and_surfaces():
    x0 = jnp.array([1.0, 3.0, 0.5, 1.0])
    sol = jf.solve(Bent(), x0, 0.0, 0.6, 0.05, stepper=jf.Taylor())
    # e^(−t) 2 − 1; 3/(1 + 3 t) until it is 1 at 2/3; half a unit to the surface, then a sine.
    exact = [2 * np.exp(-0.6) - 1, 3 / 2.8, 1 + np.sin(0.2) / 2, np.cos(0.2)]
    assert_allclose(sol.x_final, exact, rtol=0, atol=1e-9)


class Steady(jf.System):
    """A tank that is filled at a constant rate and runs out by a root, and a decay by a power."""

    power: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([2.0 - jnp.sqrt(x[0]), -(x[1] ** self.power)])


@pytest.mark.release
def test_the_flow_of_a_steady_state_has_its_derivative():
    def end(x0):
        return jf.solve(Steady(jnp.array(1.0)), x0, 0.0, 5.0, 0.25, stepper=jf.Taylor()).x_final

    slopes = jax.jit(jax.jacfwd(end))(jnp.array([4.0, 0.0]))
    assert_allclose(slopes, np.diag(np.exp([-1.25, -5.0])), rtol=0, atol=1e-11)


class Looped(jf.System):
    """A field with a loop."""

    def vector_field(self, t, x, side):
        return jax.lax.fori_loop(0, 2, lambda _, v: v * jnp.cos(v), x)


def test_what_has_no_series_is_refused_by_name():
    with pytest.raises(ValueError, match=r"`stepper` must not be jaxfil.Taylor.*`scan`"):
        jf.solve(Looped(), jnp.ones(1), 0.0, 1.0, 0.1, stepper=jf.Taylor())


@pytest.mark.parametrize("order", [3, 41, True])
def test_orders_are_checked(order):
    with pytest.raises(ValueError, match="`order` must be a whole number from 4 to 40, got"):
        jf.Taylor(order)


@pytest.mark.release
def test_a_file_keeps_the_order(tmp_path):
    sd = jf.systems.SDOscillator()
    orbit = jf.periodic_orbit(sd, jnp.array([1.0, 0.0]), steps=30, stepper=jf.Taylor(14))
    assert orbit.result == RESULTS.successful
    orbit.save(tmp_path / "orbit.npz")
    back = jf.load(tmp_path / "orbit.npz", system=sd)
    assert back.options.stepper == jf.Taylor(14)
    tight = jf.periodic_orbit(sd, jnp.array([1.0, 0.0]), steps=100)
    assert_allclose(orbit.x0, tight.x0, rtol=0, atol=1e-12)
