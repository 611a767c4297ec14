"""Orbits and equilibria of systems with a component of the state that only events change.

While no event changes it, any value of it closes, and that of the guess is kept.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names


class Driven(jf.System):
    """x' = A cos t − (1 + q) x in one of several programs q."""

    a: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([self.a * jnp.cos(t) - (1 + x[1]) * x[0], 0.0])


@pytest.mark.parametrize("segments", [1, 3])
def test_a_batch_of_programs(segments):
    """x(0) = A (1 + q)/((1 + q)² + 1), which is in proportion to A, with the multiplier
    exp(−2π(1 + q))."""
    guesses = jnp.array([[0.1, 0.0], [0.9, 1.0], [0.0, -0.9]])

    @jax.jit
    @jax.vmap
    def found(guess):
        def x0(a):
            one = jf.periodic_orbit(Driven(a), guess, segments=segments, throw=False)
            return one.x0, (one.x0, one.multipliers, one.stable)

        return jax.jacfwd(x0, has_aux=True)(jnp.array(3.0))

    slopes, (x0, multipliers, stable) = found(guesses)
    rate = 1 + guesses[:, 1]
    assert_allclose(slopes, np.stack([rate / (rate**2 + 1), 0 * rate], axis=1), rtol=0, atol=1e-9)
    assert_allclose(x0[:, 0], 3 * slopes[:, 0], rtol=0, atol=1e-9)
    assert_array_equal(x0[:, 1], guesses[:, 1])
    exact = np.stack([np.exp(-2 * np.pi * rate), 1 + 0 * rate], axis=1)
    assert_allclose(np.sort(abs(multipliers), axis=1), exact, rtol=0, atol=1e-9)
    assert_array_equal(stable, True)


class Fuse(jf.System):
    """x'' + c x' + (1 + 3q) x = A cos t; a fuse q is blown where |x| reaches 1."""

    a: jax.Array
    c: jax.Array
    slides = False
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        force = self.a * jnp.cos(t) - self.c * x[1] - (1 + 3 * x[2]) * x[0]
        return jnp.stack([x[1], force, 0 * t])

    def switching(self, t, x):
        return jnp.stack([1 - x[0], 1 + x[0]])

    def reset(self, t, x, surface):
        return x.at[2].set(1.0)


FUSE = Fuse(jnp.array(0.1), jnp.array(0.2))


@pytest.mark.slow
def test_a_branch_with_a_fuse():
    """x = A/c sin t until the fuse blows."""
    orbit = jf.periodic_orbit(FUSE, jnp.array([0.05, 0.4, 0.0]))
    assert_allclose(orbit.x0, [0.0, 0.5, 0.0], rtol=0, atol=1e-9)
    branch = jf.continue_orbit(FUSE, "c", orbit, stop=0.3)
    assert_allclose(branch.orbits.x0[-1], [0.0, 1 / 3, 0.0], rtol=0, atol=1e-9)
    assert branch.stable.all() and not branch.points


class Counted(Fuse):
    """The same, with a count of crossings of 0 in place of the fuse."""

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return x.at[2].add(1e-3)


@pytest.mark.slow
def test_a_component_that_events_change_does_not_close():
    found = jf.periodic_orbit(Counted(FUSE.a, FUSE.c), jnp.array([0.0, 0.5, 0.0]), throw=False)
    assert outcome_names(found.result) == "newton_singular"


class Thermostat(jf.System):
    """x' = q − x, switched off at `high` and on at 0.2, with a second program r = 1 in which it
    is switched off later."""

    high: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1] - x[0], 0 * t, 0 * t])

    def switching(self, t, x):
        return jnp.stack([self.high + 0.1 * x[2] - x[0], x[0] - 0.2])

    def reset(self, t, x, surface):
        return x.at[1].set(jnp.where(surface == 0, 0.0, 1.0))


@pytest.mark.slow
def test_an_autonomous_orbit_keeps_its_program():
    for r in (0, 1):
        high = 0.5 + 0.1 * r
        period = np.log(0.8 / (1 - high)) + np.log(high / 0.2)
        start = jnp.array([0.3, 1.0, r])
        found = jf.periodic_orbit(Thermostat(jnp.array(0.5)), start, period=1.02 * period)
        assert_allclose(found.period, period, rtol=1e-10)
        assert_array_equal(found.x0[1:], [1, r])
        assert_allclose(np.sort(abs(found.multipliers)), [0, 1, 1], rtol=0, atol=1e-8)
        assert found.stable


