"""Scales, batches, time that stands still or runs backward: one test a case."""

import gc
import math
import os
import sys
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind

TRACED = []
TOO_LATE = jnp.asarray([1.0, 2.5])


class Relay(jf.System):
    """y' = -side, unforced; counts how often it is traced."""

    pull: jax.Array

    def vector_field(self, t, x, side):
        TRACED.append("field")
        return jnp.stack([x[1], -self.pull * side])

    def switching(self, t, x):
        TRACED.append("H")
        return x[0]


class Linear(jf.System):
    """A forced linear oscillator: smooth, no surface at all."""

    c: jax.Array
    omega: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.cos(self.omega * t) - x[0] - self.c * x[1]])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Clock(jf.System):
    """x' = 2 t above the surface x = level, 2 t / 3 below: sees the true time."""

    level: jax.Array

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, 2 * t, 2 * t / 3)[None]

    def switching(self, t, x):
        return x[0] - self.level


class Scaled(jf.System):
    """Another system in other units of time, of each component and of H."""

    inner: jf.System
    time: jax.Array
    state: jax.Array
    surface: jax.Array

    def vector_field(self, t, x, side):
        field = self.inner.vector_field(t / self.time, x / self.state, side)
        return field * self.state / self.time

    def switching(self, t, x):
        return self.surface * self.inner.switching(t / self.time, x / self.state)


SCALES = np.asarray(
    [
        (1, 1, 1, 1),
        *((time, state, state, 1) for time in (1e-12, 1e12) for state in (1e-12, 1, 1e12)),
        (1, 1e12, 1e12, 1e-12),
        (1, 1e-12, 1e-12, 1e12),
        (1e-12, 1e12, 1e-12, 1e12),
    ]
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("inner", "x0", "t1", "events"),
    [
        (jf.systems.MovingBelt(), (3, 0), 28.0, 7),
        pytest.param(
            *(jf.systems.CoulombOscillator(), (3, 0.1), 20.0, 5), marks=pytest.mark.release
        ),
        pytest.param(*(jf.systems.VisibleFold(), (-1, 0.1), 2.0, 2), marks=pytest.mark.release),
    ],
)
def test_scales(inner, x0, t1, events):
    def lane(scale):
        state = scale[1:3]
        system = Scaled(inner, scale[0], state, scale[3])
        dt = 0.037 * scale[0]
        start = jnp.asarray(x0, float) * state
        sol = jf.solve(system, start, 0.0, t1 * scale[0], dt, max_events=8, throw=False)
        return sol.result, sol.num_events, sol.events.kinds, sol.events.ts, sol.x_final

    results, counts, kinds, ts, xs = jax.jit(jax.vmap(lane))(jnp.asarray(SCALES))
    assert (results == RESULTS.successful).all()
    assert_array_equal(counts, events)
    assert_array_equal(kinds, np.broadcast_to(kinds[0], kinds.shape))
    ts = ts[:, :events]
    assert_allclose(ts / SCALES[:, :1], np.broadcast_to(ts[0], ts.shape), rtol=1e-9)
    assert_allclose(xs / SCALES[:, 1:3], np.broadcast_to(xs[0], xs.shape), rtol=0, atol=3e-9)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_scales_of_the_ball_that_comes_to_rest(scale):
    # Height and gravity scaled alike: the same times, t1 = 10/7 and t∞ = 3 t1.
    ball = jf.systems.BouncingBall(g=9.8 * scale, restitution=0.5)
    x0 = jnp.asarray([10 * scale, 0.0])
    sol = jf.solve(ball, x0, 0.0, 20.0, 0.1, max_events=64, throw=False)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.events.ts[sol.num_events - 1], 30 / 7, rtol=1e-12)
    assert_allclose(sol.x_final, 0, rtol=0, atol=1e-14 * scale)


