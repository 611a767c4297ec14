"""Tangencies of planar systems against closed forms."""

import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf

WINDOW = ((-2.0, 2.0), (-2.0, 2.0))


def told(system):
    return [(p.kind, p.side, *p.x) for p in jf.tangency_points(system, WINDOW)]


def folds(above, below):
    """Fields (1, above·x), (1, below·x) on y = 0: both are tangent at the origin."""
    field = lambda slope: lambda t, x: jnp.stack([1.0 + 0 * x[0], slope * x[0]])  # noqa: E731
    return jf.piecewise(field(above), field(below), lambda t, x: x[1])


def test_tangencies_of_one_side_each():
    """The belt's force is zero at x = 1 below, where the motion falls back, and x = −1 above."""
    (first, second) = jf.tangency_points(jf.systems.SlipStick(), WINDOW)
    assert (first.kind, first.side, second.kind, second.side) == ("invisible", 1, "visible", -1)
    assert_allclose([first.x, second.x], [[-1.0, 0.2], [1.0, 0.2]], rtol=1e-14)


def test_tangencies_of_a_curved_surface():
    """The field (1, −1) outside touches the circle of radius √2 at ±(1, 1), and leaves it."""
    found = told(jf.systems.VisibleFold())
    assert [row[:2] for row in found] == [("visible", 1)] * 2
    assert_allclose([row[2:] for row in found], [[-1, -1], [1, 1]], rtol=1e-14)


@pytest.mark.parametrize(
    "above, below, kind",
    [(1, -1, "visible"), (-1, 1, "invisible"), (1, 2, "visible-invisible")],
)
def test_two_folds(above, below, kind):
    ((found, side, x, y),) = told(folds(float(above), float(below)))
    assert (found, side) == (f"{kind} two-fold", 0)
    assert_allclose([x, y], 0.0, rtol=0, atol=1e-14)


def test_other_windows_are_refused():
    with pytest.raises(ValueError, match=r"`limits` must be \(\(left, right\).*ascending, got"):
        jf.tangency_points(jf.systems.SlipStick(), ((1.0, -1.0), (0.0, 1.0)))
