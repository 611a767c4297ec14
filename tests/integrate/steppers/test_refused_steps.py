"""Steps that mend themselves: explosions up to a threshold, walls of stiff springs, stiff relays,
fields that jump or have no derivative. What is successful is right, and what is not is told.
"""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxfil as jf
from tests.oracles.stiff_systems import DampedRelay, SoftFloor
from tests.results import outcome_names

STEPPERS = [diffrax.Dopri8(), diffrax.Tsit5(), jf.RK4(), jf.Rodas5P()]
# Twice the error that a step of a hundredth leaves in a contact, by the order of the method.
ALLOWED = {"Dopri8": 1e-3, "Tsit5": 2e-3, "RK4": 5e-2, "Rodas5P": 2e-2}


def name(stepper):
    return type(stepper).__name__


class Spiking(jf.System):
    """x' = 1 + x² up to a threshold and back to −1: x = tan t between them, a neuron's spikes."""

    threshold: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return 1 + x**2

    def switching(self, t, x):
        return self.threshold - x[0]

    def reset(self, t, x, surface):
        return -jnp.ones_like(x)


THRESHOLDS, DTS = np.array([10.0, 1e3, 1e9]), np.array([0.5, 0.11, 0.02])


@pytest.mark.slow
@pytest.mark.parametrize("stepper", STEPPERS, ids=name)
def test_an_explosion_is_followed_to_its_threshold(stepper):
    @jax.jit
    @jax.vmap
    def run(threshold, dt):
        options = dict(stepper=stepper, compact=True, max_events=8, throw=False)
        sol = jf.solve(Spiking(threshold), jnp.zeros(1), 0.0, 5.5, dt, **options)
        return sol.result, sol.events.ts, sol.num_events

    lanes = np.meshgrid(THRESHOLDS, DTS, indexing="ij")
    results, ts, counts = run(*(jnp.asarray(v.ravel()) for v in lanes))
    assert set(outcome_names(results)) == {"successful"}
    np.testing.assert_array_equal(counts, 2)
    first = np.arctan(lanes[0].ravel())
    exact = np.stack([first, 2 * first + np.pi / 4], axis=1)
    np.testing.assert_allclose(ts[:, :2], exact, rtol=0, atol=ALLOWED[name(stepper)])


@pytest.mark.slow
def test_derivatives_through_halved_steps():
    def end(p):
        sol = jf.solve(Spiking(p[0]), p[1:], 0.0, 3.0, 0.1, compact=True, throw=False)
        return sol.x_final[0], sol.stats["num_halvings"]

    def exact(p):
        return jnp.tan(3.0 - (jnp.arctan(p[0]) - jnp.arctan(p[1])) - jnp.pi / 4)

    p = jnp.array([1e4, 0.2])
    got, halvings = jax.jit(jax.jacfwd(end, has_aux=True))(p)
    assert halvings > 0
    np.testing.assert_allclose(got, jax.jacfwd(exact)(p), rtol=1e-3, atol=1e-12)


def bounced(k, c, t1):
    """(y, y') at t1 from (1, 0): parabolas, and damped waves about −1/k."""
    t, speed = np.sqrt(2.0), np.sqrt(2.0)
    decay = 0.5 * c
    w = np.sqrt(k - decay**2)
    while True:
        # In the floor y + 1/k = e^(−dt) (cos wt /k + b sin wt), from y = 0, y' = −speed.
        b = (decay / k - speed) / w

        def inside(s, b=b):
            wave = np.cos(w * s) / k + b * np.sin(w * s)
            turn = -w * np.sin(w * s) / k + b * w * np.cos(w * s)
            return np.exp(-decay * s) * np.array([wave, turn - decay * wave]) - [1 / k, 0.0]

        out = brentq(lambda s: inside(s)[0], 0.5 * np.pi / w, 1.5 * np.pi / w, xtol=1e-15)
        if t + out > t1:
            return inside(t1 - t)
        t, speed = t + out, inside(out)[1]
        if t + 2 * speed > t1:
            return np.array([speed * (t1 - t) - 0.5 * (t1 - t) ** 2, speed - (t1 - t)])
        t += 2 * speed