def test_zero_length_span():
    x0 = jnp.asarray([0.3, -0.7])
    sol = jf.solve(Relay(jnp.asarray(1.0)), x0, 2.0, 2.0, 0.1)
    assert sol.result == RESULTS.successful
    assert_array_equal(sol.xs[-1], x0)
    assert sol.num_events == 0


@pytest.mark.slow
def test_zero_length_span_in_a_batch_has_the_identity_as_derivative():
    def end(x0, t1):
        return jf.solve(Relay(jnp.asarray(1.0)), x0, 2.0, t1, 0.1).xs[-1]

    x0 = jnp.asarray([1.0, -1.0])
    t1s = jnp.asarray([2.0, 2.5, 2.0])
    xs = jax.vmap(end, (None, 0))(x0, t1s)
    jacobians = jax.vmap(jax.jacfwd(end), (None, 0))(x0, t1s)
    assert_allclose(xs, [[1, -1], [0.375, -1.5], [1, -1]], rtol=1e-14)
    assert_allclose(jacobians, [np.eye(2), [[1, 0.5], [0, 1]], np.eye(2)], rtol=0, atol=1e-14)


def test_backward_in_time_the_field_sees_true_time():
    # Forward x = t²/3 from 0 to the level 1 at √3, then t² - 2; the same way back.
    saveat = diffrax.SaveAt(ts=jnp.asarray([2.0, 1.8, 1.0]))
    sol = jf.solve(Clock(jnp.asarray(1.0)), jnp.asarray([2.0]), 2.0, 0.5, 0.1, saveat=saveat)
    assert_array_equal(sol.ts, [2.0, 1.8, 1.0])
    assert_allclose(sol.xs[:, 0], [2, 1.24, 1 / 3], rtol=1e-13)
    assert sol.num_events == 1
    assert_allclose(sol.events.ts[0], np.sqrt(3), rtol=1e-13)
    assert_array_equal(sol.modes[:, 0], [1, 1, -1])


@pytest.mark.parametrize(
    ("system", "x0", "t1", "events"),
    [
        (jf.systems.SDOscillator(omega=0.7), (0.3, 0.1), 40.0, 9),
        (jf.systems.MovingBelt(), (3, 0), 9.0, 1),
        (jf.systems.RotatingOscillator(), (0.3678794411714423, 0), 2.0, 1),
    ],
)
def test_backward_in_time_is_a_round_trip(system, x0, t1, events):
    x0 = jnp.asarray(x0, float)
    there = jf.solve(system, x0, 0.0, t1, 0.01)
    back = jf.solve(system, there.xs[-1], t1, 0.0, 0.01)
    assert there.num_events == events
    assert back.num_events == events
    assert_allclose(back.events.ts[:events], there.events.ts[:events][::-1], rtol=0, atol=1e-9)
    assert_allclose(back.xs[-1], x0, rtol=0, atol=1e-9)


def test_backward_in_time_a_slide_is_not_unique():
    # At t = 9.6 the moving belt's mass sticks.
    system = jf.systems.MovingBelt()
    stuck = jf.solve(system, jnp.asarray([3.0, 0.0]), 0.0, 9.6, 0.01)
    assert stuck.modes[-1, 0] == 0
    sol = jf.solve(system, stuck.xs[-1], 9.6, 9.0, 0.01, throw=False)
    assert sol.result == RESULTS.nonunique
    assert_array_equal(sol.t_final, 9.6)


def test_new_numbers_trace_nothing():
    def call(pull, x0, t0, t1, dt, ts):
        system = Relay(jnp.asarray(pull))
        saveat = diffrax.SaveAt(ts=jnp.asarray(ts))
        return jf.solve(system, jnp.asarray(x0), t0, t1, dt, saveat=saveat)

    call(1.0, [1.0, 0.0], 0.0, 5.0, 0.1, [1.0, 5.0])
    TRACED.clear()
    sol = call(2.0, [0.5, 0.25], -1.0, 3.0, 0.07, [0.0, 2.0])
    assert np.isfinite(sol.xs).all()
    assert TRACED == []


