"""The hard cases again in float32, to 1e-4, from t0 = 0 and from t0 = 1000."""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from jaxfil.model.outcomes import outcome_names
from tests.problems import PROBLEMS, tagged
from tests.problems.systems import Affine, NeverSliding, affine
from tests.results import in_float32


class Phase(jf.System):
    """A clock that is put back to zero whenever it comes to 0.7."""

    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.ones_like(x)

    def switching(self, t, x):
        return 0.7 - x[0]

    def reset(self, t, x, surface):
        return x - 0.7


def single(name):
    """The system and start of a problem; those worked out by hand have leaves in float32 too."""
    p = PROBLEMS[name]
    return in_float32(p.system) if "hand" in p.tags.split() else p.system, p.x0


def run(system, x0, t0, span, dt):
    """A float32 run: the system's leaves may be of either precision."""
    x0 = jnp.asarray(x0, jnp.float32)
    sol = jf.solve(system, x0, t0, t0 + span, dt, max_events=64, throw=False)
    assert sol.xs.dtype == sol.ts.dtype == sol.events.ts.dtype == jnp.float32
    return sol


FLOAT32 = {name: PROBLEMS[name] for name in tagged("float32")}
FAILING = [name for name, p in FLOAT32.items() if p.outcome != "successful"]


@pytest.mark.slow
@pytest.mark.parametrize("t0", [0.0, 1000.0])
@pytest.mark.parametrize("name", [name for name in FLOAT32 if name not in FAILING])
def test_float32(name, t0):
    p = PROBLEMS[name]
    sol = run(*single(name), t0, p.t1, p.dt)
    assert sol.result == RESULTS.successful
    # Times near 1000 are themselves 6e-5 apart; contacts that accumulate are lost in them.
    if p.ts is not None and "zeno" not in p.tags.split():
        assert_array_equal(sol.events.kinds[: int(sol.num_events)], p.kinds)
        assert_allclose(
            sol.events.ts[: len(p.ts)] - t0, p.ts, rtol=0, atol=1e-4 if t0 == 0 else 2e-4
        )
    if p.end is not None:
        end = np.asarray(p.end)
        assert_allclose(
            sol.xs[-1], end, rtol=0, atol=1e-4 * max(1, np.abs(end).max()) * (1 + (t0 > 0))
        )


@pytest.mark.parametrize("t0", [0.0, 1000.0])
@pytest.mark.parametrize("name", FAILING)
@pytest.mark.slow
def test_float32_outcomes(name, t0):
    p = PROBLEMS[name]
    sol = run(*single(name), t0, 10.0, p.dt)
    assert outcome_names(sol.result) == p.outcome
    resolution = p.dt if p.outcome == "nonfinite" else 1e-4 * (1 + t0)
    assert_allclose(sol.t_final - t0, p.ends_at, rtol=1e-4, atol=resolution)


def test_float32_slip_shorter_than_a_step():
    p = PROBLEMS["belt 1.4"]
    sol = run(p.system, p.x0, 0.0, p.t1, 0.1)
    assert_array_equal(sol.events.kinds[:4], p.kinds)
    assert_allclose(sol.events.ts[:4], p.ts, rtol=0, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "kind"), [(jnp.float32, NeverSliding), (jnp.float64, Affine)])
def test_contact_behind_a_grid_point_by_less_than_times_are_told_apart(dtype, kind):
    # All numbers but the time of the contact, 64 (1 + 4 eps), are exact in both precisions.
    t, eps = 64.0, float(jnp.finfo(dtype).eps)
    system = affine((0, -1), (0, -2), kind=kind)
    system = in_float32(system) if dtype == jnp.float32 else system
    x0 = jnp.asarray((0, t * (1 + 4 * eps)), dtype)
    sol = jf.solve(system, x0, 0.0, t + 1, 0.25, max_events=64, throw=False)
    assert sol.result == RESULTS.successful
    assert_array_equal(sol.events.kinds[:2], [EventKind.crossing, EventKind.none])
    assert_allclose(sol.events.ts[0], t * (1 + 4 * eps), rtol=eps)
    assert_allclose(sol.xs[-1, 1], -2 * (1 - 4 * eps * t), rtol=4 * eps)