@pytest.mark.slow
def test_an_equilibrium_keeps_its_program():
    """Below the temperature of switching off, it rests at 0.4 q."""

    class Weak(Thermostat):
        def vector_field(self, t, x, side):
            return jnp.stack([self.high * x[1] - x[0], 0 * t, jnp.zeros_like(t)])

        def switching(self, t, x):
            return jnp.stack([1.0 - x[0], x[0] + 0.2])

    weak = Weak(jnp.array(0.4))
    for q in (1.0, 0.0):
        found = jf.equilibrium(weak, jnp.array([0.3, q, 1.0]))
        assert_allclose(found.x, [0.4 * q, q, 1.0], rtol=0, atol=1e-12)
        assert_allclose(found.eigenvalues, [0, 0, -1], rtol=0, atol=1e-12)
        assert found.stable
    guess = jnp.array([0.3, 1.0, 0.0])
    slope = jax.jacfwd(lambda high: jf.equilibrium(Weak(high), guess, throw=False).x)
    assert_allclose(slope(weak.high), [1, 0, 0], rtol=0, atol=1e-12)
    branch = jf.continue_equilibrium(weak, "high", jf.equilibrium(weak, guess), stop=0.8)
    assert_allclose(branch.equilibria.x[-1], [0.8, 1, 0], rtol=0, atol=1e-12)
    assert branch.equilibria.stable.all() and not branch.points


class Kept(jf.System):
    """x' = a + b x − x² + q, a fold at 4 (a + q) + b² = 0."""

    a: jax.Array
    b: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([self.a + self.b * x[0] - x[0] ** 2 + x[1], 0 * t])


def test_a_curve_of_folds_keeps_its_program():
    system, guess = Kept(jnp.array(1.0), jnp.array(2.0)), jnp.array([3.0, 0.5])
    branch = jf.continue_equilibrium(system, "a", jf.equilibrium(system, guess), stop=-3.0)
    (fold,) = branch.points
    assert fold.kind == "fold"
    curve = jf.continue_equilibrium_bifurcation(system, ("b", "a"), fold, stop=3.0)
    assert_allclose(curve.values[-1], [3.0, -2.75], rtol=0, atol=1e-9)
    assert_array_equal(curve.xs[:, 1], 0.5)


class SquareWave(jf.System):
    """x' = u − x; u is turned at every half period, a latch that a period turns twice."""

    leak: jax.Array
    slides = False
    period = 2.0

    def vector_field(self, t, x, side):
        return jnp.stack([x[1] - self.leak * x[0], 0 * t])

    def switching(self, t, x):
        return jnp.sin(np.pi * (t - 0.25))

    def reset(self, t, x, surface):
        return x.at[1].multiply(-1.0)


@pytest.mark.parametrize("segments", [1, 2, 3])
@pytest.mark.slow
def test_a_latch_that_is_turned_back(segments):
    """x runs to u/a by exp(−a t) and turns at ±tanh(a/2)/a, which it has at t = 1/4."""

    def exact(a):
        return (1 + (jnp.tanh(a / 2) - 1) * jnp.exp(a / 4)) / a

    def x0(leak):
        found = jf.periodic_orbit(SquareWave(leak), jnp.array([0.1, 1.0]), segments=segments)
        return found.x0, found

    for leak in (jnp.array(1.0), jnp.array(2.0)):
        slope, orbit = jax.jacfwd(x0, has_aux=True)(leak)
        assert_allclose(orbit.x0, [exact(leak), 1.0], rtol=0, atol=1e-12)
        assert_allclose(slope, [jax.grad(exact)(leak), 0.0], rtol=0, atol=1e-11)
        multipliers = np.sort(abs(orbit.multipliers))
        assert_allclose(multipliers, [np.exp(-2 * leak), 1.0], rtol=0, atol=1e-12)
        assert orbit.stable


