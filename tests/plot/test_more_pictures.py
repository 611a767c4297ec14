"""Pictures of maps, sections, surfaces and sequences: what is drawn is what was worked out."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from tests.pictures import FILIPPOV, branch, made, motion, over_two, sequence, unchecked, widening

matplotlib.use("Agg")


@pytest.fixture
def ax():
    yield plt.figure().add_subplot()
    plt.close("all")


def parts(ax):
    """Where each part of a surface begins and ends, by its name."""
    found = {}
    for line in ax.lines:
        found.setdefault(line.get_label(), []).append(line.get_xydata())
    return found


def test_a_surface_is_cut_at_its_tangencies(ax):
    # dH/dt is x(x − 1) above and 1/2 − x below: the signs change at 0, 1/2 and 1.
    found = parts(jf.plot.sliding_region(FILIPPOV, ((-1, 2), (-1, 1)), ax))
    (attracting,), (repelling,) = found["attracting sliding"], found["repelling sliding"]
    near = {"atol": 3 / 2000}
    assert_allclose(attracting[[0, -1], 0], [0, 0.5], **near)
    assert_allclose(repelling[[0, -1], 0], [1, 2], **near)
    ends = [piece[[0, -1], 0] for piece in found["crossing"]]
    assert_allclose(ends, [[-1, 0], [0.5, 1]], **near)
    assert_allclose(found["tangency"][0], [[0, 0], [0.5, 0], [1, 0]], **near)


def test_arrows_are_of_the_field_on_their_side(ax):
    jf.plot.sliding_region(FILIPPOV, ((-1, 2), (-1, 1)), ax)
    above, below = (c for c in ax.collections if hasattr(c, "U"))
    for arrows, slope in ((above, lambda x: x * (x - 1)), (below, lambda x: 0.5 - x)):
        # The axes are 3 wide and 2 high.
        assert_allclose(arrows.V / arrows.U, slope(arrows.X) * 3 / 2, rtol=1e-12, atol=1e-12)
    assert above.Y.min() > 0 > below.Y.max()


def test_a_surface_that_moves_is_taken_at_its_time(ax):
    # On the belt v = cos t + 0.7 the surface is where x' is v, and it slides where |…| < F.
    belt, t = jf.systems.MovingBelt(), 0.3
    found = parts(jf.plot.sliding_region(belt, ((-2, 3), (0, 3)), ax, t=t))
    (attracting,) = found["attracting sliding"]
    v = np.cos(t) + 0.7
    assert_allclose(attracting[:, 1], v, rtol=0, atol=1e-6)
    # −x − 0.4v + cos 0.7t − v' is ±0.4 at its ends.
    middle = -0.4 * v + np.cos(0.7 * t) + np.sin(t)
    assert_allclose(attracting[[0, -1], 0], [middle - 0.4, middle + 0.4], rtol=0, atol=5 / 2000)


def test_exponents_over_a_grid(ax):
    axes = np.linspace(0, 1, 9)[::-1], np.linspace(0, 1, 7)
    jf.plot.exponent_map(axes, over_two(), ax, ("a", "b"), component=1)
    drawn = ax.collections[0].get_array().reshape(7, 9)
    expected = over_two().exponents[::-1, :, 1].T
    finite = np.isfinite(expected)
    assert_array_equal(drawn[finite], expected[finite])
    assert np.ma.getmaskarray(drawn)[np.isnan(expected)].all()
    assert ax.figure.axes[1].get_ylabel() == "λ₂ per unit time"
    with pytest.raises(ValueError, match="one spectrum for each point of a grid of 3 × 7"):
        jf.plot.exponent_map((axes[0][:3], axes[1]), over_two(), ax)


def test_a_sequence_tells_each_bifurcation_with_its_place(ax):
    assert sequence().plot(ax) is ax
    told = [text.get_text() for text in ax.get_legend().get_texts()]
    assert told == ["stable", "unstable", "1: fold, 0.9", "2: adding-sliding, 0.78"]
    assert [text.get_text() for text in ax.texts] == ["1", "2"]


def test_a_bifurcation_at_the_end_of_a_branch_is_drawn_there(ax):
    """It is no special point of the branch."""
    followed = branch()
    at_end = SimpleNamespace(kind="grazing", value=float(followed.values[-1]))
    listed = unchecked(
        jf.BifurcationSequence,
        branch=followed,
        bifurcations=[*followed.points, at_end],
        indices=[*(point.index for point in followed.points), len(followed.values) - 1],
    )
    listed.plot(ax)
    assert [text.get_text() for text in ax.texts] == ["1", "2", "3"]


def test_multipliers_of_a_branch_have_its_parameters_colours(ax):
    followed, values = branch(), np.array([0.5 + 0.1j, 0.5 - 0.1j])
    orbits = made(
        jf.Orbit,
        multipliers=np.tile(values, (40, 1)),
        x0=np.zeros((40, 2)),
        system=jf.systems.SDOscillator(),
    )
    held = made(jf.Branch, parameter="omega", values=followed.values, orbits=orbits)
    jf.plot.multipliers(held, ax)
    (inside,) = ax.collections
    assert_array_equal(inside.get_array(), np.repeat(followed.values, 2))
    assert ax.figure.axes[1].get_ylabel() == "Ω"


def test_a_density_integrates_to_one(ax):
    xs = np.random.default_rng(0).normal(size=(4, 500, 3))
    xs[0, 0] = np.nan
    jf.plot.section_density(xs, ax, components=(2, 0), bins=12)
    mesh = ax.collections[0]
    x, y = mesh.get_coordinates()[0, :, 0], mesh.get_coordinates()[:, 0, 1]
    cells = np.diff(x) * np.diff(y)[:, None]
    assert_allclose((mesh.get_array().filled(0).reshape(12, 12) * cells).sum(), 1, rtol=1e-12)
    assert (x[0], x[-1]) == (np.nanmin(xs[..., 2]), np.nanmax(xs[..., 2]))


def test_a_return_map_pairs_states_of_one_motion_only(ax):
    xs = np.arange(12.0).reshape(2, 6, 1)
    jf.plot.return_map(xs, ax, lag=2)
    assert_array_equal(ax.lines[1].get_xdata(), [0, 1, 2, 3, 6, 7, 8, 9])
    assert_array_equal(ax.lines[1].get_ydata(), ax.lines[1].get_xdata() + 2)
    assert ax.get_ylabel() == "x[0], 2 times later"
    with pytest.raises(ValueError, match="`lag` must be an integer of 1 or more, got 0"):
        jf.plot.return_map(xs, ax, lag=0)


def test_a_timeline_has_a_row_for_each_lane(ax):
    one = motion()
    fields = ("ts", "xs", "modes", "t_final", "x_final", "mode_final")
    events = {
        f.name: np.stack([getattr(one.events, f.name)] * 3) for f in dataclasses.fields(jf.Events)
    }
    events["ts"] = events["ts"] + np.array([[0.0], [0.1], [0.2]])
    rest = dict.fromkeys(("num_events", "result", "stats", "errors", "_dense"))
    batch = {name: jnp.stack([jnp.asarray(getattr(one, name))] * 3) for name in fields}
    sol = unchecked(
        jf.Solution, **batch, events=unchecked(jf.Events, **events), labels=one.labels, **rest
    )
    jf.plot.event_timeline(sol, ax, np.array([1.0, 2.0, 4.0]), ms=2)
    (crossing,) = (line for line in ax.lines if line.get_label() == "crossing")
    assert_array_equal(crossing.get_ydata(), [1, 2, 4])
    assert_allclose(np.diff(crossing.get_xdata()), 0.1)
    assert crossing.get_markersize() == 2
    with pytest.raises(ValueError, match="`values` must be one for each of 3 lanes"):
        jf.plot.event_timeline(sol, ax, np.zeros(2))


def test_a_moving_picture_shows_what_has_happened(ax):
    sol = motion()
    moving = jf.plot.animation(sol, ax, frames=9)
    for t, stuck in ((0.0, 0), (1.0, 1), (8.0, 1)):
        moving._draw_frame(t)
        _, trail, *marks, point = ax.lines
        assert len(marks[1].get_xdata()) == stuck
        assert_allclose(point.get_xdata(), -np.cos(t), rtol=0, atol=1e-3)
        assert_array_equal(trail.get_xydata()[-1], point.get_xydata()[0])
        assert ax.get_title(loc="left") == f"t = {t:.4g}"
    moving._draw_was_started = True  # or matplotlib warns that it was never shown
    with pytest.raises(ValueError, match="`frames` must be an integer of 2 or more, got 1"):
        jf.plot.animation(sol, ax, frames=1)


def test_a_path_is_coloured_by_time(ax):
    sol = motion()
    jf.plot.path_in_time(sol, ax)
    (lines,) = ax.collections
    pieces = np.array(lines.get_segments())
    assert np.isfinite(pieces).all()
    # On the circle the angle is the time, but for where it sticks.
    ts, middle = lines.get_array(), pieces.mean(axis=1)
    turns = (ts > 3) & (ts < 6)
    angle = np.arctan2(middle[turns, 1], -middle[turns, 0]) % (2 * np.pi)
    assert_allclose(angle, ts[turns], rtol=0, atol=1e-12)


def test_the_orbits_of_a_branch_have_the_colour_of_its_parameter(ax):
    followed = widening()
    jf.plot.branch_orbits(followed, ax)
    (lines,) = ax.collections
    assert_array_equal(lines.get_array(), followed.values)
    radii = [np.ptp(np.array(curve)[:, 0]) / 2 for curve in lines.get_segments()]
    assert_allclose(radii, followed.values)
