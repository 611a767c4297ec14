"""Pictures: what is drawn is what was computed, contact by contact and sample by sample."""

import dataclasses
import functools
import re
import types

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.colors
import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from jaxfil.plot.canvas import shades
from tests.pictures import PICTURES, VALUES, basins, made, periods, unchecked
from tests.problems import PROBLEMS

matplotlib.use("Agg")


@pytest.fixture(autouse=True)
def no_figure_stays_open():
    yield
    plt.close("all")


def solved(system, x0, t1, dt=0.05, t0=0.0):
    saveat = diffrax.SaveAt(t0=True, steps=True)
    return jf.solve(system, jnp.array(x0, float), t0, t1, dt, stepper=jf.RK4(), saveat=saveat)


def swept(points=5, samples=4, **kwargs):
    return jf.bifurcation_diagram(
        jf.systems.SDOscillator(),
        "omega",
        jnp.linspace(0.7, 0.9, points),
        jnp.array([0.3, 0.1]),
        transient=3,
        samples=samples,
        progress=False,
        **kwargs,
    )


@functools.cache
def sticking():
    """One orbit of the belt that sticks at 3.388..., and slips at 0.025..., once a period."""
    p = PROBLEMS["belt 1.3"]
    return solved(p.system, [*p.x0], p.t1, 0.01)


def bands(ax, mode):
    """Start, end, bottom and top of the bands with this mode's colour."""
    color = matplotlib.colors.to_rgb(jf.plot.BANDS[mode][1])
    for collection in ax.collections:
        if tuple(collection.get_facecolor()[0][:3]) == color:
            for path in collection.get_paths():
                (x0, y0), (x1, y1) = path.vertices.min(axis=0), path.vertices.max(axis=0)
                yield x0, x1, y0, y1


def marked(ax, kind):
    (line,) = [line for line in ax.lines if line.get_label() == kind.name]
    return np.array(line.get_data()).T


@pytest.mark.parametrize("component", [0, 1])
def test_a_diagram_shows_every_sample_over_its_value(component):
    diagram = swept()
    ax = jf.plot.bifurcation_diagram(diagram, component=component)
    (dots,) = ax.lines
    x, y = dots.get_data()
    assert_array_equal(x, np.repeat(diagram.values, 4))
    assert_array_equal(y, diagram.xs[:, :, component].ravel())
    assert ax.get_xlabel() == "Ω"
    assert ax.get_ylabel() == ("x once a period", "x' once a period")[component]
    assert ax.get_xlim() == (0.7, 0.9)
    assert dots.get_rasterized()


def test_the_axes_given_are_drawn_on_and_come_back():
    _, axes = plt.subplots(1, 3)
    assert jf.plot.bifurcation_diagram(swept(), axes[0]) is axes[0]
    assert jf.plot.time_history(sticking(), axes[1]) is axes[1]
    assert jf.plot.phase_portrait(sticking(), axes[2]) is axes[2]
    assert len(plt.get_fignums()) == 1


def test_a_diagram_draws_itself():
    ax = swept().plot(component=1)
    assert ax.get_ylabel() == "x' once a period"


def test_a_page_is_shown_in_no_window():
    jf.plot.bifurcation_diagram(swept(), jf.plot.page().add_subplot())
    assert plt.get_fignums() == []


def test_values_whose_lane_ended_early_are_ticked_and_counted():
    bad = jf.bifurcation_diagram(
        jf.systems.BeltFriction(),
        "mu",
        jnp.array([0.5, jnp.nan, 0.6]),
        jnp.zeros(2),
        transient=1,
        samples=2,
        progress=False,
    )
    assert_array_equal(bad.results == RESULTS.successful, [True, False, True])
    ax = jf.plot.bifurcation_diagram(bad)
    dots, ticks = ax.lines
    assert_array_equal(dots.get_xdata(), [0.5, 0.5, 0.6, 0.6])
    assert_array_equal(ticks.get_xdata(), [jnp.nan])
    assert ticks.get_label() == "1 ended early"


def test_a_diagram_of_one_value_can_be_seen():
    ax = jf.plot.bifurcation_diagram(swept(points=1))
    low, high = ax.get_xlim()
    assert low < 0.7 < high
    assert ax.lines[0].get_markersize() == 3


