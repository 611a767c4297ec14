"""`estimate_error=True` is honest, of a solution and of a sweep: from a third of the true error to
thirty times it.

The true error is taken from numbers of other codes and from closed forms where a test says so, and
else from a run of order 8 at a step far below those that are judged.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from tests.problems import PROBLEMS
from tests.problems.values import SD_AT_5

DTS = np.asarray([0.4, 0.2, 0.1, 0.05, 0.025, 0.0125])
# Below this the truth itself is in doubt: thousands of fine steps, and contacts, gather rounding.
ROUNDING = 1e-12

# Those of constant fields are left out: a step of any length is exact there.
SCENES = {
    "sd": (jf.systems.SDOscillator(omega=0.7), [0.3, 0.1], 40.0),
    "sd smooth": (jf.systems.SDOscillator(omega=0.7, alpha=0.5), [0.3, 0.1], 20.0),
    "belt 1": (
        jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=2.44),
        [0.9, 3.18],
        20.0,
    ),
    "belt 2": (jf.systems.BeltFriction(omega=4.3), [0.1, 0.3], 20.0),
    "coulomb": (jf.systems.CoulombOscillator(), [3.0, 0.0], 9.0),
    "moving belt": (jf.systems.MovingBelt(), [1.0, 0.5], 20.0),
    "rotating": (jf.systems.RotatingOscillator(), [0.5, 0.1], 5.0),
    "slip-stick": (jf.systems.SlipStick(), [1.0, 0.0], 20.0),
    "den hartog": (jf.systems.DenHartog(), [1.0, 0.5], 30.0),
    "impacts": (jf.systems.ImpactOscillator(), [0.1, 0.0], 20.0),
    "fold": (jf.systems.VisibleFold(), [-1.0, 0.1], 2.0),
}


def over_steps(system, x0, t1, stepper, dts):
    """One run for each step, side by side."""

    def one(dt):
        return jf.solve(
            system,
            jnp.asarray(x0),
            0.0,
            t1,
            dt,
            stepper=stepper,
            max_events=None,
            throw=False,
            estimate_error=True,
        )

    return jax.jit(jax.vmap(one))(jnp.asarray(dts))


def assert_honest(estimate, error, size):
    unit = ROUNDING * max(1.0, size)
    assert np.any(error > unit)
    assert np.all(estimate >= np.where(error > unit, error / 3, 0)), estimate / error
    assert np.all(estimate <= 30 * np.maximum(error, unit)), estimate / error


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_honest_on_textbook_systems(name):
    system, x0, t1 = SCENES[name]
    sol = over_steps(system, x0, t1, diffrax.Dopri8(), [*DTS, 0.003])
    assert_honest_all(sol, truth=sol.x_final[-1])
    if name in ("sd", "belt 1"):
        rough = over_steps(system, x0, t1, diffrax.Bosh3(), DTS)
        assert_honest_all(rough, truth=sol.x_final[-1])


def assert_honest_all(sol, truth):
    done = np.asarray(sol.result == jf.RESULTS.successful)
    assert done[2:].all()
    error = np.max(abs(sol.x_final - truth), axis=-1)[done]
    estimate = np.max(sol.errors[:, 0], axis=-1)[done]
    assert_honest(estimate, error, np.max(abs(truth)))


@pytest.mark.slow
def test_honest_against_other_codes():
    # Pieces with located crossings, and the closed form of a Coulomb oscillator.
    p = PROBLEMS["sd"]
    truth = [SD_AT_5, p.end]
    for dt in (0.4, 0.25):
        sol = jf.solve(
            p.system,
            jnp.asarray(p.x0),
            0.0,
            p.t1,
            dt,
            saveat=diffrax.SaveAt(ts=jnp.asarray([5.0, 40.0])),
            estimate_error=True,
        )
        assert sol.errors.shape == (2, 2)
        assert_honest(sol.errors.max(1), np.max(abs(sol.xs - np.asarray(truth)), 1), 4.0)
    sol = jf.solve(
        jf.systems.CoulombOscillator(friction=0.4),
        jnp.asarray([3.0, 0.0]),
        0.0,
        4.0,
        0.5,
        stepper=diffrax.Tsit5(),
        estimate_error=True,
    )
    exact = [1.8 * np.cos(4.0) - 0.4, -1.8 * np.sin(4.0)]  # the second half turn, about −0.4
    assert_honest(sol.errors[0].max(), np.max(abs(sol.xs[0] - np.asarray(exact))), 2.6)


def test_component_by_component():
    # Two uncoupled decays of different size: each has an error of its own.
    def decay(t, x):
        return -jnp.asarray([1.0, 2.0]) * x

    system = jf.piecewise(decay, decay, lambda t, x: x[0] + 1e9)
    sol = jf.solve(
        system, jnp.asarray([1.0, 1e6]), 0.0, 1.0, 0.25, stepper=jf.RK4(), estimate_error=True
    )
    exact = np.exp([-1.0, -2.0]) * [1.0, 1e6]
    assert_allclose(sol.errors[0], abs(sol.xs[0] - exact), rtol=0.1)


def test_unknown_where_the_companion_fails():
    # x' = x²: at this coarse step the pole at t = 1 is passed over; at half of it, too, or not.
    # Whatever happens, nothing that failed is called small.
    def grow(t, x):
        return x**2

    system = jf.piecewise(grow, grow, lambda t, x: x[0] + 1e9)
    for dt in (1.5, 0.7):
        sol = jf.solve(system, jnp.asarray([1.0]), 0.0, 1.5, dt, throw=False, estimate_error=True)
        assert not sol.errors[0, 0] < 1


@pytest.mark.slow
def test_not_differentiated():
    def end(x0):
        sol = jf.solve(jf.systems.CoulombOscillator(), x0, 0.0, 5.0, 0.1, estimate_error=True)
        return sol.xs[-1], sol.errors[-1]

    plain, of_errors = jax.jacfwd(end)(jnp.asarray([3.0, 0.0]))
    assert_allclose(plain[0, 0], np.cos(5.0), rtol=0, atol=1e-12)
    assert np.all(of_errors == 0)


def test_card_and_refusal():
    system, x0 = jf.systems.CoulombOscillator(), jnp.asarray([3.0, 0.0])
    assert "error about" in repr(jf.solve(system, x0, 0.0, 5.0, 0.5, estimate_error=True))
    assert jf.solve(system, x0, 0.0, 5.0, 0.5).errors is None
    with pytest.raises(ValueError, match="`estimate_error` must be False"):
        jf.solve(system, x0, 0.0, 5.0, 0.5, saveat=diffrax.SaveAt(steps=True), estimate_error=True)


SWEEPS = {
    "sd": (jf.systems.SDOscillator(), [0.3, 0.1], [0.7, 0.9]),
    "belt 2": (jf.systems.BeltFriction(), [0.1, 0.3], [4.3, 4.6]),
}


def swept(name, **options):
    system, x0, values = SWEEPS[name]
    run = {"transient": 100, "samples": 10, "progress": False}
    return jf.bifurcation_diagram(system, "omega", values, jnp.asarray(x0), **run | options)


@pytest.mark.slow
@pytest.mark.parametrize("name", SWEEPS)
def test_honest_on_lanes_that_settle_and_of_the_attractors_size_on_chaotic_ones(name):
    truth = swept(name, steps=200).xs
    for steps in (16, 24):
        d = swept(name, steps=steps, estimate_error=True)
        np.testing.assert_array_equal(d.xs, swept(name, steps=steps).xs)
        assert d.errors.shape == (2, 2)
        error = np.max(abs(d.xs - truth), axis=1)
        assert_honest(d.errors[0], error[0], np.max(abs(truth[0])))
        size = np.ptp(truth[1], axis=0)
        assert np.all(error[1] > 0.1 * size), "its samples are those of another motion"
        assert np.all((0.1 * size < d.errors[1]) & (d.errors[1] < 10 * size))


@pytest.mark.parametrize(
    ("options", "ended"),
    [({"follow": "down"}, 1), ({"x0": np.eye(2)}, 1), ({"grid": True}, 6)],
    ids=["follow", "x0", "grid"],
)
def test_a_sweeps_errors_are_its_distance_from_one_at_half_the_step(options, ended):
    def run(steps, **estimate):
        run = {"transient": 2, "samples": 2, "progress": False, "stepper": jf.RK4()} | options
        grid, x0 = run.pop("grid", False), run.pop("x0", np.array([0.3, 0.1]))
        names = ("omega", "f0") if grid else "omega"
        values = ([0.7, 0.8, 0.9], [0.2, 0.25]) if grid else [0.7, np.nan]
        system = jf.systems.SDOscillator()
        return jf.bifurcation_diagram(system, names, values, x0, steps=steps, **run, **estimate)

    coarse, fine = run(20, estimate_error=True), run(40)
    assert fine.errors is None and "error" not in repr(fine)
    distance = np.max(abs(coarse.xs - fine.xs), axis=-2)
    np.testing.assert_array_equal(coarse.errors, distance)
    known = distance[coarse.successful].max(axis=-1)
    assert coarse.errors.shape == (*coarse.successful.shape, 2) and known.size == ended
    told = f"error about {np.median(known):.1e} in the median lane, {known.max():.1e} at most"
    assert told in repr(coarse)


class Driven(jf.System):
    """x' = cos ωt − x, which settles on (cos t + sin t)/2 for ω = 1."""

    omega: jnp.ndarray

    def vector_field(self, t, x, side):
        return jnp.cos(self.omega * t) - x

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def test_a_sweeps_errors_are_no_smaller_than_rounding_and_unknown_where_nothing_ends():
    run = {"transient": 20, "samples": 2, "steps": 60, "progress": False, "estimate_error": True}
    driven, x0 = Driven(jnp.asarray(1.0)), jnp.asarray([0.5])
    d = jf.bifurcation_diagram(driven, "omega", [1.0], x0, **run)
    assert np.max(abs(d.xs - 0.5)) <= 3 * d.errors[0, 0] < 1e-13
    assert d.errors[0, 0] > np.finfo(float).eps
    lost = jf.bifurcation_diagram(driven, "omega", [np.nan], x0, **run)
    assert np.isnan(lost.errors).all() and "error unknown" in repr(lost)


def test_the_largest_budget_of_steps_has_an_estimate_too():
    sol = jf.solve(
        jf.systems.SDOscillator(),
        jnp.array([0.3, 0.0]),
        0.0,
        1.0,
        0.1,
        max_steps=2**31 - 1,
        estimate_error=True,
    )
    assert np.isfinite(sol.errors).all()
