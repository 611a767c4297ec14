"""A step that its method cannot take is halved, and what halving does not mend is told; one that is
merely coarse, or starts from zero, is taken."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf

RELIABLE = [diffrax.Tsit5(), diffrax.Dopri5(), diffrax.Dopri8()]
CRUDE = [jf.RK4(), diffrax.Bosh3()]
ALL = [*RELIABLE, jf.RK4(), diffrax.Heun(), diffrax.Euler(), jf.Rodas5P()]


def solve(*args, **options):
    """A run without a table of events, which none of these looks at."""
    return jf.solve(*args, max_events=None, throw=options.pop("throw", False), **options)


def name(stepper):
    return type(stepper).__name__


class Chain(jf.System):
    """x_i' = x_{i+1}, and the last one's is constant: powers of time from zero."""

    pull: float = 2.0
    slides: bool = eqx.field(static=True, default=False)

    def vector_field(self, t, x, side):
        return jnp.append(x[1:], self.pull)

    def switching(self, t, x):
        return x[0] + 1.0


class Fast(jf.System):
    """x' = −λ (x − cos t): far past the stability of an explicit step at λh = 10."""

    slides = False
    rate: float = 1e3
    smooth: bool = eqx.field(static=True, default=False)

    def vector_field(self, t, x, side):
        return -self.rate * (x - jnp.cos(t))

    def switching(self, t, x):
        return jnp.zeros((0,)) if self.smooth else x[0] + 50.0


# Slip–stick motion of x'' + x with a friction that has a pole beyond the belt's speed; its time is
# (x, x') to 1e-9 at t = 20 from steps of 0.01.
@pytest.mark.parametrize(
    "stepper, dt, error",
    [
        (diffrax.Tsit5(), 1.0, 1e-2),
        (diffrax.Tsit5(), 1.25, 1e-2),
        (diffrax.Tsit5(), 2.5, 1e-2),
        (diffrax.Dopri8(), 1.0, 1e-5),
        (diffrax.Dopri8(), 1.25, 2e-3),
        (diffrax.Dopri8(), 2.0, 2e-3),
        (diffrax.Dopri8(), 2.5, 2e-3),
    ],
    ids=lambda v: name(v) if not isinstance(v, float) else str(v),
)
def test_what_is_called_successful_is_near(stepper, dt, error):
    system, x0 = jf.systems.SlipStick(), jnp.array([1.0, 0.2])
    ref = solve(system, x0, 0.0, 20.0, 0.01)
    sol = solve(system, x0, 0.0, 20.0, dt, stepper=stepper)
    assert sol.result == jf.RESULTS.successful
    np.testing.assert_allclose(sol.x_final, ref.x_final, rtol=0, atol=error)


@pytest.mark.slow
@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("stepper", [*RELIABLE, *CRUDE, jf.Rodas5P()], ids=name)
def test_an_unstable_step_is_halved(stepper, smooth):
    run = solve(Fast(smooth=smooth), jnp.array([2.0]), 0.0, 1.0, 0.01, stepper=stepper)
    assert run.result == jf.RESULTS.successful and run.stats["num_halvings"] > 0
    # x = (k² cos t + k sin t)/(k² + 1), and a transient that is over.
    k = 1e3
    exact = (k * k * np.cos(1.0) + k * np.sin(1.0)) / (k * k + 1)
    np.testing.assert_allclose(run.x_final, exact, rtol=0, atol=2e-3 if stepper in CRUDE else 2e-5)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_field_too_stiff_for_its_method_is_told(smooth):
    sol = solve(Fast(1e9, smooth=smooth), jnp.array([2.0]), 0.0, 1.0, 0.01)
    assert sol.result == jf.RESULTS.step_too_long
    told = "halved, .* stopped at t = "
    with pytest.raises(eqx.EquinoxRuntimeError, match=told):
        solve(Fast(1e9, smooth=smooth), jnp.array([2.0]), 0.0, 1.0, 0.01, throw=True)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("n", [2, 4])
@pytest.mark.parametrize("stepper", ALL, ids=name)
def test_a_start_from_zero_is_no_gross_error(stepper, n, scale):
    sol = solve(Chain(2.0 * scale), jnp.zeros(n), 0.0, 6.0, 2.0, stepper=stepper)
    assert sol.result == jf.RESULTS.successful


class Cancelling(jf.System):
    """x1' is the difference of two numbers that are equal but for rounding."""

    slides = False

    def vector_field(self, t, x, side):
        return jnp.array([x[1] - x[2], -0.3 * x[1], -(0.1 * x[2] + 0.2 * x[2])])

    def switching(self, t, x):
        return x[1] - 1e-3


@pytest.mark.parametrize("stepper", RELIABLE, ids=name)
def test_rounding_of_another_component_is_no_gross_error(stepper):
    x0 = jnp.array([0.0, 1.0, 1.0])
    sol = solve(Cancelling(), x0, 0.0, 3.0, 0.3, stepper=stepper)
    assert sol.result == jf.RESULTS.successful
    assert 0 < abs(sol.x_final[0]) < 1e-14


def test_a_lane_that_cannot_be_followed_harms_no_other():
    belt = jf.systems.BeltFriction()
    swept = {"progress": False, "transient": 5, "samples": 5, "stepper": diffrax.Tsit5()}
    pulls = jnp.array([0.1, np.inf, 0.1])
    d = jf.bifurcation_diagram(belt, "f0", pulls, jnp.zeros(2), steps=100, **swept)
    np.testing.assert_array_equal(d.successful, [True, False, True])
    np.testing.assert_array_equal(d.xs[0], d.xs[2])
    assert np.isfinite(d.xs[0]).all()