def test_float32_contacts_long_after_the_start_shift_nothing():
    # Times near 2000 are 1.2e-4 apart, phases 6e-8.
    sol = jf.solve(Phase(), jnp.asarray([0.0], jnp.float32), 0.0, 2000.5, 0.3, max_events=None)
    assert_allclose(sol.xs[-1], 2000.5 % float(np.float32(0.7)), rtol=0, atol=2e-5)


@pytest.mark.slow
def test_float32_lanes_of_a_long_sweep():
    # The orbit at 0.7. What rounding of times sets is eps |t x'|.
    sd, x0 = jf.systems.SDOscillator(), np.array(PROBLEMS["symmetric sd"].x0)
    omegas = np.append(0.7, np.linspace(0.6, 1.3, 63))
    d = jf.bifurcation_diagram(
        sd, "omega", omegas, np.float32(x0), transient=200, samples=100, steps=32, progress=False
    )
    assert d.xs.dtype == np.float32 and d.successful.all()
    ts = 2 * np.pi / 0.7 * np.arange(201, 301)
    rate = np.asarray(sd.vector_field(0.0, x0, 1.0))
    assert np.all(abs(d.xs[0] - x0) <= 1.5 * np.finfo(np.float32).eps * np.outer(ts, abs(rate)))


@pytest.mark.slow
@pytest.mark.parametrize("t0", [0.0, 1000.0])
def test_float32_derivative_of_the_coulomb_oscillator(t0):
    def end(x0, friction, adjoint):
        system = jf.systems.CoulombOscillator(friction=friction)
        sol = jf.solve(system, x0, t0, t0 + 20, 0.1, adjoint=adjoint, max_steps=256)
        return sol.xs[-1, 0]

    args = jnp.asarray([3.0, 0.0], jnp.float32), jnp.asarray(0.4, jnp.float32)
    for adjoint in (diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()):
        take = jax.jacfwd if isinstance(adjoint, diffrax.ForwardMode) else jax.jacrev
        d_x0, d_friction = take(end, (0, 1))(*args, adjoint)
        assert_allclose(d_x0, [1, 0], rtol=0, atol=1e-3)
        assert_allclose(d_friction, -8, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1e-1, 1e-2])
def test_float32_derivative_near_grazing(gap):
    # t* = v - √(v² - 2h) for a throw against gravity 1.
    level = jnp.asarray((1 - gap) / 2, jnp.float32)
    system = jf.piecewise(
        lambda t, x: jnp.stack([x[1], -jnp.ones_like(t)]),
        lambda t, x: jnp.stack([x[1], -jnp.ones_like(t)]),
        lambda t, x: x[0] - level,
    )

    def time(v):
        return jf.solve(system, jnp.stack([0 * v, v]), 0.0, 3.0, 0.3).events.ts[0]

    d_t = jax.jacfwd(time)(jnp.asarray(1.0, jnp.float32))
    assert_allclose(d_t, 1 - 1 / np.sqrt(1 - 2 * float(level)), rtol=1e-4 / gap)


class Pile(jf.System):
    """Four blocks that lie on each other on a floor, with e = 0."""

    g: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.concatenate([x[4:], -self.g * jnp.ones(4, x.dtype)])

    def switching(self, t, x):
        return jnp.diff(x[:4], prepend=jnp.full(1, -1, x.dtype)) - 1

    def reset(self, t, x, surface):
        v, below = x[4:], jnp.arange(4, dtype=surface.dtype) == surface - 1
        # The floor is at rest.
        common = jnp.sum(jnp.where(below, 0.5 * (v + jnp.roll(v, -1)), jnp.zeros_like(v)))
        hit = jnp.roll(below, 1).at[0].set(surface == 0) | below
        return jnp.concatenate([x[:4], jnp.where(hit, common, v)])


@pytest.mark.slow
def test_float32_pile_of_four_stays_in_any_units():
    """In SI units, and with the time in milliseconds."""
    for g in (9.81, 9.81e-6):
        time = (1 / g) ** 0.5
        x0 = jnp.array([0, 1, 2, 3, 0, 0, 0, 0], jnp.float32)
        sol = jf.solve(Pile(jnp.float32(g)), x0, 0.0, time, 0.05 * time, compact=True)
        assert sol.mode_final.tolist() == [2, 2, 2, 2]
        assert_allclose(sol.x_final, x0, rtol=0, atol=1e-5 * min(1, g * time))
