"""How a lane ends when it cannot go on: one test a case, each with its time and state."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from tests.problems import PROBLEMS, closed_forms, tagged
from tests.problems.systems import affine
from tests.results import assert_solves, run, solved


class Wall(jf.System):
    """A mass falling on a floor that sends it back with a multiple of its velocity."""

    factor: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], self.factor * x[1]])


class Stiff(jf.System):
    """y' = -k (y - g(t)), g = 1 - t above and -1 below."""

    k: jax.Array

    def vector_field(self, t, x, side):
        return -self.k * (x - jnp.where(side > 0, 1 - t, -1.0))

    def switching(self, t, x):
        return x[0]


class Poison(jf.System):
    """A motion at constant rate towards a wall, with a NaN wherever a test wants one."""

    rate: jax.Array
    field_at: jax.Array
    surface_at: jax.Array
    after: jax.Array

    def vector_field(self, t, x, side):
        return jnp.where(t > self.field_at, jnp.nan, self.rate)[None]

    def switching(self, t, x):
        return jnp.where(t > self.surface_at, jnp.nan, 1 - x[0])

    def reset(self, t, x, surface):
        return self.after[None]


@pytest.mark.slow
@pytest.mark.parametrize("name", [k for k in tagged("hand") if PROBLEMS[k].outcome != "successful"])
def test_a_problem_ends_as_it_must(name):
    assert_solves(PROBLEMS[name], solved(PROBLEMS[name]))


@pytest.mark.parametrize("dt", [0.1, 3.0])
def test_repelling_slide(dt):
    p = PROBLEMS["repelling slide"]
    sol = run(p.system, p.x0, p.t1, dt)
    assert sol.result == RESULTS.nonunique
    assert_array_equal(sol.t_final, p.ends_at)
    assert_array_equal(sol.x_final, p.end)


def test_repelling_slide_does_not_touch_its_neighbours():
    # A little off the surface the same scene is well posed.
    sol = run(PROBLEMS["repelling slide"].system, (2, 1e-9), 1.0, 0.1)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.x_final, [3, 1 + 1e-9], rtol=1e-14)


@pytest.mark.parametrize("dt", [0.3, 0.5])
def test_two_fold(dt):
    p = PROBLEMS["two-fold"]
    sol = run(p.system, p.x0, p.t1, dt)
    assert sol.result == RESULTS.nonunique
    assert_allclose(sol.t_final, p.ends_at, rtol=1e-9)
    assert_allclose(sol.x_final, p.end, rtol=0, atol=1e-9)
    with pytest.raises(RuntimeError, match="not unique"):
        jf.solve(p.system, jnp.asarray(p.x0, float), 0.0, p.t1, dt)


def test_two_fold_of_the_sd_oscillator_at_the_origin():
    p = PROBLEMS["sd from the origin"]
    sol = run(p.system, p.x0, p.t1, p.dt)
    assert sol.result == RESULTS.nonunique
    assert_array_equal(sol.t_final, p.ends_at)
    assert_array_equal(sol.x_final, p.end)


@pytest.mark.parametrize("dt", [0.3, 0.5])
@pytest.mark.slow
def test_corner_exit(dt):
    p = PROBLEMS["corner exit"]
    sol = run(p.system, p.x0, p.t1, dt)
    assert sol.result == RESULTS.nonunique
    assert_allclose(sol.t_final, p.ends_at, rtol=1e-13)
    assert_allclose(sol.x_final, p.end, rtol=0, atol=1e-13)


def test_undeclared_sliding():
    p = PROBLEMS["undeclared slide"]
    sol = run(p.system, p.x0, p.t1, p.dt)
    assert sol.result == RESULTS.undeclared_sliding
    assert_allclose(sol.t_final, p.ends_at, rtol=1e-13)
    assert_allclose(sol.x_final, p.end, rtol=0, atol=1e-13)


def test_undeclared_sliding_is_no_matter_where_the_scene_only_crosses():
    p = PROBLEMS["crosses as declared"]
    sol = run(p.system, p.x0, p.t1, p.dt)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.x_final, p.end, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    "factor, end, mode", [(0.0, (0, 0), 2), (0.5, (-3, -2.5), -1)], ids=["at rest", "let through"]
)
def test_impact_that_does_not_turn_the_motion_back(factor, end, mode):
    # Falls from 1/2, at the floor at t = 1 with speed 1.
    sol = run(Wall(jnp.asarray(factor)), (0.5, 0), 3.0, 0.3)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.x_final, end, rtol=0, atol=1e-12)
    assert sol.mode_final[0] == mode


