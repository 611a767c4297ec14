"""What is observed of a motion, against closed forms: energies, forces and weights."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.observe import asked_of
from tests.problems.systems import UnitBelt

EPS = np.finfo(float).eps
BALL = jf.systems.BouncingBall(g=1.0, restitution=0.5)


class Friction(eqx.Module):
    """The force of friction, and the side."""

    force: jax.Array

    def __call__(self, t, x, side):
        return jnp.stack([-self.force * side, side])


class Sampled(jf.System):
    """x' = k in the k-th tenth of a unit of time from 0.3 on."""

    tick: jax.Array

    def vector_field(self, t, x, side):
        return jnp.floor((t - 0.3) / self.tick)[None]

    @property
    def clocks(self):
        return (jf.Clock(self.tick, 0.3),)


def energy(t, x, side):
    return x[0] + 0.5 * x[1] ** 2


@pytest.mark.slow
def test_the_energy_of_a_ball_is_that_of_its_flights():
    """From 1/2 it meets the floor at 1 and 2; of the energy the restitution r leaves r² each time,
    and the run is given up on the way to 4 for want of room."""
    ts = jnp.array([0.5, 1.0, 1.5, 2.0, 2.2, 3.5])

    def seen(restitution, ts):
        ball = eqx.tree_at(lambda b: b.restitution, BALL, restitution)
        values = jf.solve(
            ball,
            jnp.array([0.5, 0.0]),
            0.0,
            4.0,
            0.3,
            stepper=jf.RK4(),
            saveat=diffrax.SaveAt(ts=ts),
            max_events=2,
            throw=False,
            observe=lambda t, x, side: jnp.stack([energy(t, x, side), t * x[0]]),
        ).observed
        return values, values

    slopes, found = jax.jacrev(seen, (0, 1), has_aux=True)(jnp.array(0.5), ts)
    np.testing.assert_allclose(found[:5, 0], [1 / 2, 1 / 8, 1 / 8, 1 / 32, 1 / 32], rtol=64 * EPS)
    np.testing.assert_allclose(slopes[0][:5, 0], [0, 1 / 2, 1 / 2, 1 / 4, 1 / 4], rtol=64 * EPS)
    # By the saving time: (t x)' = x + t v in the first two flights, with their ends.
    at, x, v = np.array([[0.5, 1.0, 1.5], [3 / 8, 0, 1 / 8], [-1 / 2, 1 / 2, 0]])
    np.testing.assert_allclose(found[:3, 1], at * x, rtol=0, atol=64 * EPS)
    by_time = slopes[1][jnp.arange(3), 1, jnp.arange(3)]
    np.testing.assert_allclose(by_time, x + at * v, rtol=0, atol=64 * EPS)
    assert np.isinf(found[5]).all() and not slopes[0][5].any() and not slopes[1][5].any()


@pytest.mark.release
def test_the_force_of_a_stick_is_that_of_the_spring():
    """It sticks from the start until the spring, x = t - 1/2, is as strong as friction, at
    t = F + 1/2, and slips. On the stick the side is a weight, by which it is told."""
    run = dict(stepper=jf.RK4(), max_steps=64, max_events=4)
    run |= dict(saveat=diffrax.SaveAt(ts=jnp.array([0.25, 1.0, 2.0])))

    def seen(force):
        adjoint, x0 = diffrax.RecursiveCheckpointAdjoint(), jnp.array([-0.5, 1.0])
        options = run | dict(adjoint=adjoint, observe=Friction(force))
        values = jf.solve(UnitBelt(force), x0, 0.0, 2.0, 0.2, **options).observed
        return values, values

    slopes, found = jax.jacrev(seen, has_aux=True)(jnp.array(1.25))
    forces, sides = found.T
    np.testing.assert_allclose(forces, [-0.25, 0.5, 1.25], rtol=64 * EPS)
    np.testing.assert_allclose(sides, [0.2, -0.4, -1.0], rtol=64 * EPS)
    assert (abs(sides) < 1).tolist() == [True, True, False]
    # By F: a force on the stick does not depend on it, its part of F does.
    exact = [[0, -0.2 / 1.25], [0, 0.4 / 1.25], [1, 0]]
    np.testing.assert_allclose(slopes, exact, rtol=0, atol=64 * EPS)


def test_a_sampled_signal_is_observed_just_after_its_tick():
    """In floating point the tick at 0.3 + 4/10 has the quotient 3.9999999999999996."""
    tick, number = jnp.array(0.1), np.arange(8)
    sol = jf.solve(
        Sampled(tick),
        jnp.zeros(1),
        0.25,
        1.25,
        0.25,
        stepper=jf.RK4(),
        saveat=diffrax.SaveAt(ts=0.3 + 0.1 * number),
        observe=lambda t, x, side: jnp.floor((t - 0.3) / tick),
    )
    np.testing.assert_array_equal(sol.observed, number)
    assert np.floor((np.asarray(sol.ts) - 0.3) / 0.1).tolist() != number.tolist()


