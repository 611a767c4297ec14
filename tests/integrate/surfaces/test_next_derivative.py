"""Surfaces whose rate no side and no weight can change, such as the position of a mass at rest on
the kink of its spring. The next derivative of H decides, whatever has brought the motion there."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names


class Detent(jf.System):
    """x'' = load(t) − F sgn x − μ sgn x', H = (x, x'): a mass that a preload F and a friction μ
    hold at 0 until the load exceeds both. The load is r t + a sin t, and s more from t = 1 on."""

    preload: jax.Array
    friction: jax.Array
    ramp: jax.Array
    sine: jax.Array
    step: jax.Array
    clocks = (jf.Clock(10.0, 1.0),)

    def vector_field(self, t, x, side):
        load = self.ramp * t + self.sine * jnp.sin(t) + jnp.where(t < 1, 0.0, self.step)
        return jnp.stack([x[1], load - self.preload * side[0] - self.friction * side[1]])

    def switching(self, t, x):
        return x


def left(p):
    """Where the mass is at t = 2, p being the fields of `Detent`: two integrals of the load beyond
    its limit, from where it exceeds that on."""
    preload, friction, ramp, sine, step = p
    limit, end = preload + friction, 2.0
    by_ramp = jnp.where(ramp > 0, limit / jnp.where(ramp > 0, ramp, 1.0), 1.0)
    ratio = limit / jnp.where(sine > limit, sine, 2 * limit)
    start = jnp.where(sine > limit, jnp.arcsin(ratio), by_ramp)
    s, on = end - start, end - jnp.maximum(start, 1.0)
    v = ramp * (end**2 - start**2) / 2 + sine * (jnp.cos(start) - jnp.cos(end))
    v = v - limit * s + step * on
    x = (
        ramp * (end**3 - 3 * start**2 * end + 2 * start**3) / 6
        - limit * s**2 / 2
        + step * on**2 / 2
    )
    x = x + sine * (jnp.sin(start) - jnp.sin(end) + s * jnp.cos(start))
    stays = (ramp * end <= limit) & (sine <= limit) & (step <= limit)
    return jnp.where(stays, 0.0, jnp.stack([x, v]))


# F, μ, r, a, s
LOADS = np.array(
    [
        [1.0, 0.0, 0.8, 0.0, 0.0],
        [1.0, 0.3, 1.0, 0.0, 0.0],
        [0.7, 0.0, 0.0, 0.9, 0.0],
        [1.0, 0.3, 0.0, 1.5, 0.0],
        [1.0, 0.0, 0.0, 0.0, 1.6],
        [1.0, 0.3, 0.0, 0.0, 1.6],
        [1.0, 0.5, 0.0, 0.0, 1.2],  # held, by both together
        [1.0, 0.5, 0.0, 1.2, 0.0],
    ]
)


@eqx.filter_jit
def of_loads(sign):
    def end(p):
        system = Detent(p[0], p[1], *(sign * p[2:]))
        sol = jf.solve(system, jnp.zeros(2), 0.0, 2.0, 0.07, throw=False, max_events=16)
        return sol.x_final, (sol.result, sol.x_final)

    return jax.vmap(jax.jacfwd(end, has_aux=True))(jnp.asarray(LOADS))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.slow
def test_a_preloaded_mass_leaves_when_the_load_exceeds_what_holds_it(sign):
    slopes, (results, ends) = of_loads(jnp.asarray(sign))
    assert outcome_names(results).tolist() == ["successful"] * len(LOADS)
    exact = jax.vmap(left)(LOADS)
    by = jax.vmap(jax.jacfwd(left))(jnp.asarray(LOADS))
    np.testing.assert_allclose(ends, sign * exact, rtol=0, atol=1e-12)
    np.testing.assert_allclose(slopes, sign * by, rtol=0, atol=1e-10)


class Bent(jf.System):
    """x'' = 1 − k(x), with kinks of k at 0 and at 1, between slopes of 0, 1 and 4. At t = 1 a tick
    puts the mass to rest at 0. A third surface is a wall at −2, of restitution ½."""

    clocks = (jf.Clock(10.0, 1.0),)
    slides: bool = eqx.field(static=True, default=True)
    walled: bool = eqx.field(static=True, default=False)

    def vector_field(self, t, x, side):
        p = 0.5 * (1 + side)
        return jnp.stack([x[1], 1 - p[0] * x[0] - 3 * p[1] * (x[0] - 1)])

    def switching(self, t, x):
        kinks = [x[0], x[0] - 1]
        return jnp.stack([*kinks, x[0] + 2] if self.walled else kinks)

    def tick(self, t, x, clock):
        return 0 * x


class Walled(Bent):
    def reset(self, t, x, surface):
        return jnp.where(surface == 2, x.at[1].multiply(-0.5), x)


@pytest.mark.parametrize("slides", [True, False])
@pytest.mark.parametrize("kind", [Bent, pytest.param(Walled, marks=pytest.mark.release)])
@pytest.mark.slow
def test_a_mass_at_rest_on_the_kink_of_its_spring_moves_on(kind, slides):
    system = kind(slides=slides, walled=kind is Walled)
    start = jf.solve(system, jnp.zeros(2), 1.0, 2.0, 0.07)
    put = jf.solve(system, jnp.array([0.3, 0.2]), 0.0, 2.0, 0.07)
    exact = [1 - np.cos(1), np.sin(1)]
    np.testing.assert_allclose(start.x_final, exact, rtol=0, atol=1e-12)
    np.testing.assert_allclose(put.x_final, exact, rtol=0, atol=1e-12)


class Switched(jf.System):
    """The force 1 comes on at t = 1, on a surface of its own. H = (x, t − 1)."""

    def vector_field(self, t, x, side):
        k = jnp.where(side[0] > 0, 4.0, 1.0)
        return jnp.stack([x[1], 0.5 * (1 + side[1]) - k * x[0]])

    def switching(self, t, x):
        return jnp.stack([x[0], t - 1])


def test_a_force_that_another_surface_switches_on():
    sol = jf.solve(Switched(), jnp.zeros(2), 0.0, 2.0, 0.07)
    np.testing.assert_allclose(sol.x_final, [(1 - np.cos(2)) / 4, np.sin(2) / 2], atol=1e-12)


class Broken(jf.System):
    """x'' = 2 − Σ_k c_k max(x − b_k, 0), kinks at b = −1, 0, 1, 2."""

    def vector_field(self, t, x, side):
        bends = jnp.array([0.5, 1.0, 1.0, 1.0]) * 0.5 * (1 + side) * (x[0] - self.places)
        return jnp.stack([x[1], 2 - jnp.sum(bends)])

    @property
    def places(self):
        return jnp.array([-1.0, 0.0, 1.0, 2.0])

    def switching(self, t, x):
        return x[0] - self.places


@pytest.mark.slow
def test_a_start_on_one_of_many_kinks():
    sol = jf.solve(Broken(), jnp.zeros(2), 0.0, 0.7, 0.07)
    w = np.sqrt(1.5)  # 2 − ½ (x + 1) − x: about x = 1
    exact = [1 - np.cos(0.7 * w), w * np.sin(0.7 * w)]
    np.testing.assert_allclose(sol.x_final, exact, rtol=0, atol=1e-12)


class Rocking(jf.System):
    """A slender block on ground that is shaken, θ'' = 4 (θ − 0.2 sgn θ − a(t)), whose impacts take
    a tenth of its velocity: H = (θ, θ'). Up to the clock's tick at ½ it stands still."""

    shake: jax.Array
    clocks = (jf.Clock(10.0, 0.5),)

    def vector_field(self, t, x, side):
        push = jnp.where(t < 0.5, 0.0, self.shake)
        return jnp.stack([x[1], 4 * (x[0] - 0.2 * side[0] - push)])

    def switching(self, t, x):
        return x

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, x.at[1].multiply(0.9), x)


@eqx.filter_jit
@eqx.filter_vmap
def rocked(shake):
    sol = jf.solve(Rocking(shake), jnp.zeros(2), 0.0, 1.0, 0.07, throw=False)
    return sol.result, sol.x_final


@pytest.mark.release
def test_a_block_lifts_where_the_ground_is_shaken_hard_enough():
    shakes = np.array([0.1, 0.3, -0.3, 0.25])
    results, found = rocked(jnp.asarray(shakes))
    assert outcome_names(results).tolist() == ["successful"] * 4
    # From rest, to the side away from the push: θ = c (1 − cosh 2s), c = a − 0.2 sgn a.
    excess = np.sign(shakes) * np.maximum(abs(shakes) - 0.2, 0)
    exact = excess[:, None] * np.array([1 - np.cosh(1.0), -2 * np.sinh(1.0)])
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-13)
