"""Basins of attraction: the coexisting motions of the SD oscillator, and what cannot be told."""

import dataclasses

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from tests.problems import PROBLEMS, closed_forms

matplotlib.use("Agg")
SD = jf.systems.SDOscillator(omega=0.7)
AXES = np.linspace(-3.2, 3.2, 8), np.linspace(-2.0, 2.0, 7)


@pytest.fixture(scope="module")
def found():
    return jf.basins_of_attraction(SD, AXES, transient=800, samples=8, progress=False)


@pytest.mark.release
def test_three_motions_coexist(found):
    # About −1, about +1, and the symmetric one of period 1.
    assert len(found.attractors) == 3 and found.labels.min() == 1
    right = closed_forms.one_sided(0.7)
    left = [right[0] - 2, right[1]]
    points = np.concatenate(found.attractors)
    for expected in (left, right, PROBLEMS["symmetric sd"].x0):
        assert np.min(np.max(abs(points - expected), axis=1)) < 1e-4


@pytest.mark.slow
def test_each_state_is_labelled_by_where_it_goes(found):
    # Against a single run from the corner states, by another route.
    for i, j in ((0, 0), (5, 3), (7, 6)):
        x = jnp.array([AXES[0][i], AXES[1][j]])
        period = float(SD.period)
        end = jf.solve(SD, x, 0.0, 808 * period, period / 40, max_events=None).x_final
        points = found.attractors[found.labels[i, j] - 1]
        assert np.min(np.max(abs(points - np.asarray(end)), axis=1)) < 1e-3


def test_it_prints_and_draws_itself(found):
    assert "8 × 7 initial states" in repr(found) and "3: period 1" in repr(found)
    ax = found.plot()
    (mesh,) = ax.collections
    assert_array_equal(np.unique(mesh.get_array()), [0, 1, 2])
    assert_allclose([line.get_xdata()[0] for line in ax.lines], [p[0, 0] for p in found.attractors])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x at t = 0", "x' at t = 0")
    plt.close("all")


class Bare(jf.System):
    """A driven oscillator without a parameter."""

    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.cos(t) - 2 * x[0] - x[1]])


class Listed(jf.System):
    """The same, its stiffness and damping in one array."""

    k: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.cos(t) - self.k[0] * x[0] - self.k[1] * x[1]])


def test_parameters_may_be_an_array():
    """The one attractor is Re(z eⁱᵗ), z = 1/(2 − 1 + i)."""
    found = jf.basins_of_attraction(
        Listed(jnp.array([2.0, 1.0])),
        ([0.5, 1.0], [0.0]),
        transient=60,
        samples=4,
        steps=20,
        progress=False,
    )
    assert_array_equal(found.labels, 1)
    assert_allclose(found.attractors[0][0], [0.5, 0.5], atol=1e-8)


def test_an_option_that_would_have_no_effect_is_refused():
    with pytest.raises(TypeError, match="`average` is not an argument of `basins_of_attraction`"):
        jf.basins_of_attraction(SD, AXES, average=lambda t, x: x[0])


@pytest.mark.parametrize(
    "change, message",
    [
        ({"axes": ([[1.0]], [1.0])}, r"`axes\[0\]` must be finite numbers of shape \(k,\)"),
        ({"components": (0, 2)}, "`components` must be two different ones from 0 to 1"),
        ({"system": Bare()}, "`system` must have a float field, got Bare"),
    ],
)
def test_bad_calls(change, message):
    with pytest.raises(ValueError, match=message):
        jf.basins_of_attraction(**{"system": SD, "axes": AXES} | change)


class Scaled(jf.System):
    """x'' + 0.3 x' + (1 + 0.2 cos t) x = a cos t: all motions go to one of the size of a."""

    a: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        force = self.a * jnp.cos(t) - (1 + 0.2 * jnp.cos(t)) * x[0]
        return jnp.stack([x[1], force - 0.3 * x[1]])


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_rest_at_the_origin_is_an_attractor_of_period_one(size):
    """From the origin itself too. A motion of a millionth of the grid is no rest."""
    run = {"transient": 60, "samples": 4, "steps": 20, "stepper": jf.RK4(), "progress": False}
    grid = [-size, 0.0, size], [0.0]
    still = jf.basins_of_attraction(Scaled(jnp.array(0.0)), grid, **run)
    assert still.labels.ravel().tolist() == [1, 1, 1] and len(still.attractors) == 1
    small = jf.bifurcation_diagram(
        Scaled(jnp.array(0.0)), "a", [0.0, 1e-6 * size], jnp.array([size, 0.0]), **run
    )
    assert small.periods().tolist() == [1, 1]
    assert abs(small.xs[1]).max() > 1e-7 * size
    moving = dataclasses.replace(small, xs=small.xs * jnp.array([1.0, -1.0, 1.0, -1.0])[:, None])
    assert moving.periods().tolist() == [1, 2]


class Heater(jf.System):
    """T' = 0.1 sgn(T − a) − (T − a), y' = −y: it comes to rest at T = a ± 0.1, or alternates."""

    ambient: jax.Array
    ripple: jax.Array
    period = 1.0

    def vector_field(self, t, x, side):
        wave = self.ripple * jnp.pi * jnp.cos(jnp.pi * t)
        return jnp.stack([0.1 * side - (x[0] - self.ambient) + wave, -x[1]])

    def switching(self, t, x):
        return x[0] - self.ambient


@pytest.mark.parametrize("ambient", [0.0, 300.0])
def test_an_offset_does_not_unite_attractors(ambient):
    """A tolerance relative to 300 K would take the two for one, and a period of 2 for 1."""
    axes = ambient + np.linspace(-0.5, 0.5, 8), [-1.0, 1.0]
    for ripple in (0.0, 1e-3):
        heater = Heater(jnp.array(ambient), jnp.array(ripple))
        options = dict(transient=40, samples=8, steps=8, progress=False)
        found = jf.basins_of_attraction(heater, axes, **options)
        assert [len(points) for points in found.attractors] == 2 * [1 if ripple == 0 else 2]
        low, high = (float(np.mean(points[:, 0])) - ambient for points in found.attractors)
        assert_allclose([low, high], [-0.1, 0.1], rtol=0, atol=2e-3)
        assert_array_equal(found.labels, np.repeat([1, 2], 4)[:, None] * [1, 1])
