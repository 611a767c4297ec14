"""The walk along a curve and what is located on it: on the circle, where all is known."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxfil import RESULTS
from jaxfil.model.outcomes import outcome_names
from jaxfil.orbits.curve import (
    Curve,
    CurvePoint,
    Special,
    StepSizes,
    constraint_across,
    tangent_of,
)
from jaxfil.orbits.locating import change_on_curve, zero_on_curve
from jaxfil.orbits.newton import Evaluation, newton
from jaxfil.orbits.pseudo_arclength import ends_of, follow, range_around

HEIGHT = 0.3


@eqx.filter_jit
def solve(radius, guess, constraint):
    def evaluate(u):
        one = jnp.ones(1)
        value, by_u = (u @ u - radius)[None], 2 * u[None]
        at = Evaluation(value, by_u, one, jnp.ones(2), RESULTS.successful, None)
        return constraint.appended(at, u)

    return newton(evaluate, guess, 20)


@dataclasses.dataclass(frozen=True)
class Circle(Curve[CurvePoint]):
    """p² + y² = `radius`², of which nothing is found above `top`."""

    top: float = 2.0
    radius: float = 1.0
    steps = StepSizes(first=0.05, least=1e-6, growth=1.5, straight=0.99, easy=9, corner=0.0)
    solution, place, parameter = "point", 0, "p"

    def solve(self, guess, constraint):
        return solve(jnp.asarray(self.radius), jnp.asarray(guess), constraint)

    def point(self, root, constraint, along):
        scale, u = np.asarray(constraint.scale), np.asarray(root.z)
        return CurvePoint(u, scale, tangent_of(root, scale, along), int(root.num_steps))

    def metric(self, point):
        return np.ones(2)

    def special_points(self, a, b):
        if a.tangent[0] * b.tangent[0] < 0:
            point = zero_on_curve(self, a, b, lambda p: p.tangent[0])
            yield Special("fold", point, "ahead", "back")
        if (a.u[1] > HEIGHT) != (b.u[1] > HEIGHT):
            low = a.u[1] > HEIGHT
            _, point = change_on_curve(self, a, b, lambda p: (p.u[1] > HEIGHT) == low)
            yield Special("height", point, a.u[1] > HEIGHT, b.u[1] > HEIGHT)

    def refusal(self, ahead):
        return "it is too high" if ahead.u[1] > self.top else None


def from_below(curve, stop, max_points=200):
    """Both ways from (0, −1)."""
    u = np.array([0.0, -1.0])
    axis = curve.axis(u)
    start, result = curve.begin(u, constraint_across(u, np.ones(2), axis, 0.0), axis)
    assert outcome_names(result) == "successful"
    return follow(curve, start, range_around(ends_of(stop), curve.value(start)), 0.2, max_points)


def test_both_ways_round_a_fold_are_one_curve():
    path = from_below(Circle(), (-2.0, 0.5))
    us = np.array([point.u for point in path.points])
    assert_allclose(np.sum(us**2, axis=1), 1, rtol=1e-14)
    # From the upper end over the fold on the left to the lower end, without a gap.
    assert_allclose(us[[0, -1]], [[0.5, np.sqrt(0.75)], [0.5, -np.sqrt(0.75)]], rtol=1e-14)
    angles = np.unwrap(np.arctan2(us[:, 1], us[:, 0]))
    assert (np.diff(angles) > 0).all() and np.diff(angles).max() < 0.21
    assert path.ended == ("p = 0.5 was reached",) * 2


def test_special_points_are_located_and_told_in_the_order_of_the_curve():
    path = from_below(Circle(), (-2.0, 0.5))
    height, fold = path.special
    assert (height.kind, fold.kind) == ("height", "fold")
    assert_allclose(height.point.u, [-np.sqrt(1 - HEIGHT**2), HEIGHT], rtol=0, atol=2e-12)
    assert (height.before, height.after) == (True, False)
    assert_allclose(fold.point.u, [-1, 0], rtol=0, atol=2e-12)
    for special in path.special:
        ys = [path.points[special.index + k].u[1] for k in (-1, 0)]
        assert ys[0] >= special.point.u[1] >= ys[1]


def test_one_way_starts_where_it_is_told():
    path = from_below(Circle(), 0.5)
    assert path.ended == ("start at 0", "p = 0.5 was reached")
    assert_allclose(path.points[-1].u, [0.5, -np.sqrt(0.75)], rtol=1e-14)


def test_a_curve_ends_where_a_point_is_refused_or_the_budget_is_used_up():
    low, ahead = from_below(Circle(top=0.5), (-2.0, 0.5)).ended
    assert low.startswith("it is too high beyond -0.") and ahead == "p = 0.5 was reached"
    path = from_below(Circle(), (-2.0, 2.0), max_points=3)
    assert len(path.points) == 5 and path.ended == ("3 points were made",) * 2


def test_a_closed_curve_is_followed_once_round():
    path = from_below(Circle(), (-2.0, 2.0))
    us = np.array([point.u for point in path.points])
    assert path.closed and path.ended == ("closed at 0",) * 2
    assert (us[-1] == us[0]).all()
    turns = np.diff(np.unwrap(np.arctan2(us[:, 1], us[:, 0])))
    assert_allclose(abs(turns.sum()), 2 * np.pi, rtol=1e-12)
    assert [special.kind for special in path.special].count("fold") == 2


def test_where_a_test_function_has_no_value_the_last_point_is_told():
    path = from_below(Circle(), 0.5)
    a, b = path.points[0], path.points[2]
    seen = []

    def test(point):
        seen.append(point)
        return point.u[0] - 0.01 if len(seen) < 4 else np.nan

    assert zero_on_curve(Circle(), a, b, test) is seen[2]


def test_to_use_up_the_budget_at_the_start_is_to_be_stalled():
    u = np.array([0.0, -1.0])
    # Across p = 3 there is no point of the circle.
    point, result = Circle().begin(
        u, constraint_across(u, np.ones(2), np.array([1.0, 0.0]), 3.0), u
    )
    assert point is None and outcome_names(result) == "newton_stalled"


@pytest.mark.parametrize(
    "stop, message",
    [
        ("there", "must be a number or a pair"),
        (np.inf, "must be a number or a pair"),
        ((1.0, 2.0, 3.0), "must be a number or a pair"),
        (0.5, "must differ from the value at the start, got 0.5"),
        ((0.6, 1.0), r"must be \(low, high\) around the value 0.5, got \(0.6, 1.0\)"),
        ((0.5, 0.5), r"must be \(low, high\) around the value 0.5"),
    ],
)
def test_a_range_is_around_the_start(stop, message):
    with pytest.raises(ValueError, match=f"`stop` {message}"):
        range_around(ends_of(stop), 0.5)


def test_at_an_edge_of_the_range_there_is_one_way():
    assert range_around(ends_of((0.5, 1.0)), 0.5).ways == (1.0,)
    assert range_around(ends_of((0.0, 0.5)), 0.5).ways == (-1.0,)