def test_values_that_are_not_finite_do_not_count_in_the_limits():
    shown = swept()
    shown = dataclasses.replace(shown, values=jnp.asarray(shown.values).at[1].set(jnp.inf))
    ax = jf.plot.bifurcation_diagram(shown)
    assert ax.get_xlim() == (shown.values[0], shown.values[-1])


def test_a_million_samples_are_one_image(tmp_path):
    # One line of markers, kept as pixels: a stroke for each would be minutes and 60 MB.
    diagram = swept()
    shape = (10_000, 100, 2)
    values = jnp.linspace(0.0, 1.0, shape[0])
    xs = jnp.sin(jnp.arange(np.prod(shape), dtype=float)).reshape(shape)
    results = jax.tree.map(lambda code: jnp.full(shape[0], code[0]), diagram.results)
    many = dataclasses.replace(diagram, values=values, xs=xs, results=results)
    page = jf.plot.page()
    ax = jf.plot.bifurcation_diagram(many, page.add_subplot())
    (dots,) = ax.lines
    assert dots.get_rasterized() and len(dots.get_xdata()) == 1_000_000
    assert dots.get_linestyle() == "None" and dots.get_markeredgewidth() == 0
    assert not [*ax.collections, *ax.patches, *ax.images]
    page.savefig(tmp_path / "million.pdf")
    assert (tmp_path / "million.pdf").stat().st_size < 3e6


def test_bands_change_at_the_contacts():
    sol = sticking()
    ax = jf.plot.time_history(sol)
    slip, stick = PROBLEMS["belt 1.3"].ts
    held = sorted(bands(ax, 0))
    assert_allclose(
        [b[:2] for b in held], [(0, slip), (stick, PROBLEMS["belt 1.3"].t1)], rtol=0, atol=1e-7
    )
    assert_allclose([b[:2] for b in bands(ax, -1)], [(slip, stick)], rtol=0, atol=1e-7)
    assert not list(bands(ax, 1))
    assert {t.get_text() for t in ax.get_legend().get_texts()} == {"sliding", "H < 0"}


def test_each_surface_has_its_own_band():
    sol = solved(jf.systems.FilippovSpiral(), [0.0, 1.0], 1.0, 0.01)
    ax = jf.plot.time_history(sol)
    spans = [b for mode in (-1, 0, 1) for b in bands(ax, mode)]
    heights = sorted({b[2:] for b in spans})
    assert heights[0][0] == 0 and heights[0][1] == heights[1][0] == heights[1][1] / 2
    # As high as the text beside them, of 8.3 points.
    assert 8.3 < heights[0][1] * 72 * ax.bbox.height / ax.figure.dpi < 15
    lower, upper = (sorted(b[:2] for b in spans if b[2:] == h) for h in heights)
    # Below the curve, and named.
    low, high = ax.get_ylim()
    assert low + heights[1][1] * (high - low) < ax.lines[0].get_ydata().min()
    assert [text.get_text() for text in ax.texts] == ["H₀", "H₁"]
    assert len(lower) + len(upper) == len(spans)
    for band in (lower, upper):
        assert len(band) > 3
        assert_allclose([a for a, _ in band], [0, *(b for _, b in band[:-1])], rtol=0, atol=1e-12)
        assert band[-1][1] == 1.0


def test_a_history_backward_in_time_is_shaded_too():
    sol = solved(jf.systems.SDOscillator(), [0.5, 2.0], 0.0, t0=6.0)
    ax = jf.plot.time_history(sol)
    assert sol.num_events > 0
    edges = sorted(e for mode in (-1, 1) for b in bands(ax, mode) for e in b[:2])
    for t in np.asarray(sol.events.ts)[: int(sol.num_events)]:
        assert np.abs(np.array(edges) - t).min() < 1e-12
    assert (edges[0], edges[-1]) == (0.0, 6.0)


def test_a_smooth_system_has_a_history_without_bands():
    ax = jf.plot.time_history(solved(jf.smoothed(jf.systems.CoulombOscillator(), 0.1), [3, 0.0], 1))
    assert not list(ax.collections)
    assert ax.get_legend() is None


@pytest.mark.parametrize("component", [0, 1])
def test_a_history_goes_through_every_saved_state_and_contact(component):
    sol = sticking()
    x, y = jf.plot.time_history(sol, components=component).lines[0].get_data()
    drawn = set(zip(x.tolist(), y.tolist(), strict=True))
    saved = np.isfinite(sol.ts)
    assert saved.sum() > 400
    for ts, xs in ((sol.ts[saved], sol.xs[saved]), (sol.events.ts[:2], sol.events.xs[:2])):
        assert set(zip(ts.tolist(), xs[:, component].tolist(), strict=True)) <= drawn
    assert_array_equal(x, np.sort(x))


