"""Layout at the width of a column: words legible and apart, legends where they cover nothing.

What a legend covers is counted in pixels of the picture drawn without it.
"""

import dataclasses
import itertools
import types

import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.testing import assert_array_equal

import jaxfil as jf
from tests.pictures import (
    BELT,
    PICTURES,
    branch,
    made,
    motion,
    period_doublings as diagram,
    periods,
    spectrum,
    unchecked,
)

# The least size of text that journals accept, in points.
LEGIBLE = 6.0


def column(draw):
    """A picture on a page of one column, drawn."""
    with matplotlib.rc_context(dict(jf.plot.PRINT)):
        page = jf.plot.page(84, 63)
        FigureCanvasAgg(page)
        draw(page.add_subplot())
        page.canvas.draw()
    return page


def covered(ax):
    """The number of pixels beneath the legend that are not white where there is none."""
    legend, canvas = ax.get_legend(), ax.figure.canvas
    box = legend.get_window_extent()
    legend.set(alpha=0)
    legend.set_visible(False)
    ax.figure.set_layout_engine("none")
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[::-1, :, :3]
    inside = pixels[int(box.y0) : int(box.y1) + 1, int(box.x0) : int(box.x1) + 1]
    return int((inside < 250).any(axis=-1).sum())


def words(ax):
    """What is written on axes and beside them."""
    yield from (ax.title, ax.xaxis.label, ax.yaxis.label, *ax.texts)
    if ax.get_legend() is not None:
        yield from ax.get_legend().get_texts()
    for axis in (ax.xaxis, ax.yaxis):
        low, high = sorted(axis.get_view_interval())
        for minor in (False, True):
            places = axis.get_ticklocs(minor=minor)
            for place, label in zip(places, axis.get_ticklabels(minor=minor), strict=True):
                if low <= place <= high:
                    yield label


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_words_are_legible_and_apart(name):
    page = column(PICTURES[name])
    told = [
        word for ax in page.axes for word in words(ax) if word.get_text() and word.get_visible()
    ]
    assert min(word.get_fontsize() for word in told) >= LEGIBLE
    boxes = [(word.get_text(), word.get_window_extent().padded(-1)) for word in told]
    for (one, box), (other, another) in itertools.combinations(boxes, 2):
        assert not box.overlaps(another), (one, other)


# Pictures whose axes are empty where nothing is drawn.
WHITE = {
    "animation", "bifurcation_curve", "bifurcation_diagram", "bifurcation_sequence", "branch",
    "equilibrium_branch", "event_timeline", "lyapunov_convergence", "lyapunov_exponents",
    "phase_portrait", "time_history", "work_precision",
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(WHITE))
def test_a_legend_covers_nothing(name):
    assert covered(column(PICTURES[name]).axes[0]) == 0


def full(ax):
    """Loops that fill the axes, with a start, contacts and a slide."""
    s = np.linspace(0, 40, 2000)
    one = motion()
    ax.plot(np.cos(s) * np.cos(0.05 * s), np.sin(1.37 * s), label="loops")
    jf.plot.phase_portrait(one, ax, BELT)


@pytest.mark.parametrize("draw", [full])
def test_a_legend_has_room_made_for_it(draw):
    ax = column(draw).axes[0]
    assert ax.get_ylim()[1] > 1.3
    assert covered(ax) == 0


def test_limits_of_the_caller_stay():
    def limited(ax):
        ax.set_ylim(-1.1, 1.1)
        full(ax)

    assert column(limited).axes[0].get_ylim() == (-1.1, 1.1)


def test_more_that_is_drawn_leaves_the_room():
    ax = column(full).axes[0]
    top = ax.get_ylim()[1]
    ax.plot([0, 0.1], [0, -3])
    low, high = ax.get_ylim()
    assert low < -3 and high >= top


def several():
    """A branch with nine special points."""
    followed = branch()
    points = [
        types.SimpleNamespace(kind="adding-sliding", value=followed.values[i], index=i)
        for i in range(2, 20, 2)
    ]
    followed = made(jf.Branch, **{**vars(type(followed)), "points": points})
    return unchecked(
        jf.BifurcationSequence,
        branch=followed,
        bifurcations=points,
        indices=[point.index for point in points],
    )


def test_a_long_legend_is_outside():
    ax = column(lambda ax: several().plot(ax)).axes[0]
    box = ax.get_legend().get_window_extent()
    assert len(ax.get_legend().get_texts()) == 11
    assert not box.overlaps(ax.bbox)
    assert ax.bbox.height > 0.25 * ax.figure.bbox.height
    assert ax.figure.bbox.padded(1).contains(*box.min)


def dark_above(ax):
    """Whether something is drawn above axes."""
    ax.figure.canvas.draw()
    pixels = np.asarray(ax.figure.canvas.buffer_rgba())[::-1, :, :3]
    return bool((pixels[int(ax.bbox.y1) + 4 :] < 128).any())


@pytest.mark.parametrize("where", ["left", "center", "right"])
def test_the_title_of_new_axes_gives_way(where):
    with matplotlib.rc_context({"backend": "agg"}):
        ax = diagram().plot()
        (heading,) = ax.texts
        assert heading.get_text() == "SDOscillator: 20 periods after 0"
        assert dark_above(ax)
        ax.set_title(" ", loc=where)
        assert not dark_above(ax)
        plt.close(ax.figure)


def test_a_long_title_is_as_wide_as_the_axes():
    found = diagram()
    values = {f"parameter {i}": np.array(1.25) for i in range(9)}
    conditions = dataclasses.replace(found.conditions, parameters=values)
    with matplotlib.rc_context({"backend": "agg"}):
        ax = dataclasses.replace(found, conditions=conditions).plot()
        ax.figure.canvas.draw()
        box = ax.texts[0].get_window_extent()
        assert 0.7 * ax.bbox.width < box.width < 1.02 * ax.bbox.width
        plt.close(ax.figure)