def test_very_stiff_sides():
    # Exact but for exp(-1e6 t): y = 1 - t + 1/k until it is 0 at 1 + 1/k, then -1.
    k = 1e6
    saveat = diffrax.SaveAt(ts=jnp.asarray([0.999, 1.0005, 1.001]))
    sol = jf.solve(
        Stiff(jnp.asarray(k)), jnp.asarray([0.002 + 1 / k]), 0.998, 1.001, 2e-6, saveat=saveat
    )
    assert_allclose(sol.events.ts[0], 1 + 1 / k, rtol=1e-12)
    assert sol.events.kinds[0] == EventKind.crossing
    assert sol.num_events == 1
    assert_allclose(sol.xs[:, 0], [0.001 + 1 / k, -1, -1], rtol=1e-9)


def test_budget_of_steps():
    # y = 5 - t as far as four steps reach; what was saved before is right.
    saveat = diffrax.SaveAt(ts=jnp.asarray([0.2, 0.3, 0.9]))
    system = affine((1, -1), (1, 1))
    x0 = jnp.asarray([0.0, 5.0])
    sol = jf.solve(system, x0, 0.0, 2.0, 0.15, saveat=saveat, max_steps=4, throw=False)
    assert sol.result == RESULTS.max_steps_reached
    assert np.any(np.isclose(sol.t_final, [0.3, 0.45, 0.6], rtol=1e-14))
    assert_allclose(sol.x_final, [sol.t_final, 5 - sol.t_final], rtol=1e-14)
    assert_allclose(sol.xs[:2], [[0.2, 4.8], [0.3, 4.7]], rtol=1e-14)
    assert np.all(np.isinf(sol.xs[2]))
    with pytest.raises(RuntimeError, match="max_steps"):
        jf.solve(system, x0, 0.0, 2.0, 0.15, max_steps=4)


@pytest.mark.slow
def test_budget_of_contacts():
    ball = PROBLEMS["bouncing ball"].system
    saveat = diffrax.SaveAt(ts=jnp.asarray([1.0, 6.0, 12.0]))
    x0 = jnp.asarray([10.0, 0.0])
    sol = jf.solve(ball, x0, 0.0, 12.0, 0.1, saveat=saveat, max_events=3, throw=False)
    assert sol.result == RESULTS.max_events_reached
    assert sol.num_events == 3
    assert_allclose(sol.events.ts, closed_forms.bounces(0.9, 3), rtol=1e-12)
    assert 6.3142857 < sol.t_final < 10 / 7 * (1 + 2 * (0.9 + 0.81 + 0.729)) + 1e-9
    assert_allclose(sol.xs[0], [5.1, -9.8], rtol=1e-12)
    assert np.all(np.isfinite(sol.xs[:2]))
    assert np.all(np.isinf(sol.xs[2]))
    with pytest.raises(RuntimeError, match="max_events"):
        jf.solve(ball, x0, 0.0, 12.0, 0.1, max_events=3)


def test_budget_that_is_just_enough():
    ball = PROBLEMS["bouncing ball"].system
    x0 = jnp.asarray([10.0, 0.0])
    sol = jf.solve(ball, x0, 0.0, 7.0, 0.5, max_events=3, max_steps=100)
    assert sol.num_events == 3


# x0, t0, t1, rate, time of a NaN field, time of a NaN in H, state after the impact; where it ends.
INJECTIONS = {
    "nothing": ((0, 0, 2, 1, 9, 9, 0.0), (2, 1)),
    "x0 nan": ((np.nan, 0, 2, 1, 9, 9, 0.0), (0, np.nan)),
    "x0 inf": ((-np.inf, 0, 2, 1, 9, 9, 0.0), (0, -np.inf)),
    "t0": ((0, np.nan, 2, 1, 9, 9, 0.0), (np.nan, 0)),
    "t1": ((0, 0, np.inf, 1, 9, 9, 0.0), (0, 0)),
    "parameter": ((0, 0, 2, np.nan, 9, 9, 0.0), (0, 0)),
    "field": ((0, 0, 2, 1, 0.5, 9, 0.0), (0.5, 0.5)),
    "H": ((0, 0, 2, 1, 9, 0.5, 0.0), (0.5, 0.5)),
    "reset": ((0, 0, 2, 1, 9, 9, np.nan), (1, 1)),
}