def test_every_contact_is_marked_by_its_kind():
    sol = sticking()
    ax = jf.plot.phase_portrait(sol)
    kinds = np.asarray(sol.events.kinds)
    assert_array_equal(marked(ax, EventKind.stick), sol.events.xs[kinds == EventKind.stick])
    assert_array_equal(marked(ax, EventKind.slip), sol.events.xs[kinds == EventKind.slip])
    assert {t.get_text() for t in ax.get_legend().get_texts()} == {
        "sliding",
        "start",
        "stick",
        "slip",
    }


def test_slides_are_thick_and_surfaces_dashed():
    sol = sticking()
    ax = jf.plot.phase_portrait(sol, system=PROBLEMS["belt 1.3"].system)
    slides = [line.get_data() for line in ax.lines if line.get_linewidth() == 4]
    # It starts on the belt, slips at 0.025, sticks at 3.388 and is carried to the period's end.
    assert len(slides) == 2
    assert_allclose(np.concatenate([y for _, y in slides]), 1.0, rtol=0, atol=1e-12)
    ends = [sol.xs[0, 0], sol.x_final[0]]
    assert_allclose([slides[0][0][0], slides[1][0][-1]], ends, rtol=0, atol=1e-12)
    assert_allclose(*ends, rtol=0, atol=2e-8)  # the orbit closes to the error of RK4's steps
    (surface,) = ax.collections
    vertices = np.concatenate([path.vertices for path in surface.get_paths()])
    assert_allclose(vertices[:, 1], 1.0, rtol=0, atol=1e-9)
    assert "H = 0" in {t.get_text() for t in ax.get_legend().get_texts()}


def test_a_surface_that_is_the_whole_plane_is_not_in_the_legend():
    # Two masses that stick: the plane of their places, at the velocities of the end, has H = 0.
    class Pair(jf.System):
        def vector_field(self, t, x, side):
            return jnp.concatenate([x[2:], -x[:2] - side])

        def switching(self, t, x):
            return x[2:] - 0.1

    pair = Pair()
    ax = jf.plot.phase_portrait(solved(pair, [0.0, 0.2, 0.1, 0.1], 1.0), system=pair)
    assert not ax.collections
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["sliding", "start"]


def test_a_section_shows_every_finite_state():
    xs = np.arange(12.0).reshape(2, 3, 2)
    xs[1, 2] = np.nan
    (dots,) = jf.plot.poincare_section(xs).lines
    assert_array_equal(np.array(dots.get_data()).T, xs.reshape(-1, 2)[:5])
    with pytest.raises(ValueError, match=r"`components\[1\]` must be an integer from 0 to 1"):
        jf.plot.poincare_section(xs, components=(0, 2))
    with pytest.raises(ValueError, match="`components` must be 2 or 3 numbers of components"):
        jf.plot.poincare_section(xs, components=0)


def test_multipliers_inside_and_outside_the_unit_circle():
    values = jnp.array([0.5 + 0.5j, -2.0, jnp.nan])
    found = made(jf.Orbit, multipliers=values, system=jf.systems.SDOscillator())
    ax = jf.plot.multipliers(found)
    _, _, _, inside, outside = ax.lines
    assert_array_equal(np.array(inside.get_data()).ravel(), [0.5, 0.5])
    assert_array_equal(np.array(outside.get_data()).ravel(), [-2.0, 0.0])
    assert ax.get_aspect() == 1


def test_the_trivial_multiplier_of_an_autonomous_orbit_is_told_apart():
    values = jnp.array([[0.5, 1 + 1e-9], [1 - 1e-9, -2.0]])
    found = made(jf.Orbit, multipliers=values, system=jf.systems.SlipStick())
    ax = jf.plot.multipliers(found)
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["inside", "outside", "trivial"]
    assert_array_equal(ax.lines[-1].get_xdata(), [1 + 1e-9, 1 - 1e-9])


