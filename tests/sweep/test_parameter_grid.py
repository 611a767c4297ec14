"""Sweeps over several parameters, the periods that they find, and their map."""

import dataclasses

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.colors
import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import jaxfil as jf
from jaxfil.model.outcomes import outcome_codes, outcomes

matplotlib.use("Agg")

SD = jf.systems.SDOscillator()
X0 = np.array([0.3, 0.1])
NAMES = ("omega", "f0")
OMEGA, F0 = np.array([0.7, 0.9, 0.8]), np.array([0.2, 0.3])


def sweep(values, x0=X0, parameter=NAMES, samples=2, **kwargs):
    return jf.bifurcation_diagram(
        SD, parameter, values, x0, transient=3, samples=samples, steps=20, progress=False, **kwargs
    )


@pytest.fixture(scope="module")
def grid():
    return sweep((OMEGA, F0))


def test_a_grid_is_the_sweeps_along_its_lines(grid):
    assert grid.xs.shape == (3, 2, 2, 2) and grid.successful.shape == (3, 2)
    assert grid.parameter == NAMES
    for j, f0 in enumerate(F0):
        system = jf.systems.SDOscillator(f0=f0)
        line = jf.bifurcation_diagram(
            system, "omega", OMEGA, X0, transient=3, samples=2, steps=20, progress=False
        )
        np.testing.assert_allclose(grid.xs[:, j], line.xs, rtol=1e-11)
    assert "  omega: 3 values from 0.7 to 0.8\n  f0: 2 values from 0.2 to 0.3\n" in repr(grid)


def test_points_are_those_of_the_grid(grid):
    rows = np.array([[0.9, 0.3], [0.8, 0.2]])
    points = sweep(jnp.asarray(rows))
    assert_array_equal(points.xs, [grid.xs[1, 1], grid.xs[2, 0]])
    assert_array_equal(points.values, rows)
    assert "omega, f0: 2 points" in repr(points)


def test_a_state_for_each_point_of_a_grid(grid):
    states = np.broadcast_to(X0, (3, 2, 2)).copy()
    states[1, 1] = -0.4
    other = sweep((OMEGA, F0), states)
    same = np.ones((3, 2), bool)
    same[1, 1] = False
    assert_array_equal(other.xs[same], grid.xs[same])
    assert not np.allclose(other.xs[1, 1], grid.xs[1, 1])


def test_datasets_keep_the_shape(grid):
    data = grid.to_xarray()
    assert data["x"].dims == ("omega", "f0", "sample", "component")
    assert data["outcome"].shape == (3, 2) and "f0" not in data.attrs
    assert_array_equal(data["x"].sel(omega=0.9, f0=0.3), grid.xs[1, 1])
    points = sweep(np.array([[0.9, 0.3], [0.8, 0.2]])).to_xarray()
    assert points["x"].dims == ("point", "sample", "component")
    assert_array_equal(points["f0"], [0.3, 0.2])


@pytest.mark.parametrize(
    "change, message",
    [
        (
            {"parameter": ("omega", "omega")},
            r"`parameter` must be a string, or two or more different ones",
        ),
        ({"parameter": ("omega",)}, r"`parameter` must be a string, or two or more different ones"),
        ({"parameter": ("omega", "nu")}, r"`parameter` must be a parameter of SDOscillator.*'nu'"),
        ({"values": (OMEGA,)}, r"`values` must be 2 arrays.*shape \(p, 2\).*got 1 of them"),
        ({"values": OMEGA}, r"`values` must be of shape \(p, 2\).*got shape \(3,\)"),
        ({"values": (OMEGA, [])}, r"`values` must be real numbers .* each name, got shape \(0,\)"),
        ({"values": np.zeros((0, 2))}, r"`values` must be real numbers of shape \(p, 2\)"),
        ({"x0": np.zeros((3, 3, 2))}, r"`x0` must be of shape \(n,\), or \(3, 2, n\)"),
        ({"follow": "up"}, "`follow` must be None with several parameters, got 'up'"),
    ],
)
def test_bad_calls(change, message):
    with pytest.raises(ValueError, match=message):
        sweep(**{"values": (OMEGA, F0), **change})


class Tanks(jf.System):
    """Each of several tanks, x' = 1 - r x."""

    r: jax.Array
    period = 1.0

    def vector_field(self, t, x, side):
        return 1.0 - self.r * x


