"""Resets that throw a slow motion back and let a faster one through; without forces, so that the
velocities before and after each contact give the end."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf


class Free(jf.System):
    """A point that no force acts on, with a surface at x = 1."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], 0.0])

    def switching(self, t, x):
        return x[0] - 1


class Gate(Free):
    """A point that meets x = 1. Faster than `strength` it goes through, and otherwise comes back
    half as fast; or, with a `kick`, it leaves upward with this velocity at least."""

    strength: jax.Array
    kick: jax.Array

    def reset(self, t, x, surface):
        v = x[1]
        after = jnp.where(jnp.abs(v) > self.strength, v, -v / 2)
        return jnp.stack([x[0], jnp.where(self.kick > 0, jnp.maximum(v, self.kick), after)])


# strength, kick, x and v at t = 0, x and v at t = 3, contacts
CASES = [
    (2.0, 0.0, 0.0, 1.0, 0.0, -0.5, 1),
    (2.0, 0.0, 0.0, 4.0, 12.0, 4.0, 0),
    (2.0, 0.0, 3.0, -4.0, -9.0, -4.0, 0),
    (0.0, 2.0, 0.0, 1.0, 5.0, 2.0, 1),
    (0.0, 2.0, 3.0, -2.0, 5.0, 2.0, 1),
    (0.0, 2.0, 0.0, 4.0, 12.0, 4.0, 0),
]


@eqx.filter_jit
@eqx.filter_vmap
def solve(strength, kick, x0):
    sol = jf.solve(Gate(strength, kick), x0, 0.0, 3.0, 0.4, throw=False)
    return sol.result, sol.x_final, sol.mode_final, sol.events.kinds


@pytest.mark.slow
def test_what_a_reset_does_not_throw_back_goes_through():
    strength, kick, x, v, *end, impacts = map(jnp.asarray, zip(*CASES, strict=True))
    results, found, modes, kinds = solve(strength, kick, jnp.stack([x, v], axis=1))
    names = jf.model.outcomes.outcome_names(results).tolist()
    assert names == ["successful"] * len(CASES)
    np.testing.assert_allclose(found, np.stack(end, axis=1), rtol=0, atol=1e-13)
    np.testing.assert_array_equal(modes[:, 0], np.where(end[0] > 1, 1, -1))
    made = np.sum(np.asarray(kinds) == jf.EventKind.impact.value, axis=1)
    np.testing.assert_array_equal(made, impacts)


class Step(Free):
    """A particle on a potential step at x = 1. Down it leaves with -√(v² + 8)."""

    def reset(self, t, x, surface):
        v = x[1]
        climbs = v**2 > 8
        up = jnp.where(climbs, jnp.sqrt(jnp.where(climbs, v**2 - 8, 1.0)), -v)
        return x.at[1].set(jnp.where(v < 0, -jnp.sqrt(v**2 + 8), up))


class Toggle(jf.System):
    """x' = 3 + u, and u changes its sign at x = 1."""

    def vector_field(self, t, x, side):
        return jnp.stack([3 + x[1], 0.0])

    def switching(self, t, x):
        return 1 - x[0]

    def reset(self, t, x, surface):
        return x.at[1].multiply(-1.0)


@pytest.mark.parametrize(
    ("system", "x0", "cut", "after", "t1", "end"),
    [
        (Step(), [2.0, -1.0], 1.0, [1.0, -3.0], 2.0, [-2.0, -3.0]),
        (Toggle(), [0.0, 1.0], 0.25, [1.0, -1.0], 1.0, [2.5, -1.0]),
    ],
)
@pytest.mark.slow
def test_a_run_from_just_after_the_passage_is_the_rest_of_the_run(system, x0, cut, after, t1, end):
    whole = jf.solve(system, jnp.array(x0), 0.0, t1, 0.07)
    rest = jf.solve(system, jnp.array(after), cut, t1, 0.07)
    np.testing.assert_allclose(whole.x_final, end, rtol=0, atol=1e-13)
    np.testing.assert_allclose(rest.x_final, end, rtol=0, atol=1e-13)


class Filled(jf.System):
    """A pump fills a tank until a float turns it off at a level of 1. At t = 2 another inflow
    begins, b' = a − b, a' = −a, which the float cannot stop."""

    pump: jax.Array
    product: bool = eqx.field(static=True)

    def vector_field(self, t, x, side):
        on = x[3] if self.product else jnp.where(x[3] > 0.5, 1.0, 0.0)
        return jnp.stack([-x[0], x[0] - x[1], self.pump * on + x[1], 0 * t])

    def switching(self, t, x):
        return 1 - x[2]

    def reset(self, t, x, surface):
        return x.at[3].set(0.0)

    def tick(self, t, x, clock):
        return x.at[0].add(1.0)

    @property
    def clocks(self):
        return (jf.Clock(10.0, 2.0),)


@pytest.mark.parametrize("product", [True, False])
@pytest.mark.slow
def test_a_float_switch_is_no_wall(product):
    """By its derivative the reset is that of a wall without restitution, which no water presses."""
    sol = jf.solve(Filled(jnp.array(0.8), product), jnp.array([0.0, 0.0, 0.0, 1.0]), 0.0, 4.0, 0.1)
    a, b = np.exp(-2.0), 2 * np.exp(-2.0)
    np.testing.assert_allclose(sol.x_final, [a, b, 2 - a - b, 0.0], rtol=0, atol=1e-13)