@pytest.mark.release
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory():
    def call(k):
        x0 = jnp.asarray([1.0 + 0.001 * k, 0.0])
        return jf.solve(Relay(jnp.asarray(1.0)), x0, 0.0, 5.0, 0.1).xs.block_until_ready()

    def resident():
        gc.collect()
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    for k in range(100):
        call(k)
    before = resident()
    for k in range(300):
        call(k)
    assert resident() - before < 5 * 2**20


@pytest.mark.slow
def test_batches():
    # Good, at rest, NaN, out of contacts: every lane is what it is alone, and stops no other.
    def lane(restitution, height):
        ball = jf.systems.BouncingBall(g=9.8, restitution=restitution)
        x0 = jnp.stack([height, jnp.zeros_like(height)])
        saveat = diffrax.SaveAt(ts=jnp.asarray([1.0, 10.0]))
        return jf.solve(ball, x0, 0.0, 12.0, 0.1, saveat=saveat, max_events=60, throw=False)

    es = jnp.asarray([0.9, 0.5, 0.8, 0.92, 0.75])
    heights = jnp.asarray([10.0, 10.0, jnp.nan, 0.005, 7.0])
    batch = eqx.filter_jit(jax.vmap(lane))(es, heights)
    alone = [eqx.filter_jit(lane)(e, h) for e, h in zip(es, heights, strict=True)]
    full = RESULTS.max_events_reached
    want = [RESULTS.successful, RESULTS.successful, RESULTS.nonfinite, full, full]
    assert all(sol.result == result for sol, result in zip(alone, want, strict=True))
    for k, sol in enumerate(alone):
        mine = jax.tree.map(lambda leaf, k=k: leaf[k], batch)
        assert mine.result == sol.result
        assert mine.num_events == sol.num_events
        assert_array_equal(mine.events.kinds, sol.events.kinds)
        assert_allclose(mine.events.ts, sol.events.ts, rtol=1e-13)
        assert_allclose(mine.xs, sol.xs, rtol=1e-10, atol=1e-12)


def test_trivial_case_of_a_scene_with_no_contact():
    # x'' + c x' + x = 0 without force: the flow over one period is the matrix exponential.
    c, period = 0.2, 2 * np.pi / 0.8
    system = Linear(jnp.asarray(c), jnp.asarray(0.8))

    def end(x0):
        sol = jf.solve(system, x0, 0.0, period, period / 100)
        assert sol.modes.shape == (1, 0)
        return sol.xs[-1]

    d = np.sqrt(1 - c**2 / 4)
    cos, sin = np.cos(d * period), np.sin(d * period) / d
    want = [[cos + c / 2 * sin, sin], [-sin, cos - c / 2 * sin]]
    jacobian = jax.jacfwd(end)(jnp.asarray([0.3, 0.1]))
    assert_allclose(jacobian, np.exp(-c / 2 * period) * np.asarray(want), rtol=0, atol=1e-12)


def test_trivial_case_of_a_surface_never_met():
    sol = jf.solve(Relay(jnp.asarray(1.0)), jnp.asarray([9.0, 0.0]), 0.0, 4.0, 0.1)
    assert sol.num_events == 0
    assert_array_equal(sol.events.ts, np.inf)
    assert_array_equal(sol.events.kinds, EventKind.none)
    assert_allclose(sol.xs[-1], [1, -4], rtol=1e-13)