def test_a_branch_changes_its_style_at_the_located_point():
    orbits = made(
        jf.Orbit,
        stable=np.array([True, True, False]),
        x0=jnp.array([[1.0, 0.0], [2.0, 0.0], [4.0, 0.0]]),
        system=jf.systems.SDOscillator(),
    )
    point = types.SimpleNamespace(kind="period-doubling", value=1.25, index=2)
    branch = unchecked(
        jf.Branch,
        parameter="omega",
        values=np.array([0.0, 1.0, 2.0]),
        orbits=orbits,
        points=[point],
    )
    ax = jf.plot.branch(branch)
    solid, dashed = (np.array(line.get_data()) for line in ax.lines[:2])
    assert_array_equal(solid, [[0, 1, 1.25, 2], [1, 2, 2.5, np.nan]])
    assert_array_equal(dashed, [[0, 1, 1.25, 2], [np.nan, np.nan, 2.5, 4]])


@pytest.mark.release
def test_exponents_by_synchronisation():
    def pull(t, x):
        return 1 - 0.5 * x

    decay = jf.piecewise(pull, pull, lambda t, x: x[0] + 1e9)
    x0, couplings = jnp.ones(1), jnp.array([-0.8, -0.7, 0.3, 0.5])
    run = {"periods": 40, "transient": 0, "interval": 1.0, "stepper": jf.RK4()}
    found = jf.synchronization_exponent(decay, x0, couplings, **run)
    ax = found.plot()
    apart, together = ax.lines[:2]
    assert_array_equal(np.append(apart.get_xdata(), together.get_xdata()), couplings)
    assert_array_equal(together.get_xdata(), couplings[np.asarray(found.synchronized)])
    assert "couplings from -0.8 to 0.5" in repr(found)
    rate = jf.transverse_exponent(decay, x0, coupling=0.2, **run)
    (line,) = rate.plot().lines
    assert_allclose(line.get_ydata(), -0.5, rtol=1e-3)
    assert repr(rate).startswith("TransverseExponent: successful")
    spectrum = jf.lyapunov_spectrum(decay, x0, **run)
    (line,) = spectrum.plot().lines
    assert_allclose(line.get_ydata(), -0.5, rtol=1e-3)
    assert "-0.5 ± " in repr(spectrum)


def test_a_solution_draws_itself():
    assert sticking().plot().get_ylabel() == "x', m/s"
    decay = jf.piecewise(lambda t, x: -x, lambda t, x: -x, lambda t, x: x[0])
    assert solved(decay, [1.0], 1.0).plot().get_ylabel() == "x[0]"


def test_an_impact_breaks_the_line_and_a_dotted_one_leads_to_where_it_goes_on():
    ball = jf.systems.BouncingBall()
    sol = solved(ball, [10.0, 0.0], 4.5)
    for picture, columns in (
        (jf.plot.phase_portrait(sol, system=ball), (0, 1)),
        (jf.plot.time_history(sol, components=1, system=ball), (1,)),
    ):
        drawn = picture.lines[0].get_xydata()
        assert np.isnan(drawn[:, -1]).sum() == 2
        assert np.nanmax(np.diff(drawn[:, -1])) < 1, "no stroke leads through an impact"
        (jump,) = (line for line in picture.lines if line.get_linestyle() == ":")
        before, after, gap = np.reshape(jump.get_xydata(), (2, 3, 2)).swapaxes(0, 1)
        assert_allclose(after[:, 1], -float(ball.restitution) * before[:, 1], rtol=1e-15)
        assert np.isnan(gap[:, 1]).all()
        hits = marked(picture, EventKind.impact)
        at = sol.events.xs[:2, np.array(columns)]
        assert_array_equal(hits[:, -len(columns) :], at)


class Dosed(jf.System):
    """It falls at the rate 1/10 and is given 2/5 at each whole time, over the threshold 1."""

    def vector_field(self, t, x, side):
        return jnp.stack([-0.1 + 0 * side, -x[1]])

    def switching(self, t, x):
        return 1 - x[0]

    def tick(self, t, x, clock):
        return x + jnp.array([0.4, 0.7])

    @property
    def clocks(self):
        return (jf.Clock(1.0),)


