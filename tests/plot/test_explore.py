"""Sliders over a motion: what is drawn is the motion at what they say, by one program."""

import sys

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from tests.oracles.compilations import Counter

X0, SPAN = jnp.array([3.0, 0.0]), (0.0, 14.0, 0.1)
COULOMB = jf.systems.CoulombOscillator()


def sliders(system=COULOMB, ranges=None, x0=X0, span=SPAN, **options):
    ranges = {"friction": (0.1, 1.0)} if ranges is None else ranges
    return jf.plot.explore(system, ranges, x0, *span, stepper=jf.RK4(), **options)


def drawn(figure):
    """Points of the path."""
    return figure.axes[0].lines[0].get_xydata()


@pytest.fixture(scope="module")
def portrait():
    """A portrait over one slider, and its figure."""
    figure = Figure()
    return sliders(figure=figure), figure


@pytest.mark.parametrize("friction", [0.7, 0.45])
def test_a_slider_moves_the_motion(portrait, friction):
    box, figure = portrait
    slider, image = box.children
    before = bytes(image.value)
    slider.value = friction
    # Turns of a mass with dry friction, at π, 2π, …, until it sticks where |x| ≤ F.
    turns = [3.0]
    while abs(turns[-1]) > friction:
        turns.append(-(turns[-1] - np.sign(turns[-1]) * 2 * friction))
    path = drawn(figure)
    ends = path[np.abs(path[:, 1]) < 1e-9, 0]
    for turn in turns:
        assert np.abs(ends - turn).min() < 2e-5
    assert before[:4] == b"\x89PNG" and image.value != before


def test_it_is_the_solution_of_solve(portrait):
    box, figure = portrait
    box.children[0].value = 0.55
    saveat = diffrax.SaveAt(t0=True, steps=True)
    system = jf.systems.CoulombOscillator(0.55)
    sol = jf.solve(system, X0, *SPAN, stepper=jf.RK4(), saveat=saveat)
    expected = jf.plot.phase_portrait(sol, Figure().add_subplot(), system=system)
    assert_allclose(drawn(figure), expected.lines[0].get_xydata(), rtol=1e-12, atol=1e-14)
    names = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert names == [text.get_text() for text in expected.get_legend().get_texts()]


def test_a_slider_that_moves_compiles_nothing(portrait):
    box, _ = portrait
    box.children[0].value = 0.3
    counter = Counter()
    counter.watch()
    before = dict(counter.counts)
    for friction in (0.31, 0.5, 0.8):
        box.children[0].value = friction
    found = counter.since(before)
    assert found["traces"] + found["compilations"] == 0


def test_it_starts_at_the_system_or_at_the_nearer_end():
    system = jf.systems.SDOscillator()
    ranges = {"zeta": (0.0, 0.1), "omega": (1.0, 1.5)}
    box = sliders(system, ranges, span=(0.0, 1.0, 0.1), picture=jf.plot.time_history)
    zeta, omega, _ = box.children
    assert (zeta.description, zeta.value, zeta.min, zeta.max) == ("ζ", 0.0141, 0.0, 0.1)
    assert (omega.description, omega.value) == ("Ω", 1.0)


class Blowing(jf.System):
    """x' = ax²: from 1 it is infinite at t = 1/a."""

    a: jax.Array

    def vector_field(self, t, x, side):
        return self.a * x**2


def test_a_motion_that_ends_early_is_told():
    figure = Figure()
    box = sliders(
        Blowing(jnp.array(0.1)),
        {"a": (0.1, 2.0)},
        jnp.array([1.0]),
        (0.0, 2.0, 0.1),
        picture=jf.plot.time_history,
        figure=figure,
    )
    assert [text.get_text() for text in figure.axes[0].texts] == []
    box.children[0].value = 2.0
    (told,) = (text.get_text() for text in figure.axes[0].texts)
    assert told.startswith(("nonfinite at t = ", "step_too_long at t = "))


@pytest.mark.slow
def test_another_picture_is_alone_on_the_figure():
    seen, figure = [], Figure()

    def picture(sol, ax, label):
        seen.append((sol, label))
        ax.figure.add_subplot()

    box = sliders(figure=figure, picture=picture, label="me", span=(0.0, 0.5, 0.1))
    box.children[0].value = 0.9
    assert len(seen) == 2 and len(figure.axes) == 2
    assert eqx.tree_equal(seen[0][0].ts, seen[1][0].ts) and seen[1][1] == "me"
    assert_array_equal(seen[0][0].xs[0], X0)


def test_wrong_arguments_are_named(monkeypatch):
    with pytest.raises(ValueError, match="must be a parameter of CoulombOscillator"):
        sliders(ranges={"mass": (0.0, 1.0)})
    for wrong in ((1.0, 0.1), (0.1,), ("a", "b"), (0.1, jnp.inf)):
        with pytest.raises(ValueError, match=r"`ranges\['friction'\]` must be \(low, high\)"):
            sliders(ranges={"friction": wrong})
    with pytest.raises(ValueError, match="`picture` must be a function of jaxfil"):
        sliders(picture="portrait")
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(ImportError, match=r"need the package ipywidgets: pip install 'jaxfil\[n"):
        sliders()