def test_trivial_case_of_a_diagram():
    # The amplitude response of a linear oscillator, sampled at phase 0.
    omegas = np.linspace(0.5, 1.5, 5)
    system = Linear(jnp.asarray(0.5), jnp.asarray(1.0))
    x0 = jnp.zeros(2)
    diagram = jf.bifurcation_diagram(
        system, "omega", omegas, x0, transient=30, samples=4, steps=60, progress=False
    )
    response = 1 / (1 - omegas**2 + 0.5j * omegas)
    want = np.stack([response.real, (1j * omegas * response).real], axis=1)
    assert diagram.xs.shape == (5, 4, 2)
    assert_allclose(diagram.xs, np.repeat(want[:, None], 4, axis=1), rtol=0, atol=1e-9)
    assert (diagram.results == RESULTS.successful).all()


class Decay(jf.System):
    """x' = -x: no surface."""

    def vector_field(self, t, x, side):
        return -x


def test_a_smooth_scene_is_saved_between_its_steps():
    # Nine times to a step.
    ts = jnp.linspace(0.0, 1.0, 46)
    sol = jf.solve(Decay(), jnp.ones(1), 0.0, 1.0, 0.2, saveat=diffrax.SaveAt(ts=ts))
    assert sol.stats["num_steps"] == 5
    assert_allclose(sol.xs[:, 0], np.exp(-ts), rtol=1e-9)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_times_that_coincide_are_each_saved(dtype):
    # At a grid point, between two, at both ends, and two times within rounding of the end.
    eps = jnp.finfo(dtype).eps
    part = jnp.asarray([0, 0, 0.2, 0.2, 0.7, 0.7, 1 - 2 * eps, 1, 1], dtype)

    def states(ts, t1):
        saveat = diffrax.SaveAt(ts=ts)
        one = jnp.ones(1, dtype)
        sol = jf.solve(Decay(), one, 0.0, t1, dtype(0.2), saveat=saveat, throw=False)
        return sol.xs[:, 0], (sol.xs[:, 0], sol.result, sol.stats["num_steps"])

    t1s = jnp.asarray([1, -1, 0], dtype)
    ts = t1s[:, None] * part
    rows = jax.vmap(jax.jacfwd(states, has_aux=True))
    by_time, (xs, result, num_steps) = jax.jit(rows)(ts, t1s)
    assert (result == RESULTS.successful).all() and num_steps.tolist()[:2] == [5, 5]
    assert_allclose(xs, np.exp(-ts), rtol=256 * eps)
    assert_allclose(by_time, [-np.diag(np.exp(-t)) for t in ts], rtol=4096 * eps)


def test_saving_times_have_iterations_of_their_own():
    ts = jnp.linspace(0.001, 0.999, 400)

    def total(x0):
        how = dict(adjoint=diffrax.RecursiveCheckpointAdjoint(), max_events=8, throw=False)
        at = diffrax.SaveAt(ts=ts)
        return jf.solve(Decay(), x0, 0.0, 1.0, 0.1, saveat=at, stepper=jf.RK4(), **how).xs.sum()

    got, by = jax.value_and_grad(total)(jnp.ones(1))
    assert_allclose([got, by[0]], np.exp(-ts).sum(), rtol=1e-6)


@pytest.mark.parametrize("span", [(-0.3, 2.0), (0.3, -2.0)])
def test_dense_output_reaches_the_end_of_its_span(span):
    # t0 + (t1 - t0) is not t1 in floating point.
    sol = jf.solve(Decay(), jnp.ones(1), *span, 0.2, saveat=diffrax.SaveAt(dense=True))
    assert float(sol.t_final) != span[1]
    ts = np.asarray([*span, 1.001 * span[1], np.inf, np.nan])
    assert_allclose(sol.evaluate(ts)[:2, 0], np.exp(span[0] - ts[:2]), rtol=1e-9)
    assert_array_equal(sol.evaluate(ts)[2:], np.nan)


@pytest.fixture(scope="module")
def coulomb():
    """x'' = -x - 0.4 sgn x' from (3, 0): 2.6 cos t + 0.4 until it turns at π."""
    x0, saveat = jnp.asarray([3.0, 0.0]), diffrax.SaveAt(dense=True)
    return jf.solve(jf.systems.CoulombOscillator(), x0, 0.0, 3.0, 0.1, saveat=saveat)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(), (2,), (3,), (2, 3), (0,)])