def test_a_tick_breaks_the_line_too_and_has_marks_of_its_own():
    sol = solved(Dosed(), [0.2, 0.5], 4.0)
    assert "carry" in repr(sol.events)
    for picture, kinds in (
        (jf.plot.phase_portrait(sol), (EventKind.tick, EventKind.carry)),
        (jf.plot.time_history(sol, components=0), (EventKind.tick,)),
        (jf.plot.event_timeline(sol), (EventKind.tick, EventKind.carry)),
    ):
        told = {text.get_text() for text in picture.get_legend().get_texts()}
        assert {kind.name for kind in kinds} <= told
    portrait = jf.plot.phase_portrait(sol)
    drawn = portrait.lines[0].get_xydata()
    assert np.nanmax(np.diff(drawn[:, 1])) < 0.1, "no stroke leads through a tick"
    jumps = [line.get_xydata() for line in portrait.lines if line.get_linestyle() == ":"]
    before, after, _ = np.reshape(jumps, (-1, 3, 2)).swapaxes(0, 1)
    assert_allclose(after - before, [[0.4, 0.7]] * 4, rtol=0, atol=1e-15)
    jf.plot.animation(sol, frames=2).to_jshtml()


def test_an_orbit_is_drawn_with_the_wall_it_hits():
    wall = jf.systems.ImpactOscillator(omega=0.8, amplitude=1.5)
    motion = solved(wall, [0.0, 2.0], 3.0)
    orbit = made(jf.Orbit, trajectory=lambda self: motion, system=wall)
    ax = orbit.plot()
    assert "H = 0" in {t.get_text() for t in ax.get_legend().get_texts()}
    vertices = np.concatenate([path.vertices for path in ax.collections[0].get_paths()])
    assert_allclose(vertices[:, 0], 1.0, rtol=0, atol=1e-9)


def test_a_batch_is_drawn_whole_with_one_entry_of_each_kind():
    sol = sticking()
    batch = jax.tree.map(lambda a: jnp.stack([a] * 5), sol)
    for picture in (jf.plot.phase_portrait, jf.plot.time_history):
        ax = picture(batch, color="C3", lw=0.5, label="five")
        lines = [line for line in ax.lines if line.get_label() == "five"]
        assert len(lines) == 5
        assert {(line.get_color(), line.get_linewidth()) for line in lines} == {("C3", 0.5)}
        told = [text.get_text() for text in ax.get_legend().get_texts()]
        assert len(told) == len(set(told)) and "five" in told
    ax = jf.plot.phase_portrait(sol)
    jf.plot.phase_portrait(sol, ax)
    told = [text.get_text() for text in ax.get_legend().get_texts()]
    assert len(told) == len(set(told)), "a second motion on the same axes adds no entry"


def test_a_lane_that_stops_at_its_start_is_left_out():
    """At (0, 0) the motion of the oscillator is not unique."""

    def run(x0):
        saveat = diffrax.SaveAt(t0=True, steps=True)
        return jf.solve(
            jf.systems.SDOscillator(), x0, 0.0, 1.0, 0.1, saveat=saveat, throw=False, compact=True
        )

    x0 = jnp.array([[0.3, 0.1], [0.0, 0.0], [1.2, 0.0]])
    batch = jax.vmap(run)(x0)
    for picture, axis in ((jf.plot.phase_portrait, 0), (jf.plot.time_history, 1)):
        ax = picture(batch, label="lane")
        lines = [line for line in ax.lines if line.get_label() == "lane"]
        assert_allclose([line.get_xydata()[0, axis] for line in lines], [0.3, 1.2])
        with pytest.raises(ValueError, match=r"must hold two saved times .* stopped .* nonunique"):
            picture(run(x0[1]))


def test_components_and_three_dimensions():
    sol = solved(PROBLEMS["belt 1.3"].system, [0.5, 0.2], 2.0)
    ax = jf.plot.phase_portrait(sol, components=(1, 0))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x', m/s", "x, m")
    both = jf.plot.time_history(sol, components=(0, 1))
    assert [line.get_label() for line in both.lines[:2]] == ["x, m", "x', m/s"]
    assert_array_equal(both.lines[1].get_ydata(), ax.lines[0].get_xdata())

    class Three(jf.System):
        def vector_field(self, t, x, side):
            return jnp.stack([x[1], -x[0] - 0.3 * side, x[0]])

        def switching(self, t, x):
            return x[1]

    space = jf.plot.phase_portrait(solved(Three(), [1.0, 0.0, 0.0], 4.0), components=(0, 1, 2))
    assert space.name == "3d" and space.get_zlabel() == "x[2]"
    with pytest.raises(ValueError, match='`ax` must have projection="3d", got "rectilinear"'):
        jf.plot.poincare_section(np.zeros((3, 3)), ax, components=(0, 1, 2))


