"""Averages along a motion, against closed forms, through crossings and impacts."""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from tests.problems.systems import UnitBelt

EPS = np.finfo(float).eps


class Ramp(jf.System):
    """x' = −1 above zero, and with a wall there it is thrown back at what it falls at."""

    rate: jax.Array
    slides: ClassVar[bool] = True

    def vector_field(self, t, x, side):
        return (-self.rate * side + 0.25)[None]

    def switching(self, t, x):
        return x[0]


def test_a_duty_cycle_is_that_of_the_slide_and_of_what_came_before():
    """From 3/4 at −3/4 for a time of 1, and then a slide with the weight w = 1/4."""

    def duty(rate):
        x0 = jnp.array([0.75])
        return jf.average(
            Ramp(rate), lambda t, x, side: 0.5 * (1 + side), x0, 0.0, 4.0, 0.25, stepper=jf.RK4()
        ).value

    value, slope = jax.value_and_grad(duty)(jnp.array(1.0))
    np.testing.assert_allclose(value, (1 + 3 * 0.625) / 4, rtol=16 * EPS)
    # With the rate r: a time τ = 3/(4r − 1), and then w = 1/(4r).
    np.testing.assert_allclose(slope, ((-4 / 3) * (1 - 0.625) - 3 * 0.125) / 4, rtol=1e-12)


def test_the_mean_energies_of_a_ball_are_those_of_its_flight():
    """Mean of x is 2/3 of the height, mean of v²/2 a third of it, in whole flights."""

    def energies(t, x, side):
        return jnp.stack([x[0], 0.5 * x[1] ** 2])

    found = jf.average(
        jf.systems.BouncingBall(g=1.0, restitution=1.0),
        energies,
        jnp.array([0.5, 0.0]),
        0.0,
        4.0,
        0.3,
        stepper=jf.RK4(),
    )
    np.testing.assert_allclose(found.value, [1 / 3, 1 / 6], rtol=64 * EPS)
    np.testing.assert_allclose(found.x_final, [0.5, 0.0], rtol=0, atol=64 * EPS)


def sticks(t, x, mode):
    return jnp.where(mode == 0, 1.0, 0.0)


def rests(t, x, mode):
    return jnp.where(abs(mode) == 2, 1.0, 0.0)


def sticking(force, **options):
    """The share of the time to 2 that the mass sticks, from where the belt has carried it to the
    middle: until the spring, t - 1/2, is as strong as the friction."""
    x0 = jnp.array([-0.5, 1.0], jnp.result_type(force))
    options = dict(stepper=jf.RK4()) | options
    return jf.average(UnitBelt(force), sticks, x0, 0.0, 2.0, 0.15, **options).value


ADJOINTS = [diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()]


@pytest.mark.parametrize(
    "adjoint", [ADJOINTS[0], pytest.param(ADJOINTS[1], marks=pytest.mark.release)]
)
def test_the_share_of_sticking_is_a_share_of_time(adjoint):
    """Where the side would be a weight, or one side of a blend, the mode is 0. The share has the
    derivative of the time that the stick ends at."""

    def share(force):
        return sticking(force, adjoint=adjoint)

    forces = jnp.array([0.75, 1.0, 1.25])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(share)))(forces)
    np.testing.assert_allclose(values, (forces + 0.5) / 2, rtol=64 * EPS)
    np.testing.assert_allclose(slopes, [0.5] * 3, rtol=64 * EPS)


def test_shares_of_time_in_single_precision():
    forces = jnp.array([0.75, 1.25], jnp.float32)
    values = jax.vmap(sticking)(forces)
    assert values.dtype == jnp.float32
    np.testing.assert_allclose(values, (forces + 0.5) / 2, rtol=16 * np.finfo(np.float32).eps)


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.0, 0.5, 0.8])
def test_the_share_of_rest_begins_after_the_last_impact(restitution):
    """From h it falls for a time √h, and then flies for 2e + 2e² + … = 2e/(1 − e) of that."""

    def share(e, h):
        ball = jf.systems.BouncingBall(g=2.0, restitution=e)
        return jf.average(ball, rests, jnp.stack([h, 0 * h]), 0.0, 16.0, 0.1).value

    e = restitution
    value, slopes = jax.value_and_grad(share, (0, 1))(jnp.array(e), jnp.array(1.0))
    np.testing.assert_allclose(value, 1 - (1 + 2 * e / (1 - e)) / 16, rtol=256 * EPS)
    np.testing.assert_allclose(slopes[1], -(1 + 2 * e / (1 - e)) / 32, rtol=1e-11)
    # A ball that does not bounce has no flight that could become longer.
    np.testing.assert_allclose(slopes[0], -2 / (1 - e) ** 2 / 16 if e > 0 else 0.0, rtol=1e-11)