def test_a_dense_solution_is_evaluated_at_times_of_any_shape(coulomb, shape):
    # Two times are as many as the state has components: nothing may take them for those.
    ts = np.linspace(0.05, 2.95, math.prod(shape)).reshape(shape)
    want = np.stack([2.6 * np.cos(ts) + 0.4, -2.6 * np.sin(ts)], axis=-1)
    assert_allclose(coulomb.evaluate(ts), want, rtol=0, atol=1e-13)
    assert_allclose(jax.jit(coulomb.evaluate)(ts), want, rtol=0, atol=1e-13)


@pytest.mark.release
def test_times_under_jit_are_known_where_they_are_numbers():
    """x'' = -1 from (9, 0): 9 - t²/2."""
    relay, x0 = Relay(jnp.asarray(1.0)), jnp.asarray([9.0, 0.0])
    reverse, every = diffrax.RecursiveCheckpointAdjoint(), diffrax.SaveAt(steps=True)

    def height(x0, **options):
        how = options | {"stepper": jf.RK4(), "max_events": None}
        return jf.solve(relay, x0, 0.0, 2.0, 0.25, **how).x_final[0]

    assert_allclose(jax.jit(lambda x: height(x, saveat=every))(x0), 7.0, rtol=1e-14)
    assert_allclose(jax.jit(jax.grad(lambda x: height(x, adjoint=reverse)))(x0), [1, 2])
    assert_allclose(jax.grad(jax.jit(lambda x: height(x, adjoint=reverse)))(x0), [1, 2])
    with pytest.raises(ValueError, match=r"`saveat.ts` must be times in order within the span"):
        jax.jit(lambda x: height(x, saveat=diffrax.SaveAt(ts=TOO_LATE)))(x0)


def test_an_empty_batch_is_solved():
    def end(x0, **options):
        return jf.solve(Relay(jnp.asarray(1.0)), x0, 0.0, 1.0, 0.5, stepper=jf.RK4(), **options).xs

    none = jnp.zeros((0, 2))
    saveat = diffrax.SaveAt(ts=jnp.asarray([0.25, 1.0]))
    assert jax.vmap(end)(none).shape == (0, 1, 2)
    assert jax.jit(jax.vmap(lambda x: end(x, saveat=saveat)))(none).shape == (0, 2, 2)
    assert jax.vmap(jax.jacfwd(end))(none).shape == (0, 1, 2, 2)


class Tabled(jf.System):
    """x' = −x, and a table that may be empty."""

    table: jax.Array

    def vector_field(self, t, x, side):
        return jnp.sum(self.table) - x

    def switching(self, t, x):
        return x[0]


def test_a_parameter_may_be_an_empty_array():
    def end(x0):
        system = Tabled(jnp.zeros(0))
        return jf.solve(system, x0, 0.0, 1.0, 0.25, stepper=jf.RK4(), compact=False).x_final

    assert_allclose(end(jnp.ones(1)), np.exp(-1), rtol=1e-3)


def test_more_steps_than_can_be_counted_are_a_budget_used_up():
    x0 = jnp.asarray([9.0, 0.0])
    run = jax.jit(lambda t1: jf.solve(Relay(jnp.asarray(1.0)), x0, 0.0, t1, 0.1, throw=False))
    sol = run(1e12)
    assert sol.result == RESULTS.max_steps_reached
    assert_array_equal(sol.t_final, 0.0)
    assert_array_equal(sol.x_final, x0)


class Called(jf.System):
    """x'' = -2 x, by what has no forward derivatives, or by what has."""

    how: str = eqx.field(static=True)

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -DOUBLES[self.how](x[0])])

    def switching(self, t, x):
        return x[0] - 0.5