@pytest.mark.slow
@pytest.mark.parametrize("stepper", STEPPERS, ids=name)
def test_a_stiff_spring_throws_back(stepper):
    """Contacts down to 3e-5 long, in steps of a twentieth and a fifth."""
    ks, dts = np.meshgrid(10.0 ** np.arange(5, 11), [0.05, 0.2], indexing="ij")
    cs = 2 * 0.0708 * np.sqrt(ks)

    @jax.jit
    @jax.vmap
    def run(k, c, dt):
        options = dict(stepper=stepper, compact=True, max_events=None, throw=False)
        sol = jf.solve(SoftFloor(k, c), jnp.array([1.0, 0.0]), 0.0, 6.0, dt, **options)
        return sol.result, sol.x_final

    results, ends = run(*(jnp.asarray(v.ravel()) for v in (ks, cs, dts)))
    assert set(outcome_names(results)) == {"successful"}
    exact = [bounced(k, c, 6.0) for k, c in zip(ks.ravel(), cs.ravel(), strict=True)]
    np.testing.assert_allclose(ends, exact, rtol=0, atol=ALLOWED[name(stepper)])


@pytest.mark.slow
@pytest.mark.parametrize("stepper", STEPPERS, ids=name)
def test_nothing_unstable_is_successful(stepper):
    """Beyond the stability of explicit steps by up to 1e7; the implicit ones are the reference."""
    ds, dts = np.meshgrid(10.0 ** np.arange(3, 8.3, 0.75), [0.02, 0.08, 0.32], indexing="ij")

    def runs(stepper, dts):
        @jax.jit
        @jax.vmap
        def run(d, dt):
            options = dict(stepper=stepper, compact=True, max_events=None, throw=False)
            x0 = jnp.array([0.5, 2.0])
            # What takes longer is told too.
            sol = jf.solve(DampedRelay(d, 0 * d), x0, 0.0, 4.0, dt, max_steps=20_000, **options)
            return sol.result, sol.x_final

        return run(jnp.asarray(ds.ravel()), jnp.asarray(dts.ravel()))

    _, exact = runs(jf.Rodas5P(), np.full_like(dts, 0.01))
    results, ends = runs(stepper, dts)
    good = outcome_names(results) == "successful"
    assert good.any() and set(outcome_names(results)[~good]) <= {
        "step_too_long",
        "max_steps_reached",
    }
    assert good.all() or name(stepper) != "Rodas5P"
    np.testing.assert_allclose(ends[good], exact[good], rtol=0, atol=ALLOWED[name(stepper)])


def test_what_is_damped_at_once_is_known_to_its_rounding():
    """Short steps up to where the damped velocity, 1e-8 and less, goes through zero."""

    @jax.jit
    @jax.vmap
    def run(d):
        options = dict(stepper=jf.Rodas5P(), compact=True, max_events=4, throw=False)
        return jf.solve(DampedRelay(d, 0 * d), jnp.array([0.5, 2.0]), 0.0, 1.3, 1e-3, **options)

    ds = 10.0 ** np.array([7.0, 7.5, 8.0])
    sol = run(jnp.asarray(ds))
    assert set(outcome_names(sol.result)) == {"successful"}
    # It comes to rest where 2 cos 1.3t = 0.4 + x, x = 0.5 + 2/d.
    stops = np.arccos(0.45 + 1 / ds) / 1.3
    np.testing.assert_allclose(sol.events.ts[:, 0], stops, rtol=0, atol=1e-6)
    assert (sol.stats["num_halvings"] < 64).all()


class Step(jf.System):
    """x' = 1 from a time on that no clock tells of."""

    at: jax.Array

    def vector_field(self, t, x, side):
        return jnp.where(t < self.at, 0.0, 1.0) * jnp.ones_like(x)

    def switching(self, t, x):
        return x[:0]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("stepper", [diffrax.Dopri8(), jf.Rodas5P()], ids=name)
def test_a_jump_at_an_unknown_time_is_closed_in_on(stepper, dtype):
    at = jnp.asarray([0.43, 1.03, 1.97], dtype)

    def end(at):
        sol = jf.solve(Step(at), jnp.zeros(1, dtype), 0.0, 2.0, 0.1, stepper=stepper, throw=False)
        return sol.result, sol.x_final[0]

    results, ends = jax.jit(jax.vmap(end))(at)
    assert set(outcome_names(results)) == {"successful"}
    np.testing.assert_allclose(ends, 2.0 - at, rtol=0, atol=256 * np.finfo(dtype).eps)


class Exploding(jf.System):
    """x' = x²: from 1 it is infinite at t = 1, and no threshold is before that."""

    def vector_field(self, t, x, side):
        return x**2

    def switching(self, t, x):
        return x[:0]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("stepper", STEPPERS, ids=name)
