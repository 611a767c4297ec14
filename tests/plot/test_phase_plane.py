"""The phase plane of a planar system: its separatrices against closed forms, and what is marked."""

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.testing import assert_allclose

import jaxfil as jf
from tests.pictures import SADDLES

matplotlib.use("Agg")


@pytest.mark.slow
def test_separatrices_of_saddles_lie_on_their_manifolds():
    """Those of (0, 2) and of the pseudo-saddle (0, 0) are straight lines, x = 0 and y = 2 or 0."""
    ax = jf.plot.phase_plane(SADDLES, ((-2, 2), (-1, 3)), Figure().add_subplot())
    lines = {}
    for line in ax.lines:
        lines.setdefault(line.get_label(), []).append(np.asarray(line.get_xydata()))
    unstable, stable = lines["unstable manifold"], lines["stable manifold"]
    assert (len(unstable), len(stable)) == (4, 4)
    # They start 1e-5 of the window along them, from where motions keep to them.
    heights = sorted(float(np.median(xy[:, 1])) for xy in unstable)
    assert_allclose(heights, [0, 0, 2, 2], rtol=0, atol=1e-9)
    assert all(abs(xy[:, 0]).max() < 1e-9 for xy in stable)
    # Up out of the window, down to the node between, to it from the other side, and down.
    ends = sorted(float(xy[-1, 1]) for xy in stable)
    assert_allclose(ends[1:3], [1.0, 1.0], rtol=0, atol=1e-4)
    assert ends[0] < -1 and ends[3] > 3
    marked = {name: np.concatenate(points) for name, points in lines.items() if len(points[0]) == 1}
    assert_allclose(marked["pseudo-saddle"], [[0, 0]], rtol=0, atol=1e-12)
    assert_allclose(marked["saddle"], [[0, 2]], rtol=0, atol=1e-12)
    assert_allclose(marked["unstable equilibrium"], [[0, 1]], rtol=0, atol=1e-12)
    assert_allclose(marked["visible tangency"], [[-1, 0], [1, 0]], rtol=0, atol=1e-12)


class Smooth(jf.System):
    """A saddle at the origin and stable nodes at x = ±1, without a surface."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[0] - x[0] ** 3, -3 * x[1]])


def test_a_system_without_surfaces_has_a_phase_plane():
    ax = jf.plot.phase_plane(Smooth(), ((-2, 2), (-1, 1)), Figure().add_subplot())
    points = {
        v.get_label(): np.asarray(v.get_xydata()) for v in ax.lines if len(v.get_xydata()) == 1
    }
    assert_allclose(points["saddle"], [[0, 0]], rtol=0, atol=1e-9)


def test_a_system_with_impacts_is_refused():
    with pytest.raises(ValueError, match="`system` must have no `reset`: BouncingBall"):
        jf.plot.phase_plane(jf.systems.BouncingBall(), ((-1, 1), (-1, 1)))