def on_host(x):
    return jax.pure_callback(
        lambda v: 2 * np.asarray(v),
        jax.ShapeDtypeStruct((), x.dtype),
        x,
        vmap_method="expand_dims",
    )


@jax.custom_vjp
def reverse_only(x):
    return 2 * x


reverse_only.defvjp(lambda x: (2 * x, None), lambda _, v: (2 * v,))


@jax.custom_jvp
def with_rule(x):
    return on_host(x)


with_rule.defjvp(lambda x, v: (with_rule(*x), 2 * v[0]))
DOUBLES = {"pure_callback": on_host, "custom_vjp": reverse_only, "custom_jvp": with_rule}


@pytest.mark.parametrize("how", ["pure_callback", "custom_vjp"])
def test_a_field_without_forward_derivatives_is_refused_by_name(how):
    match = (
        rf"^`vector_field` must have forward derivatives.*`jax\.{how}`\. Wrap it in .*custom_jvp"
    )
    with pytest.raises(TypeError, match=match):
        jf.solve(Called(how), jnp.array([1.0, 0.0]), 0.0, 1.0, 0.05)


def kepler(mean):
    """The eccentric anomaly u of an orbit with an eccentricity of 0.5, u − sin(u)/2 = mean."""

    def better(u):
        return u - (u - 0.5 * jnp.sin(u) - mean) / (1 - 0.5 * jnp.cos(u))

    return better


def in_fixed_turns(mean):
    return jax.lax.fori_loop(0, 20, lambda _, u: kepler(mean)(u), mean)


def until_it_stays(mean):
    def is_far(u):
        return abs(kepler(mean)(u) - u) > 1e-14

    return jax.lax.while_loop(is_far, kepler(mean), mean)


class Satellite(jf.System):
    """A counter that runs while the distance 1 − cos(u)/2 exceeds 1.2."""

    anomaly: Callable = eqx.field(static=True)

    def vector_field(self, t, x, side):
        return jnp.stack([0.5 * (1.0 + side)])

    def switching(self, t, x):
        return 1 - 0.5 * jnp.cos(self.anomaly(t)) - 1.2


def test_a_loop_in_a_surface_has_a_fixed_number_of_turns():
    sol = jf.solve(Satellite(in_fixed_turns), jnp.zeros(1), 0.0, 2.0, 0.1)
    u = np.arccos(-0.4)
    assert_allclose(sol.x_final, 2.0 - (u - 0.5 * np.sin(u)), rtol=0, atol=1e-13)
    with pytest.raises(ValueError, match=r"^`switching` must have reverse.*while_loop.*fori_loop"):
        jf.solve(Satellite(until_it_stays), jnp.zeros(1), 0.0, 2.0, 0.1)


def test_a_field_computed_on_the_host_is_solved_with_a_rule_around_it():
    w = np.sqrt(2)
    sol = jf.solve(Called("custom_jvp"), jnp.array([1.0, 0.0]), 0.0, 1.0, 0.05)
    np.testing.assert_allclose(sol.x_final, [np.cos(w), -w * np.sin(w)], rtol=0, atol=1e-12)


@pytest.mark.release
def test_under_shard_map_the_check_that_cannot_be_is_named():
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("lanes",))
    lanes = jax.sharding.PartitionSpec("lanes")
    starts = jnp.array([[1.0, 0.0], [0.8, 0.0]])

    def ends(check):
        run = jax.vmap(lambda x: jf.solve(jf.systems.SDOscillator(), x, 0.0, 1.0, 0.05).x_final)
        shards = jax.shard_map(run, mesh=mesh, in_specs=lanes, out_specs=lanes, check_vma=check)
        return jax.jit(shards)(starts), jax.jit(run)(starts)

    np.testing.assert_array_equal(*ends(False))
    with pytest.raises(ValueError, match=r"^`check_vma` of `jax\.shard_map` must be False"):
        ends(True)