def test_a_scale_of_colours_is_placed_or_refused():
    (own,) = plt.figure().subplots(1, 1, squeeze=False)[0]
    beside = own.figure.add_axes((0.9, 0.1, 0.05, 0.8))
    jf.plot.basins(basins(), own, colorbar=beside)
    assert own.figure.axes == [own, beside] and beside.get_yticklabels()
    alone = jf.plot.basins(basins(), plt.figure().add_subplot(), colorbar=False)
    assert alone.figure.axes == [alone]
    with pytest.raises(ValueError, match="`colorbar` must be True, False or the matplotlib axes"):
        jf.plot.basins(basins(), own, colorbar="left")


def test_a_lane_that_diverges_does_not_set_the_axis():
    diagram = swept(points=40)
    diagram.xs[7] = 1e78
    ax = jf.plot.bifurcation_diagram(diagram)
    assert ax.get_ylim()[1] < 10
    assert ax.texts[0].get_text() == "4 samples beyond the axis, to 1e+78"


def test_a_component_of_a_map_of_periods_is_refused():
    with pytest.raises(ValueError, match="`component` must be omitted for a grid"):
        periods().plot(component=1)


def test_more_attractors_than_colours_are_told_apart():
    for count in (6, 7, 18, 40):
        assert len(set(shades(count))) == count


@pytest.mark.slow
def test_what_cannot_be_drawn_is_refused_with_a_reason():
    sol = sticking()
    ball = jf.systems.BouncingBall()
    with pytest.raises(ValueError, match="`components` must be an integer from 0 to 1, got 2"):
        jf.plot.time_history(sol, components=2)
    with pytest.raises(ValueError, match="`component` must be an integer from 0 to 1, got 5"):
        jf.plot.bifurcation_diagram(swept(), component=5)
    with pytest.raises(ValueError, match="two saved times or more"):
        jf.plot.phase_portrait(jf.solve(ball, jnp.array([10.0, 0.0]), 0.0, 1.0, 0.1))
    up, down = (lambda t, x: jnp.ones(1)), (lambda t, x: -jnp.ones(1))
    with pytest.raises(ValueError, match="two components or more, got 1"):
        jf.plot.phase_portrait(solved(jf.piecewise(down, up, lambda t, x: x[0]), [1.0], 2.0))


def spectrum(exponents, settled=True, error=0.01):
    """A batch of spectra, or one, with made-up numbers."""
    exponents = np.asarray(exponents, float)
    lanes, n = exponents.shape[:-1], exponents.shape[-1]
    times = np.broadcast_to(np.array([10.0, 20.0, 40.0]), (*lanes, 3))
    return unchecked(
        jf.LyapunovSpectrum,
        exponents=exponents,
        standard_error=np.full((*lanes, n), error),
        running=exponents[..., None, :] + np.array([0.3, 0.1, 0.0])[:, None],
        times=times,
        x0=np.zeros((*lanes, n)),
        x_final=np.zeros((*lanes, n)),
        settled=np.broadcast_to(settled, lanes),
        result=RESULTS.successful,
    )


def test_exponents_against_a_parameter():
    values = np.array([1.0, 2.0, 3.0, 4.0])
    found = spectrum(
        [[0.5, -np.inf], [0.4, -1.0], [0.3, -2.0], [np.nan, np.nan]],
        settled=[True, True, False, False],
    )
    ax = jf.plot.lyapunov_exponents(values, found, parameter="omega")
    drawn = {}
    for line in ax.lines[1:]:  # the first is zero
        key = (line.get_label().split("_")[0], line.get_fillstyle(), line.get_marker())
        drawn.setdefault(key, []).append(np.transpose(line.get_data()).tolist())
    assert drawn["λ₁", "full", "o"] == [[[1.0, 0.5], [2.0, 0.4]]]
    assert drawn["λ₂", "full", "o"] == [[[2.0, -1.0]]]
    assert drawn["not settled", "none", "o"] == [[[3.0, 0.3]]]  # told once
    assert drawn["", "none", "o"] == [[[3.0, -2.0]]]
    ((tick,),) = drawn["λ₂ = −∞", "full", "|"]
    assert tick[0] == 1.0
    assert ax.get_xlabel() == "omega" and ax.get_xlim() == (1.0, 4.0)