@pytest.mark.parametrize(
    "parameter, message",
    [
        ("r", "`parameter` must name a scalar parameter, got 'r', which is an array"),
        (("r", "r[0]"), "`parameter` must name a scalar parameter, got 'r', which is an array"),
        (("r[0]", "r[-2]"), r"`parameter` must be .* different ones, got \('r\[0\]', 'r\[-2\]'\)"),
    ],
)
def test_a_name_in_a_sweep_is_of_one_number_of_its_own(parameter, message):
    """A whole array would have each of its entries set to the swept value, and of two names of one
    entry the last one would count."""
    values = [1.0, 2.0] if isinstance(parameter, str) else np.array([[1.0, 2.0]])
    with pytest.raises(ValueError, match=message):
        jf.bifurcation_diagram(Tanks(jnp.array([1.0, 5.0])), parameter, values, jnp.zeros(2))


def with_samples(grid, xs):
    """The grid with other samples; NaN where it failed."""
    failed = np.isnan(xs).any(axis=(-1, -2))
    names = np.where(failed, "nonfinite", "successful")
    return dataclasses.replace(grid, xs=xs, results=outcomes(outcome_codes(names)))


@pytest.fixture(scope="module")
def motions(grid):
    """Periods 1, 3, 7 and 8 in one component, none, and a failed lane."""
    k, rng = np.arange(40), np.random.default_rng(0)
    xs = np.full((3, 2, 40, 2), 0.5)
    for where, period in {(0, 1): 3, (1, 0): 7, (1, 1): 8}.items():
        xs[(*where, slice(None), 1)] = np.cos(2 * np.pi * k / period)
    xs[2, 0, :, 0] = rng.normal(size=40)
    xs[2, 1, 3] = np.nan
    return with_samples(grid, xs)


def test_a_component_that_has_decayed_has_no_period(motions):
    # One decays to the smallest numbers, one is the rounding of the other.
    k, rng = np.arange(40), np.random.default_rng(1)
    for passenger in (1e-300 * 0.5**k, 1e-16 * rng.normal(size=40)):
        xs = np.stack([np.cos(np.pi * k), passenger], axis=-1)
        both = dataclasses.replace(motions, xs=np.broadcast_to(xs, (3, 2, 40, 2)))
        assert both.periods()[0, 0] == 2


def test_periods_are_counted(motions):
    assert_array_equal(motions.periods(), [[1, 3], [7, 8], [0, -1]])
    wobble = dataclasses.replace(motions, xs=motions.xs + 1e-3 * np.arange(40)[:, None] / 40)
    assert wobble.periods()[0, 0] == 1
    assert wobble.periods(tolerance=1e-5)[0, 0] == 0


def test_the_map_shows_each_point_in_the_colour_of_its_period(motions):
    _, axes = plt.subplots()
    assert motions.plot(axes) is axes
    (picture,) = axes.collections
    drawn = picture.to_rgba(picture.get_array())
    colors = jf.plot.PERIODS
    # Values in ascending order: 0.7, 0.8, 0.9 along x.
    expected = [[colors[1], colors[0], colors[7]], [colors[3], colors[-1], colors[7]]]
    for row, names in zip(drawn, expected, strict=True):
        for color, name in zip(row, names, strict=True):
            assert_array_equal(color, matplotlib.colors.to_rgba(name))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Ω", "f₀")
    legend = axes.figure.axes[1].get_yticklabels()
    assert [text.get_text() for text in legend] == ["1", "3", "7–20", "> 20", "failed"]
    plt.close("all")


def test_a_value_that_is_no_number_is_left_out_of_the_map(motions):
    lost = dataclasses.replace(motions, values=(np.array([0.7, np.nan, 0.8]), F0))
    ax = jf.plot.parameter_map(lost)
    assert ax.collections[0].get_array().shape == (2, 2)
    plt.close("all")


def test_only_a_grid_of_two_has_a_map(grid):
    with pytest.raises(
        ValueError, match=r"a grid of two parameters.*omega, f0 in the shape \(2,\)"
    ):
        sweep(np.array([[0.9, 0.3], [0.8, 0.2]])).plot()
    with pytest.raises(ValueError, match=r"two values or more of each.*shape \(3, 1\)"):
        sweep((OMEGA, F0[:1])).plot()
    with pytest.raises(ValueError, match=r"a sweep of one parameter, got omega, f0"):
        jf.plot.bifurcation_diagram(grid)