@pytest.fixture(scope="module")
def poisoned():
    """One batch of all the injections."""

    def lane(x0, t0, t1, *numbers):
        system = Poison(*numbers)
        return jf.solve(system, x0[None], t0, t1, 0.15, max_events=8, throw=False)

    columns = np.asarray([numbers for numbers, _ in INJECTIONS.values()], float).T
    sols = eqx.filter_jit(jax.vmap(lane))(*map(jnp.asarray, columns))
    return dict(zip(INJECTIONS, range(len(INJECTIONS)), strict=True)), sols


@pytest.mark.slow
@pytest.mark.parametrize("name", list(INJECTIONS))
def test_nan_or_inf(poisoned, name):
    rows, sols = poisoned
    sol = jax.tree.map(lambda leaf: leaf[rows[name]], sols)
    t_final, x_final = INJECTIONS[name][1]
    if name == "nothing":
        # From 0 the wall at 1 is met once, at t = 1; sent back to 0 it is met again at t = 2.
        assert sol.result == RESULTS.successful
        assert_allclose(sol.events.ts[0], 1.0, rtol=1e-14)
    else:
        assert sol.result == RESULTS.nonfinite
        assert_allclose(sol.t_final, t_final, rtol=0, atol=0.16)
        if np.isfinite(x_final):
            assert_allclose(sol.x_final, [x_final], rtol=0, atol=0.16)


@pytest.mark.parametrize("name", ["parameter", "field", "H", "reset"])
def test_nan_or_inf_is_raised(name):
    (x0, t0, t1, *numbers), _ = INJECTIONS[name]
    system = Poison(*(jnp.asarray(float(v)) for v in numbers))
    with pytest.raises(RuntimeError, match="a reset is not finite"):
        jf.solve(system, jnp.asarray([float(x0)]), t0, t1, 0.15, max_events=8)


BALL, CORNER = jf.systems.BouncingBall(g=9.8, restitution=0.5), PROBLEMS["corner exit"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("call", "place"),
    [
        # Back to the impact at √(2·10/9.8) of a ball from rest at 10.
        (
            lambda: jf.solve(BALL, jnp.asarray([2.4, 1.4]), 2.0, 0.0, 0.1),
            r"t = 1\.428571\d*, x = \[.*\], on surface 0\.",
        ),
        (
            lambda: jf.solve(BALL, jnp.asarray([1.25, 0.0]), 0.0, 2.0, 0.125, max_steps=2),
            r"t = 0\.25, x = \[ 0\.94375, -2\.45   \]\.",
        ),
        (
            lambda: jf.solve(jf.systems.SDOscillator(), jnp.zeros(2), 0.0, 2.0, 0.1),
            r"t = 0, x = \[0\., 0\.\], on surface 0\.",
        ),
        pytest.param(
            lambda: jf.solve(CORNER.system, jnp.asarray(CORNER.x0, float), 0.0, 2.0, 0.3),
            r"t = 1, x = .*, on surfaces 0, 1\.",
            marks=pytest.mark.release,
        ),
    ],
)
def test_an_error_says_where_the_run_stopped(call, place):
    with pytest.raises(eqx.EquinoxRuntimeError, match=r"^[A-Z].*\. It stopped at " + place + "$"):
        call()


def test_an_error_of_a_traced_run_is_the_sentence():
    with pytest.raises(RuntimeError, match="The budget of steps was used up"):
        jax.jit(lambda x: jf.solve(BALL, x, 0.0, 2.0, 0.125, max_steps=2).xs)(jnp.ones(2))


class Doses(jf.System):
    """x' = -x, and a dose of 1 every T from the phase on."""

    every: jax.Array
    phase: jax.Array

    def vector_field(self, t, x, side):
        return -x

    def tick(self, t, x, clock):
        return x + 1

    @property
    def clocks(self):
        return (jf.Clock(self.every, self.phase),)


def test_a_lane_whose_clock_has_no_period_is_told():
    """Nothing ticks in it, and its field is well all the same. The first lane has doses at
    0.4 and 0.8."""
    every = jnp.array([0.4, 0.0, -0.4, jnp.inf, jnp.nan, 0.4])
    phase = jnp.array([0.0, 0.0, 0.0, 0.0, 0.0, jnp.nan])

    def end(every, phase):
        return jf.solve(Doses(every, phase), jnp.ones(1), 0.0, 1.0, 0.25, throw=False)

    sols = jax.jit(jax.vmap(end))(every, phase)
    names = ["successful", *["invalid_period"] * 3, *["nonfinite"] * 2]
    assert_array_equal(RESULTS.names(sols.result), names)
    assert_allclose(sols.x_final[0, 0], np.exp([-1, -0.6, -0.2]).sum(), rtol=1e-10)