class Relay(jf.System):
    """1/(s + 1)³ with y = x₃ and a relay u = ±1 that turns where u y = ε."""

    eps: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[3] - x[0], x[0] - x[1], x[1] - x[2], 0 * t])

    def switching(self, t, x):
        return self.eps - x[3] * x[2]

    def reset(self, t, x, surface):
        return x.at[3].multiply(-1.0)


@pytest.mark.parametrize("segments", [1, 2])
@pytest.mark.slow
def test_a_relay_turned_twice_in_an_unknown_period(segments):
    """From the matrix exponential (K. J. Åström, Oscillations in systems with relay feedback,
    1995): period and multipliers of the cycle with ε = 1/10, which the start is near to."""
    guess = jnp.array([0.78, 0.46, 0.0, 1.0])
    orbit = jf.periodic_orbit(Relay(jnp.array(0.1)), guess, period=5.0, segments=segments)
    assert_allclose(orbit.period, 4.787671942045484, rtol=1e-11)
    multipliers = np.sort(abs(orbit.multipliers))
    exact = [2.2308025973671755e-05, 0.025927482018784406, 1, 1]
    assert_allclose(multipliers, exact, rtol=0, atol=1e-9)
    assert orbit.stable


class WithWall(Fuse):
    """x'' + c x' + (1 + 3q) x = A cos ωt before a wall at d, with a gear q that nothing turns."""

    wall: jax.Array
    omega: jax.Array

    def vector_field(self, t, x, side):
        force = self.a * jnp.cos(self.omega * t) - self.c * x[1] - (1 + 3 * x[2]) * x[0]
        return jnp.stack([x[1], force, 0 * t])

    def switching(self, t, x):
        return self.wall - x[0]

    def reset(self, t, x, surface):
        return x.at[1].multiply(-0.7)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


@pytest.mark.slow
def test_grazing_in_a_gear():
    """x = A/c sin t: the margin is d − A/c, and of (A, d) = (0.1, 1) with c = 0.2 the nearest point
    of the line A = c d is at d = 1.02/1.04."""
    system = WithWall(*map(jnp.asarray, (0.1, 0.2, 1.0, 1.0)))
    orbit = jf.periodic_orbit(system, jnp.array([0.05, 0.45, 0.0]))
    margin, by = jax.value_and_grad(lambda s: jf.grazing_margin(s, orbit))(system)
    assert_allclose([margin, by.a, by.c, by.wall], [0.5, -5.0, 2.5, 1.0], rtol=0, atol=1e-9)
    found = jf.find_bifurcation(system, "a", orbit, "grazing")
    assert_allclose(found.value, 0.2, rtol=0, atol=1e-10)
    # At the gear of the guess to the last bit, with the derivative by it in its column.
    assert_array_equal(found.orbit.x0[2], 0.0)
    at_grazing = jf.periodic_orbit(eqx.tree_at(lambda s: s.a, system, 0.2 - 1e-9), found.orbit.x0)
    ours, theirs = found.orbit.monodromy, at_grazing.monodromy
    assert_allclose(ours, theirs, rtol=0, atol=1e-7)
    nearest = jf.nearest_grazing(system, ("a", "wall"), orbit, metric=[1.0, 1.0])
    assert_allclose(nearest.distance, 0.1 / np.sqrt(1.04), rtol=0, atol=1e-9)
    curve = jf.continue_bifurcation(system, ("wall", "a"), found, stop=2.0)
    assert_allclose(curve.values[-1], [2.0, 0.4], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_curve_of_period_doublings_in_a_gear():
    """Of the orbit with an impact at d = 1/20, A = 1, c = 1/10: at ω = 2.558143."""
    system = WithWall(*map(jnp.asarray, (1.0, 0.1, 0.05, 2.3)))
    start = jf.periodic_orbit(system, jnp.zeros(3), transient=100)
    branch = jf.continue_orbit(system, "omega", start, stop=2.6)
    (doubled,) = branch.points
    assert doubled.kind == "period-doubling"
    assert_allclose(doubled.value, 2.558143, rtol=0, atol=1e-6)
    curve = jf.continue_bifurcation(system, ("omega", "wall"), doubled, stop=2.6, max_points=4)
    assert_allclose(curve.values[0], [doubled.value, 0.05], rtol=0, atol=1e-6)
    assert len(curve.values) > 1