class PulledBlock(jf.System):
    """A block on a plane, pulled by a spring whose end moves: it sticks until t = 3."""

    at: float = 0.0

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -0.5 * (x[0] - self.at - 0.2 * t) - 0.3 * side])

    def switching(self, t, x):
        return x[1]


@pytest.mark.parametrize("at", [0.0, 1e-9, 1.0, -1e6])
@pytest.mark.parametrize("stepper", RELIABLE, ids=name)
def test_a_state_of_zero_is_no_measure_of_a_step(stepper, at):
    # Wherever the origin is: x = at + 0.2 (s - sin(w s)/w) a time s after it has begun to slip.
    x0 = jnp.array([at, 0.0])
    sol = solve(PulledBlock(at), x0, 0.0, 10.0, 0.05, stepper=stepper)
    assert sol.result == jf.RESULTS.successful
    w, s = np.sqrt(0.5), 7.0
    want = [at + 0.2 * (s - np.sin(w * s) / w), 0.2 * (1 - np.cos(w * s))]
    np.testing.assert_allclose(sol.x_final, want, rtol=0, atol=1e-7 + 1e-15 * abs(at))


class Beside(jf.System):
    """Two oscillators that know nothing of each other, in units of their own."""

    units_: jax.Array

    def vector_field(self, t, x, side):
        u = self.units_
        pull = -x[0] - 0.3 * u * side[0]
        return jnp.stack([x[1], pull, x[3], -4 * x[2]])

    def switching(self, t, x):
        return jnp.stack([x[1] - 2 * self.units_])


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("dt, halved", [(0.1, False), (6.0, True)])
def test_a_step_is_judged_in_each_components_own_unit(unit, dt, halved):
    x0 = jnp.array([unit, 0.0, 1.0, 0.0])
    sol = solve(Beside(jnp.asarray(unit)), x0, 0.0, 12.0, dt)
    assert sol.result == jf.RESULTS.successful
    assert bool(sol.stats["num_halvings"] > 0) == halved
    np.testing.assert_allclose(sol.x_final[2:], [np.cos(24), -2 * np.sin(24)], rtol=0, atol=1e-3)


class Masses(jf.System):
    """n masses of 1 between springs, the first one's left; the last one is pulled by 1."""

    springs: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        q, v = jnp.split(x, 2)
        force = jnp.append(self.springs * jnp.diff(q, prepend=0.0), 1.0)
        return jnp.concatenate([v, jnp.diff(force)])

    def switching(self, t, x):
        return x[0] + 9.0


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [diffrax.Tsit5(), diffrax.Dopri8()], ids=name)
@pytest.mark.parametrize("n", [8, 20])
def test_masses_far_away_begin_to_move_like_a_high_power_of_time(n, stepper):
    system = Masses(jnp.ones(n))
    sol = solve(system, jnp.zeros(2 * n), 0.0, 2.0, 0.05, stepper=stepper, compact=True)
    # About the place of rest q_i = i: cos of the root of the matrix.
    stiffness = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    stiffness[-1, -1] = 1
    squares, shapes = np.linalg.eigh(stiffness)
    rest = np.arange(1.0, n + 1)
    exact = rest - shapes @ (np.cos(2.0 * np.sqrt(squares)) * (shapes.T @ rest))
    np.testing.assert_allclose(sol.x_final[:n], exact, rtol=0, atol=1e-8)


def test_steps_of_a_long_chain_with_a_stiff_spring_are_halved():
    springs = np.ones(20)
    springs[17] = 1e4
    sol = solve(Masses(jnp.asarray(springs)), jnp.zeros(40), 0.0, 2.0, 0.1, compact=True)
    assert sol.result == jf.RESULTS.successful and sol.stats["num_halvings"] > 0
    stiffness = np.diag(springs + np.append(springs[1:], 0.0))
    stiffness -= np.diag(springs[1:], 1) + np.diag(springs[1:], -1)
    squares, shapes = np.linalg.eigh(stiffness)
    rest = np.linalg.solve(stiffness, np.eye(20)[-1])
    exact = rest - shapes @ (np.cos(2.0 * np.sqrt(squares)) * (shapes.T @ rest))
    np.testing.assert_allclose(sol.x_final[:20], exact, rtol=0, atol=1e-5)


class Upstroke(jf.System):
    """v' = a exp(v), which is infinite a time exp(−v)/a after v; reset at a peak."""

    a: jax.Array
    back: jax.Array
    peak: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return self.a * jnp.exp(x)

    def switching(self, t, x):
        return self.peak - x[0]

    def reset(self, t, x, surface):
        return self.back[None]


@pytest.mark.slow
def test_steps_that_overflow_leave_no_nan_in_reverse_mode():
    """The time of the second spike, after steps from the reset that overflow."""

    def second(p):
        reverse = diffrax.RecursiveCheckpointAdjoint()
        run = dict(max_events=8, max_steps=256, adjoint=reverse, compact=True)
        sol = jf.solve(Upstroke(*p[1:]), p[:1], 0.0, 1.02, 0.5, stepper=diffrax.Tsit5(), **run)
        return sol.events.ts[1], sol.stats["num_halvings"]

    p = np.array([0.0, 1.1, 2.0, 4.0])
    (t, halved), slope = jax.jit(jax.value_and_grad(second, has_aux=True))(jnp.asarray(p))
    # (exp(−v0) − exp(−peak) + exp(−back) − exp(−peak))/a.
    by_v = np.array([1.0, 1.0, -2.0]) * np.exp(-p[[0, 2, 3]]) / p[1]
    assert halved > 0
    np.testing.assert_allclose(t, by_v.sum(), rtol=1e-3)
    right = [-by_v[0], -by_v.sum() / p[1], -by_v[1], -by_v[2]]
    np.testing.assert_allclose(slope, right, rtol=1e-2)