def test_an_explosion_without_end_is_told(stepper, dtype):
    sol = jf.solve(Exploding(), jnp.ones(1, dtype), 0.0, 2.0, 0.1, stepper=stepper, throw=False)
    assert sol.result in (jf.RESULTS.nonfinite, jf.RESULTS.step_too_long)
    assert abs(sol.t_final - 1) < ALLOWED[name(stepper)]
    assert sol.stats["num_iterations"] < 2000


class Undeclared(jf.System):
    """A block that dry friction stops, and no surface that says so."""

    kind: str = eqx.field(static=True, default="sign")

    def vector_field(self, t, x, side):
        sign = jnp.sign(x[1]) if self.kind == "sign" else jnp.where(x[1] > 0, 1.0, -1.0)
        return jnp.stack([x[1], -x[0] - 0.5 * sign])

    def switching(self, t, x):
        return jnp.zeros(0)


@pytest.mark.parametrize("kind", ["sign", "where"])
def test_a_jump_that_the_motion_goes_to_and_fro_across_is_named(kind):
    with pytest.raises(eqx.EquinoxRuntimeError, match=f"t = 3.1.* jumps by `{kind}` of the state"):
        jf.solve(Undeclared(kind), jnp.array([1.2, 0.0]), 0.0, 20.0, 0.1)


class Tank(jf.System):
    """h' = −√h: from 1 it is empty at t = 2."""

    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return -jnp.sqrt(jnp.maximum(x, 0.0))

    def switching(self, t, x):
        return x[0] + 1.0


@pytest.mark.slow
@pytest.mark.parametrize("stepper", STEPPERS[:3], ids=name)
def test_a_tank_runs_empty(stepper):
    @jax.jit
    @jax.vmap
    def end(dt):
        sol = jf.solve(Tank(), jnp.ones(1), 0.0, 3.0, dt, stepper=stepper, throw=False)
        return sol.result, sol.x_final[0]

    results, ends = end(jnp.array([0.3, 0.1, 0.03]))
    assert set(outcome_names(results)) == {"successful"}
    # The last step but one is from no more than its length squared.
    np.testing.assert_allclose(ends, 0.0, rtol=0, atol=ALLOWED[name(stepper)])


def test_errors_of_halved_steps_are_estimated():
    """The run at half the step has other lengths where both are halved."""
    k = jnp.array([1e6, 1e8])

    @jax.jit
    @jax.vmap
    def run(k):
        system, x0 = SoftFloor(k, 0.1416 * jnp.sqrt(k)), jnp.array([1.0, 0.0])
        options = dict(compact=True, throw=False, estimate_error=True)
        return jf.solve(system, x0, 0.0, 6.0, 0.1, stepper=diffrax.Tsit5(), **options)

    sol = run(k)
    exact = np.array([bounced(float(v), 0.1416 * np.sqrt(v), 6.0) for v in k])
    error = np.abs(sol.x_final - exact).max(axis=1)
    assert (sol.stats["num_halvings"] > 0).all()
    estimated = np.asarray(sol.errors).max(axis=(1, 2))
    assert (error < 3 * estimated).all() and (estimated < 30 * error).all()


def test_a_diagram_counts_the_halved_steps_of_its_lanes():
    class Forced(DampedRelay):
        period: ClassVar[float] = 2 * np.pi / 1.3

    ds = jnp.array([0.0, 1e3])
    options = dict(transient=2, samples=2, progress=False)
    x0 = jnp.array([0.5, 2.0])
    d = jf.bifurcation_diagram(Forced(jnp.zeros(()), jnp.zeros(())), "damping", ds, x0, **options)
    assert d.successful.all()
    assert d.halvings[0] == 0 and d.halvings[1] > 0
    assert f"steps halved in 1 lane, {d.halvings[1]} times at most" in repr(d)


@pytest.mark.slow
def test_lanes_of_a_batch_halve_what_they_halve_alone():
    """Free steps and judged ones count alike towards what is watched."""
    belt, x0 = jf.systems.BeltFriction(), jnp.array([0.3, 0.1])
    omegas = np.linspace(3, 14, 66)
    run = dict(transient=10, samples=5, steps=16, stepper=diffrax.Tsit5(), progress=False)
    all_ = jf.bifurcation_diagram(belt, "omega", omegas, x0, compact=False, **run)
    few = jf.bifurcation_diagram(belt, "omega", omegas[1::13], x0, compact=False, **run)
    assert (all_.halvings > 0).any() and (all_.halvings == 0).any()
    np.testing.assert_array_equal(few.halvings, all_.halvings[1::13])
    np.testing.assert_array_equal(few.xs, all_.xs[1::13])
