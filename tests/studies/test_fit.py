"""Fits to data, against SciPy's `least_squares` over a motion in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names
from jaxfil.studies.fit import _inverse as inverse
from tests.oracles.block import GUESSES, NAMES, TRUE, TS, X0, Block, data, motion, seen, stepped


@pytest.fixture(scope="module")
def found():
    given = {"observe": seen, "guesses": GUESSES, "max_steps": 30}
    return jf.fit(Block(0.1, 0.8), NAMES, TS, data(), jnp.array(X0), 0.05, **given)


@pytest.mark.release
def test_the_best_fit_is_that_of_scipy(found):
    exact = scipy.optimize.least_squares(
        lambda values: motion(values) - data(), TRUE, x_scale=TRUE, xtol=1e-15, ftol=1e-15
    )
    np.testing.assert_allclose(found.values, exact.x, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.residuals, exact.fun, rtol=0, atol=1e-8)
    h = 1e-6 * np.eye(2)
    slopes = np.stack([(motion(exact.x + e) - motion(exact.x - e)) / 2e-6 for e in h], axis=1)
    variance = exact.fun @ exact.fun / (TS.size - 2)
    covariance = variance * np.linalg.inv(slopes.T @ slopes)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-5)
    assert np.all(abs(found.values - TRUE) < 4 * found.errors)


def test_the_motion_in_closed_form_is_that_of_an_integrator():
    for values in (TRUE, *GUESSES):
        np.testing.assert_allclose(stepped(values), motion(values), rtol=0, atol=1e-6)


@pytest.mark.release
def test_contacts_may_appear_and_go_away_between_steps(found):
    counts = [
        int(jf.solve(Block(*map(float, v)), jnp.array(X0), 0.0, 9.0, 0.05).num_events)
        for v in (GUESSES[1], found.values)
    ]
    assert counts[0] == counts[1] + 1
    # With an impact too few there is a best fit of another kind, which SciPy finds as well; the
    # way to it is too long for 30 steps. With none there is a third.
    np.testing.assert_allclose(found.all_values[:2], [found.values] * 2, rtol=0, atol=1e-7)
    other = scipy.optimize.least_squares(lambda values: motion(values) - data(), GUESSES[2])
    assert found.costs[2] == pytest.approx(other.cost, rel=1e-3) and found.costs[2] > 1
    ended = ["successful", "successful", "fit_not_converged", "successful"]
    assert outcome_names(found.results).tolist() == ended


@pytest.mark.slow
def test_the_card_tells_values_and_errors(found):
    lines = repr(found).splitlines()
    assert lines[0] == "Fit of Block to 45 numbers: successful"
    value, error = found.values[0], found.errors[0]
    assert lines[1] == f"  friction = {float(value):.10g} ± {float(error):.2g}"
    assert lines[3].endswith("of 4 guesses end here")
    assert float(found.system.friction) == float(value)


@pytest.mark.parametrize(
    "change, told",
    [
        ({"parameters": "friction"}, "different parameters, got 'friction'"),
        ({"parameters": ("mass",)}, "must be a parameter of Block"),
        ({"data": np.zeros(3)}, "`data` must have a row for each of the times"),
        ({"data": np.full(45, np.nan)}, "`data` must be finite"),
        ({"ts": TS[::-1]}, "`ts` must be ascending and not before `t0` = 0.0"),
        ({"t0": TS[1]}, "`ts` must be ascending and not before `t0`"),
        ({"sigma": 0.0}, "`sigma` must be positive"),
        ({"guesses": np.zeros((2, 3))}, r"`guesses` must be finite numbers of shape \(g, 2\)"),
        ({"tolerance": -1.0}, "`tolerance` must be a positive number"),
    ],
)
def test_a_wrong_argument_is_named(change, told):
    given = {"parameters": NAMES, "ts": TS, "data": data(), "x0": jnp.array(X0), "dt": 0.05}
    given["observe"] = lambda t, x: x[0]
    with pytest.raises(ValueError, match=told):
        jf.fit(Block(0.1, 0.8), **{**given, **change})


@pytest.mark.release
@pytest.mark.parametrize("mode", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.release)])
def test_a_fit_has_its_derivatives(mode):
    """Before it turns the block is at F + (3 − F) cos t, which is linear in its friction F."""
    ts, x0 = jnp.linspace(0.5, 2.5, 6), jnp.array([3.0, 0.0])
    sigma = 0.5
    slope = (1 - jnp.cos(ts)) / sigma
    data = 0.4 + 2.6 * jnp.cos(ts) + 0.01 * jnp.array([2, -1, 3, -2, 1, -3.0])

    def found(data):
        given = {"observe": lambda t, x: x[0], "sigma": sigma, "stepper": jf.RK4()}
        block = jf.systems.CoulombOscillator(friction=0.3)
        best = jf.fit(block, ("friction",), ts, data, x0, 0.01, **given)
        return jnp.hstack([best.values[0], best.costs[0], best.covariance[0, 0], best.residuals])

    def exact(data):
        pulled = (data - 3 * jnp.cos(ts)) / sigma
        value = slope @ pulled / (slope @ slope)
        away = slope * value - pulled
        return jnp.hstack([value, 0.5 * away @ away, 1 / (slope @ slope), away])

    def both(function):
        return mode(lambda data: (function(data),) * 2, has_aux=True)(data)

    for own, known in zip(both(found), both(exact), strict=True):
        np.testing.assert_allclose(own, known, rtol=0, atol=1e-8)


def test_a_parameter_without_an_effect_leaves_the_error_of_others_finite():
    found = inverse(jnp.array([[4.0, 0.0], [0.0, 0.0]]))
    np.testing.assert_array_equal(found, [[0.25, 0.0], [0.0, jnp.inf]])
    together = inverse(jnp.array([[4.0, 2.0], [2.0, 1.0]]))
    assert not np.isfinite(together).any()
    # Of two numbers the product alone is known, beside a third one; rounding has any sign.
    rows = np.random.default_rng(0).normal(size=(40, 12))
    for row in rows:
        slopes = np.stack([0.7 * row, np.roll(row, 1), 1.3 * row], axis=1)
        found = np.asarray(inverse(jnp.asarray(slopes.T @ slopes)))
        assert np.isinf(found[[0, 0, 2, 2], [0, 2, 0, 2]]).all()
        assert found[1, 1] == pytest.approx(
            1 / (row @ row - (row @ np.roll(row, 1)) ** 2 / (row @ row))
        )


def test_as_many_numbers_as_parameters_say_nothing_of_their_error():
    """x = f + (3 − f) cos t until it first stops; SciPy has an error of infinity too."""
    ts = np.array([2.0])
    seen_once = 0.45 + 2.55 * np.cos(ts)
    system, x0 = jf.systems.CoulombOscillator(friction=0.3), jnp.array([3.0, 0.0])
    given = {"observe": lambda t, x: x[0], "stepper": jf.RK4()}
    found = jf.fit(system, ("friction",), ts, seen_once, x0, 0.1, **given)
    np.testing.assert_allclose(found.values, 0.45, rtol=1e-4)
    with pytest.warns(scipy.optimize.OptimizeWarning):
        _, covariance = scipy.optimize.curve_fit(
            lambda t, f: f + (3 - f) * np.cos(t), ts, seen_once, p0=[0.3]
        )
    np.testing.assert_array_equal(found.covariance, covariance)