class Wrapped(jf.System):
    """x' = 1, and a tick takes 1 off x at each whole time."""

    slope: jax.Array
    clocks = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        return self.slope + 0 * x

    def tick(self, t, x, clock):
        return x - self.slope


def test_saved_steps_are_observed_on_their_side_of_a_tick():
    """The error of x against a ramp that restarts at each tick is zero on both sides."""
    sol = jf.solve(
        Wrapped(jnp.array(1.0)),
        jnp.zeros(1),
        0.0,
        3.5,
        0.25,
        stepper=jf.RK4(),
        saveat=diffrax.SaveAt(steps=True),
        observe=lambda t, x, side: x[0] - jnp.mod(t, 1.0),
    )
    seen = np.asarray(sol.observed)[: sol.stats["num_saved"]]
    assert seen.size > 14
    # Functions are evaluated inside of the interval between two ticks by the rounding of times.
    np.testing.assert_allclose(seen, 0, rtol=0, atol=64 * EPS)


def mode_and_place(t, x, mode):
    return jnp.stack([mode, x[0]])


@pytest.mark.slow
def test_the_mode_is_the_one_just_after_a_contact():
    """At the saved steps, among which are its contacts, and wherever dense output is asked for: on
    the stick until t = 7/4, and from then on it slips."""
    belt, x0, run = UnitBelt(jnp.array(1.25)), jnp.array([-0.5, 1.0]), dict(stepper=jf.RK4())
    saveat = diffrax.SaveAt(t0=True, steps=True)
    sol = jf.solve(belt, x0, 0.0, 2.0, 0.2, saveat=saveat, observe=mode_and_place, **run)
    reached = np.isfinite(sol.ts)
    assert 1.75 in np.round(sol.ts, 14)
    np.testing.assert_array_equal(sol.observed[reached, 0], sol.modes[reached, 0])
    np.testing.assert_array_equal(sol.observed[reached, 1], sol.xs[reached, 0])
    dense = jf.solve(belt, x0, 0.0, 2.0, 0.2, saveat=diffrax.SaveAt(dense=True), **run)
    slip = float(dense.events.ts[0])
    ts = jnp.array([[0.0, 0.7], [slip - 1e-9, slip], [2.0, 2.5]])
    seen = dense.evaluate(ts, observe=mode_and_place)
    np.testing.assert_array_equal(seen[..., 0], [[0, 0], [0, -1], [-1, np.nan]])
    np.testing.assert_array_equal(seen[..., 1], dense.evaluate(ts)[..., 0])
    side = dense.evaluate(0.7, observe=lambda t, x, side: side)
    np.testing.assert_allclose(side, -0.2 / 1.25, rtol=16 * EPS)


class Pressed(jf.System):
    """A ball that rests on a floor and rubs on it, pushed by t."""

    mu: jax.Array

    def vector_field(self, t, x, side, reaction):
        friction = -self.mu * reaction[0] * side[1]
        return jnp.stack([x[1], t + friction, x[3], reaction[0] - 1])

    def switching(self, t, x):
        return jnp.stack([x[2], x[1]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, x.at[3].multiply(0.0), x)


@pytest.mark.release
def test_side_reaction_and_mode_are_asked_for_by_name():
    """In any order, on a slide beside a rest, averaged: it slips at t = μ. The side of the slide is
    its weight, t/μ."""

    def all_of(t, x, mode, reaction, side):
        return jnp.concatenate([mode, reaction, side])

    average = jf.average(Pressed(jnp.array(0.5)), all_of, jnp.zeros(4), 0.0, 1.0, 0.1)
    np.testing.assert_allclose(average.value, [2, 0.5, 1, 0, 1, 0.75], rtol=0, atol=64 * EPS)


@pytest.mark.parametrize(
    "function, asked",
    [
        (lambda t, x: x, ()),
        (lambda t, x, s: s, ("side",)),
        (lambda t, x, k=3: k, ()),
        (lambda t, x, mode: mode, ("mode",)),
        (lambda t, x, reaction, side: side, ("reaction", "side")),
        (lambda *given: given, ()),
        (jf.bound, ()),
        (max, ("side",)),
    ],
)
def test_what_is_asked_for_is_said_by_the_names_of_arguments(function, asked):
    assert asked_of(function) == asked


@pytest.mark.parametrize(
    "observe, saveat, message",
    [
        (3, diffrax.SaveAt(t1=True), "`observe` must be a callable of .t, x, side., got 3"),
        (lambda t, x, side: None, diffrax.SaveAt(t1=True), "`observe` must return an array"),
        (energy, diffrax.SaveAt(dense=True), "`observe` must be None with a `saveat` of dense"),
    ],
)
def test_what_cannot_be_observed_is_refused_by_name(observe, saveat, message):
    with pytest.raises(ValueError, match=message):
        jf.solve(BALL, jnp.ones(2), 0.0, 1.0, 0.1, saveat=saveat, observe=observe)
