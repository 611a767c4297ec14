"""Several surfaces that bear one load, such as brakes on one disc, or the friction of a mass and
the wall that it lies against: their motion is unique, while their weights and reactions are not.
Brakes share the load, and a slide ends when all are at their limits. A wall bears what a friction
cannot.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names


class Brakes(jf.System):
    """A disc under a load 3 sin t with several brakes, each with H = c v of its own scale c."""

    limits: jax.Array
    scales: tuple = ()

    def vector_field(self, t, x, side):
        rubs = self.limits @ (side * jnp.sign(jnp.array(self.scales)))
        return jnp.stack([x[1], 3.0 * jnp.sin(t) - rubs])

    def switching(self, t, x):
        return jnp.array(self.scales) * x[1]


class Brake(jf.System):
    """The same with one brake."""

    limit: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], 3.0 * jnp.sin(t) - self.limit * side])

    def switching(self, t, x):
        return x[1]


_MORE = [
    pytest.param(s, marks=pytest.mark.release) for s in ((0.5, 1.0, -1.0), (1.0, -1.0, 2.0, 1.0))
]


@pytest.mark.parametrize("scales", [(1.0, -2.0), *_MORE])
@pytest.mark.slow
def test_brakes_on_one_disc_are_one_brake(scales):
    def end(system):
        sol = jf.solve(system, jnp.zeros(2), 0.0, 9.0, 0.05, max_events=64, throw=False)
        return sol.x_final, sol.result, sol.events.ts[0]

    k = len(scales)
    totals = jnp.array([1.8, 2.2, 0.9])
    # A different share of the total for each lane.
    shares = jnp.stack([jnp.roll(jnp.arange(1.0, k + 1), i) for i in range(3)])
    limits = totals[:, None] * shares / jnp.sum(shares, axis=1, keepdims=True)

    def several(limits):
        return end(Brakes(limits, scales))

    one = jax.jit(jax.vmap(lambda limit: jax.jvp(lambda v: end(Brake(v))[0], (limit,), (1.0,))))
    exact, slope = one(totals)
    found, results, first = jax.jit(jax.vmap(several))(limits)
    assert (outcome_names(results) == "successful").all()
    np.testing.assert_allclose(first, np.arcsin(totals / 3), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-11)
    # Each limit counts for itself, whatever its brake carries.
    by_limits = jax.jit(jax.vmap(jax.jacfwd(lambda v: several(v)[0])))(limits)
    np.testing.assert_allclose(by_limits, np.stack([slope] * k, axis=-1), rtol=0, atol=1e-9)


class Pressed(jf.System):
    """Two masses that rub on the ground, each at a wall below it, under loads -a cos(t + phase)."""

    loads: jax.Array
    phase: jax.Array
    limits: jax.Array
    signs: jax.Array
    "The directions in which the velocities are counted."

    def vector_field(self, t, x, side):
        rubs = self.limits * self.signs * side[:2]
        return jnp.concatenate([x[2:], -self.loads * jnp.cos(t + self.phase) - rubs])

    def switching(self, t, x):
        return jnp.concatenate([self.signs * x[2:], x[:2]])

    def reset(self, t, x, surface):
        k = surface - 2
        return jnp.where(k >= 0, x.at[2 + k].multiply(-0.3), x)


@pytest.mark.slow
def test_a_wall_bears_what_a_friction_cannot():
    """Pressed to their walls by more than the friction, or by less, from the start or by a load
    that grows from zero, and torn off them later by a load that exceeds it, or by none."""
    limits = jnp.array([1.0, 0.7])
    loads = jnp.tile(jnp.array([[2.0, 2.0], [0.6, 0.5], [2.0, 0.5], [0.6, 2.0]]), (2, 1))
    signs = jnp.tile(jnp.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]]), (2, 1))
    phases = jnp.repeat(jnp.array([0.0, -jnp.pi / 2]), 4)

    @jax.jit
    @jax.vmap
    def end(loads, signs, phase):
        def at_the_end(loads):
            system = Pressed(loads, phase, limits, signs)
            sol = jf.solve(system, jnp.zeros(4), 0.0, 3.0 - phase, 0.05, max_events=16, throw=False)
            return sol.x_final, (sol.result, sol.num_events)

        return jax.jvp(at_the_end, (loads,), (jnp.ones(2),), has_aux=True)

    def exact(a):
        since = jnp.arccos(jnp.maximum(-limits / a, -1.0))  # the load has grown to the friction
        time = 3.0 - since
        v = a * (jnp.sin(since) - jnp.sin(3.0)) - limits * time
        x = a * (jnp.cos(3.0) - jnp.cos(since) + jnp.sin(since) * time) - limits * time**2 / 2
        return jnp.where(
            jnp.concatenate([a, a]) > jnp.concatenate([limits, limits]), jnp.r_[x, v], 0
        )

    found, slopes, (results, events) = end(loads, signs, phases)
    assert (outcome_names(results) == "successful").all()
    np.testing.assert_allclose(found, jax.vmap(exact)(loads), rtol=0, atol=1e-14)
    by_load = jax.vmap(lambda a: jax.jvp(exact, (a,), (jnp.ones(2),))[1])(loads)
    np.testing.assert_allclose(slopes, by_load, rtol=0, atol=1e-13)
    # Two that lie still all the time have no event.
    idle = jnp.array([1, 5])
    assert (events[idle] == 0).all() and (jnp.delete(events, idle) > 0).all()


class Leaning(jf.System):
    """A mass under a load -2 sin t that rubs on the ground and lies against a wall and against a
    second mass of 2, which rubs on the ground too."""

    limits: jax.Array
    sign: jax.Array
    "The direction in which the velocity of the first mass is counted."
    restitution: jax.Array

    def vector_field(self, t, x, side):
        first = -2.0 * jnp.sin(t) - self.limits[0] * self.sign * side[0]
        return jnp.stack([x[2], x[3], first, -0.5 * self.limits[1] * side[1]])

    def switching(self, t, x):
        return jnp.stack([self.sign * x[2], x[3], x[0] - x[1] - 1.0, x[0]])

    def reset(self, t, x, surface):
        e = self.restitution
        # The change of the velocity of their distance, shared as 1/m.
        change = -(1 + e) * (x[2] - x[3])
        apart = x.at[2].add(2 / 3 * change).at[3].add(-1 / 3 * change)
        off = jnp.where(surface == 3, x.at[2].multiply(-e), x)
        return jnp.where(surface == 2, apart, off)


@pytest.mark.slow
def test_either_of_two_bears_what_a_friction_cannot():
    """The first mass lies still until the load turns and exceeds its friction. Meanwhile the wall
    bears the rest of the load, or the second mass if its friction can."""
    limits = jnp.array([[1.0, 2.2], [1.0, 0.3], [1.0, 2.2], [0.8, 0.3], [0.8, 1.3], [1.0, 0.3]])
    signs = jnp.array([1.0, -1.0, -1.0, 1.0, -1.0, 1.0])
    restitutions = jnp.array([0.0, 0.0, 0.3, 0.3, 0.0, 0.6])

    @jax.jit
    @jax.vmap
    def end(limits, sign, e):
        def at_the_end(first):
            system = Leaning(limits.at[0].set(first), sign, e)
            x0 = jnp.array([0.0, -1.0, 0.0, 0.0])
            sol = jf.solve(system, x0, 0.0, 4.5, 0.05, max_events=16, throw=False)
            return sol.x_final, sol.result

        return jax.jvp(at_the_end, (limits[0],), (1.0,), has_aux=True)

    def exact(limit):
        since = jnp.pi + jnp.arcsin(limit / 2)
        time = 4.5 - since
        v = 2 * (jnp.cos(4.5) - jnp.cos(since)) - limit * time
        x = 2 * (jnp.sin(4.5) - jnp.sin(since) - jnp.cos(since) * time) - limit * time**2 / 2
        return jnp.stack([x, 0 * x - 1, v, 0 * v])

    found, slopes, results = end(limits, signs, restitutions)
    assert (outcome_names(results) == "successful").all()
    np.testing.assert_allclose(found, jax.vmap(exact)(limits[:, 0]), rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        slopes, jax.vmap(jax.jacfwd(exact))(limits[:, 0]), rtol=0, atol=1e-13
    )
