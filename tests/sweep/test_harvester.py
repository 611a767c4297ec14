"""The mean power of a harvester that hits two stops: its best load by gradient, map and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from numpy.testing import assert_allclose

import jaxfil as jf

COIL, BOUNCE = 4.0, 0.6


class Harvester(jf.System):
    """x'' + x'/(4 + R) + x = 0.8 cos ωt between a stop at 1 and one at −1.1, with a load R behind a
    coil of resistance 4."""

    load: jax.Array
    omega: jax.Array

    slides = False

    @property
    def period(self):
        return 2 * jnp.pi / self.omega

    def vector_field(self, t, x, side):
        push = 0.8 * jnp.cos(self.omega * t)
        return jnp.stack([x[1], push - x[1] / (COIL + self.load) - x[0]])

    def switching(self, t, x):
        return jnp.stack([1 - x[0], x[0] + 1.1])

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -BOUNCE * x[1]])


def power(t, x, side, system):
    return system.load * x[1] ** 2 / (COIL + system.load) ** 2


def by_scipy(load, omega):
    """The mean power over the last of 60 periods, from impact to impact."""

    def field(t, y):
        push = 0.8 * np.cos(omega * t)
        return [y[1], push - y[1] / (COIL + load) - y[0], y[1] ** 2]

    def high(t, y):
        return 1 - y[0]

    def low(t, y):
        return y[0] + 1.1

    high.terminal = low.terminal = True
    high.direction = low.direction = -1
    period = 2 * np.pi / omega
    y = np.array([0.1, 0.0, 0.0])
    for k in range(60):
        t, y[2] = k * period, 0.0
        while t < (k + 1) * period:
            run = scipy.integrate.solve_ivp(
                field,
                (t, (k + 1) * period),
                y,
                "DOP853",
                events=(high, low),
                rtol=1e-11,
                atol=1e-12,
            )
            t, y = run.t[-1], run.y[:, -1]
            if run.status == 1:
                y[1] *= -BOUNCE
    return load * y[2] / period / (COIL + load) ** 2


@pytest.mark.release
def test_the_best_load_by_gradient_is_that_of_a_map():
    start, run = jnp.array([0.1, 0.0]), dict(transient=60, samples=4, steps=20)
    loads, omegas = np.linspace(2.0, 7.0, 11), np.array([1.2, 1.3, 1.4])
    average = {"power": power, "hits": jf.EventSum(lambda t, before, after, surfaces: surfaces)}
    system = Harvester(jnp.array(3.0), jnp.array(1.3))
    found = jf.bifurcation_diagram(
        system, ("load", "omega"), (loads, omegas), start, average=average, progress=False, **run
    )
    # One impact on either stop in each of four periods.
    np.testing.assert_array_equal(found.averages["hits"], np.full((11, 3, 2), 4))
    drawn = found.averages["power"]

    @jax.jit
    def mean(load):
        lane = Harvester(load, jnp.array(1.3))
        return jf.settled_average(lane, {"power": power}, start, **run).averages["power"]

    slope = jax.jacfwd(mean)
    best = scipy.optimize.brentq(lambda load: float(slope(jnp.array(load))), 3.0, 6.0)
    highest = loads[drawn[:, 1].argmax()]
    assert abs(highest - best) <= 0.25 and mean(best) >= drawn[:, 1].max()
    assert_allclose(mean(best), by_scipy(best, 1.3), rtol=1e-8)
    searched = scipy.optimize.minimize_scalar(
        lambda load: -by_scipy(load, 1.3), bounds=(3.0, 6.0), method="bounded"
    )
    assert_allclose(best, searched.x, rtol=1e-4)