def test_the_running_estimate_and_its_band():
    ax = jf.plot.lyapunov_convergence(spectrum([0.5, -np.inf]))
    line, infinite = ax.lines
    assert infinite.get_label() == "λ₂ = −∞" and not len(infinite.get_xdata())
    assert_allclose(np.transpose(line.get_data()), [[10, 0.8], [20, 0.6], [40, 0.5]])
    assert line.get_label() == "λ₁ = 0.5"
    edges = ax.collections[0].get_paths()[0].vertices
    assert_allclose([edges[:, 1].min(), edges[:, 1].max()], [0.48, 0.52])


def test_exponents_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="`spectrum` must hold one spectrum for each of 3 values"):
        jf.plot.lyapunov_exponents(np.zeros(3), spectrum(np.zeros((2, 2))))
    with pytest.raises(ValueError, match="`spectrum` must be of one lane"):
        jf.plot.lyapunov_convergence(spectrum(np.zeros((2, 2))))


# The argument of each picture that is a result, and what it must be.
DRAWN = {
    "animation": ("sol", "a jaxfil.Solution"),
    "bifurcation_sequence": ("found", "a jaxfil.BifurcationSequence"),
    "event_timeline": ("sol", "a jaxfil.Solution"),
    "exponent_map": ("spectrum", "a jaxfil.LyapunovSpectrum"),
    "path_in_time": ("sol", "a jaxfil.Solution"),
    "return_map": ("xs", "states of shape (k, n) with k > 1"),
    "section_density": ("xs", "states of shape (k, n) with n > 1"),
    "step_choice": ("choice", "a jaxfil.StepChoice"),
    "averages": ("diagram", "a jaxfil.BifurcationDiagram"),
    "basins": ("found", "a jaxfil.Basins"),
    "bifurcation_curve": ("curve", "a jaxfil.BifurcationCurve or a jaxfil.EquilibriumCurve"),
    "bifurcation_diagram": ("diagram", "a jaxfil.BifurcationDiagram"),
    "branch": ("branch", "a jaxfil.Branch"),
    "branch_orbits": ("branch", "a jaxfil.Branch"),
    "equilibrium_branch": ("branch", "a jaxfil.EquilibriumBranch"),
    "lyapunov_convergence": (
        "spectrum",
        "a jaxfil.LyapunovSpectrum or a jaxfil.TransverseExponent",
    ),
    "lyapunov_exponents": ("spectrum", "a jaxfil.LyapunovSpectrum"),
    "multipliers": ("orbit", "a jaxfil.Orbit or a jaxfil.Branch"),
    "parameter_map": ("diagram", "a jaxfil.BifurcationDiagram"),
    "phase_portrait": ("sol", "a jaxfil.Solution"),
    "poincare_section": ("xs", "states of shape (k, n) with n > 1"),
    "synchronization": ("found", "a jaxfil.Synchronization"),
    "time_history": ("sol", "a jaxfil.Solution"),
    "work_precision": ("table", "a jaxfil.WorkPrecision"),
}


@pytest.mark.parametrize("name", sorted({*PICTURES} - {"phase_plane", "sliding_region"}))
def test_another_result_is_refused_by_its_name(name):
    argument, must = DRAWN[name]
    draw = getattr(jf.plot, name)
    before = {"lyapunov_exponents": VALUES, "exponent_map": (VALUES, VALUES)}
    before = {"values": before[name]} if name in before else {}
    for wrong in (None, np.zeros(3), jf.systems.SDOscillator(), jf.Bifurcation):
        with pytest.raises(ValueError) as told:
            draw(**before, **{argument: wrong})
        sentence, was = f"`{argument}` must be {must}, got ", type(wrong).__name__
        if argument == "xs" and was == "ndarray":
            was = "shape (3,)"
        elif isinstance(wrong, type) and argument != "xs":
            was = f"the class {wrong.__name__}"
        elif argument != "xs":
            was = "None" if wrong is None else f"an object of type {was}"
        assert str(told.value) == f"{sentence}{was}."
    for public in re.findall(r"jaxfil\.(\w+)", must):
        assert hasattr(jf, public)
    with pytest.raises(ValueError, match="`ax` must be matplotlib axes or None, got SDOscillator"):
        PICTURES[name](jf.systems.SDOscillator())


def test_surfaces_and_names_of_no_system_are_refused():
    with pytest.raises(ValueError, match=r"instance of jaxfil\.System, got str"):
        jf.plot.phase_portrait(sticking(), system="belt")
    with pytest.raises(ValueError, match=r"instance of jaxfil\.System, got str"):
        jf.plot.poincare_section(np.zeros((3, 2)), system="belt")
