"""Averages along a motion, against closed forms, through crossings and impacts."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf

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
