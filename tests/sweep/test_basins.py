"""Basins of attraction: the coexisting motions of the SD oscillator, and what cannot be told."""

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


@pytest.mark.slow
def test_three_motions_coexist(found):
    # About −1, about +1, and the symmetric one of period 1.
    assert len(found.attractors) == 3 and found.labels.min() == 1
    right = closed_forms.one_sided(0.7)
    left = [right[0] - 2, right[1]]
    points = np.concatenate(found.attractors)
    for expected in (left, right, PROBLEMS["symmetric sd"].x0):
        assert np.min(np.max(abs(points - expected), axis=1)) < 1e-4


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


@pytest.mark.parametrize(
    "change, message",
    [
        ({"axes": ([[1.0]], [1.0])}, r"`axes\[0\]` must be finite numbers of shape \(k,\)"),
        ({"components": (0, 2)}, "`components` must be two different ones from 0 to 1"),
    ],
)
def test_bad_calls(change, message):
    with pytest.raises(ValueError, match=message):
        jf.basins_of_attraction(**{"system": SD, "axes": AXES} | change)