def test_a_mean_of_modes_is_the_same_backward_in_time():
    spring = jf.piecewise(
        lambda t, x: jnp.stack([x[1], -x[0]]),
        lambda t, x: jnp.stack([x[1], -4 * x[0]]),
        lambda t, x: x[0],
    )

    def found(x0, t0, t1):
        return jf.average(spring, lambda t, x, mode: mode, x0, t0, t1, 0.1)

    there = found(jnp.array([0.0, 1.0]), 0.0, 1.25 * jnp.pi)
    back = found(there.x_final, 1.25 * jnp.pi, 0.0)
    np.testing.assert_allclose(there.value, 1 - 2 * 0.25 / 1.25, rtol=64 * EPS)
    np.testing.assert_allclose(back.value, there.value, rtol=256 * EPS)


class Masses(jf.System):
    """Masses on dry friction, pushed ever harder, that slip when the push is their friction."""

    forces: jax.Array

    def vector_field(self, t, x, side):
        return t - self.forces * side

    def switching(self, t, x):
        return x


@pytest.mark.slow
@pytest.mark.parametrize("m", [2, 5, 16])
def test_of_many_surfaces_each_has_its_mode(m):
    forces = jnp.linspace(0.25, 0.85, m)
    found = jf.average(Masses(forces), sticks, jnp.zeros(m), 0.0, 1.0, 0.1, stepper=jf.RK4())
    np.testing.assert_allclose(found.value, forces, rtol=64 * EPS)


def test_what_is_no_function_of_time_state_and_side_is_refused_by_name():
    with pytest.raises(ValueError, match="`function` must return an array"):
        jf.average(
            jf.systems.BouncingBall(g=1.0, restitution=1.0),
            lambda t, x, side: None,
            jnp.zeros(2),
            0.0,
            1.0,
            0.1,
        )


@pytest.mark.slow
def test_a_mean_over_no_time_is_refused_and_in_a_batch_an_outcome():
    def mean(t1, throw=False):
        ball = jf.systems.BouncingBall(g=1.0, restitution=1.0)
        x0 = jnp.array([0.5, 0.0])
        return jf.average(ball, lambda t, x: x[0], x0, 1.0, t1, 0.1, throw=throw)

    with pytest.raises(ValueError, match="`t1` must differ from `t0`"):
        mean(1.0)
    found = jax.vmap(mean)(jnp.array([1.0, 1.5, 0.5]))
    names = jf.RESULTS.names(found.result)
    assert names.tolist() == ["nonfinite", "successful", "successful"]
    # It falls from 1/2 for a time of 1/2, and backward in the same way.
    np.testing.assert_allclose(found.value[1:], 1 / 2 - 1 / 24, rtol=64 * EPS)
    assert "batch of shape (3,)" in repr(found)
    assert "0.458333333 up to t = 1.5\n  successful" in repr(mean(1.5, throw=True))


def test_a_run_of_no_time_takes_nothing_from_the_gradient_of_others():
    """The mean of k x from 1 with x' = −k x is 1 − exp(−k)."""

    def total(k):
        decay = jf.piecewise(lambda t, x: -k * x, lambda t, x: -k * x, lambda t, x: x[0] + 9.0)

        def mean(x0):
            run = jf.average(decay, lambda t, x: k * x[0], x0[None], 0.0, 1.0, 0.1, throw=False)
            return run.value, run.result

        means, results = jax.vmap(mean)(jnp.asarray([1.0, np.nan]))
        return jnp.where(results == jf.RESULTS.successful, means, 0.0).sum()

    np.testing.assert_allclose(jax.jit(jax.grad(total))(0.7), np.exp(-0.7), rtol=1e-10)