def test_given_axes_have_no_title_but_the_callers():
    page = jf.plot.page(84)
    ax = page.add_subplot()
    ax.set_title("ours", loc="left")
    diagram().plot(ax)
    assert not ax.texts and ax.get_title(loc="left") == "ours"


def test_a_range_of_periods_is_told_with_both_ends():
    found = periods()  # of 40 samples
    xs = 1.0 + np.arange(40) % np.array([1, 2, 3, 7, 8, 9, 10, 12])[:, None]
    found = dataclasses.replace(found, xs=np.broadcast_to(xs[:, None, :, None], found.xs.shape))
    ax = column(lambda ax: jf.plot.parameter_map(found, ax)).axes[1]
    told = [label.get_text() for label in ax.get_yticklabels()]
    assert told == ["1", "2", "3", "7–20", "failed"]
    assert ax.get_ylabel() == "period"


def test_one_lane_has_a_row_for_each_surface():
    ax = column(lambda ax: jf.plot.event_timeline(motion(), ax)).axes[0]
    rows = {line.get_label(): line.get_ydata().tolist() for line in ax.lines}
    assert rows == {"stick": [0], "slip": [0], "crossing": [0], "impact": [1]}
    assert [label.get_text() for label in ax.get_yticklabels()] == ["0", "1"]
    assert ax.get_ylabel() == "surface"


def changed(record, **fields):
    """A result with other fields, of NumPy arrays, as all of those here."""
    before = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}
    return unchecked(type(record), **before | fields)


def test_a_contact_of_two_surfaces_and_a_tick_have_their_rows():
    one = motion()
    members = np.array([[1, 1], [0, 0], [1, 0], [0, 1], [0, 0]], bool)
    kinds = one.events.kinds.copy()
    kinds[1] = jf.EventKind.tick
    events = changed(one.events, members=members, kinds=kinds)
    ax = column(lambda ax: jf.plot.event_timeline(changed(one, events=events), ax)).axes[0]
    rows = {line.get_label(): line.get_ydata().tolist() for line in ax.lines}
    assert rows == {"stick": [0, 1], "tick": [-1], "crossing": [0], "impact": [1]}
    assert [label.get_text() for label in ax.get_yticklabels()] == ["clock", "0", "1"]


def test_surfaces_are_numbered_as_events_number_them():
    class Two(jf.System):
        def vector_field(self, t, x, side):
            return jnp.stack([x[1], -x[0]])

        def switching(self, t, x):
            return jnp.stack([x[0] - 0.5, x[1] - 0.5])

    ax = column(lambda ax: jf.plot.phase_portrait(motion(), ax, Two())).axes[0]
    told = [text.get_text() for text in ax.get_legend().get_texts()]
    assert told[-2:] == ["H₀ = 0", "H₁ = 0"]
    strips = column(lambda ax: jf.plot.time_history(motion(), ax)).axes[0]
    assert [text.get_text() for text in strips.texts] == ["H₀", "H₁"]


def repeated():
    """The same motion with more sticks than slips, and more slips than crossings."""
    one = motion()
    rows = [0, 0, 0, 1, 1, 2]
    events = {f.name: getattr(one.events, f.name)[rows] for f in dataclasses.fields(jf.Events)}
    return changed(one, events=unchecked(jf.Events, **events))


def test_a_rare_contact_is_above_the_frequent_ones():
    ax = column(lambda ax: jf.plot.phase_portrait(repeated(), ax)).axes[0]
    level = {line.get_label(): line.get_zorder() for line in ax.lines}
    assert level["stick"] < level["slip"] < level["crossing"]


def exponents(first, last):
    """A spectrum of two exponents with these values."""
    values = np.linspace(0.0, 1.0, len(first))
    found = spectrum(values)
    both = np.stack([first, last], axis=-1)
    return values, changed(found, exponents=both, settled=np.ones(len(first), bool))


def test_a_very_negative_exponent_does_not_flatten_the_others():
    first = 0.1 * np.cos(np.linspace(0, 6, 20))
    values, found = exponents(first, np.where(np.arange(20) < 5, -0.3, -200.0))
    ax = column(lambda ax: jf.plot.lyapunov_exponents(values, found, ax)).axes[0]
    low, high = ax.get_ylim()
    assert np.ptp(first) > 0.25 * (high - low)
    below = next(line for line in ax.lines if line.get_label() == "λ₂ down to −200")
    assert_array_equal(below.get_xdata(), values[5:])
    assert_array_equal(below.get_ydata(), 0)  # of the height
    assert below.get_transform() == ax.get_xaxis_transform()


def test_an_exponent_of_zero_makes_no_other_one_too_negative():
    # The average of a zero exponent over a time of 400 is a small number.
    values, found = exponents(np.full(20, 1e-3), np.full(20, -0.5))
    ax = column(lambda ax: jf.plot.lyapunov_exponents(values, found, ax)).axes[0]
    assert ax.get_ylim()[0] < -0.5
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["λ₁", "λ₂"]


@pytest.mark.parametrize("last, told", [(-200.0, "λ₂ = −200"), (-np.inf, "λ₂ = −∞")])
def test_a_running_estimate_beyond_the_axes_is_in_the_legend(last, told):
    one = spectrum()
    found = changed(
        one,
        exponents=np.array([0.1, last]),
        running=one.running - one.exponents + np.array([0.1, last]),
    )
    ax = column(lambda ax: jf.plot.lyapunov_convergence(found, ax)).axes[0]
    assert ax.get_ylim()[0] > -1
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["λ₁ = 0.1", told]
