"""The figures of Santhosh et al. (2016), small: their numbers against references worked out apart
from this library (closed forms per piece, 60-digit Newton, long-double Taylor series)."""

import itertools
import re

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf

pytest.importorskip("benchmarks", reason="the sources of a release do not have them")

from benchmarks.page import pages
from benchmarks.paper import canvas, fig4, fig5, fig6, fig8, fig9, fig10, fig11, section5
from benchmarks.paper.__main__ import RESULTS
from benchmarks.paper.captions import CAPTIONS
from benchmarks.paper.figure import FIGURES
from benchmarks.paper.spectra import change_on_doubling, spectra
from benchmarks.paper.sweeps import sweep_of
from benchmarks.paper.table import WIDTHS, Row, layout
from tests.problems.values import BELT_DAMPING, CUBIC_JUMPS, CUBIC_LYAPUNOV

# Of the orbit that never sticks.
ORBITAL = BELT_DAMPING / 2


def test_a_table_has_every_row_and_wraps_long_cells():
    text = layout("Title", [Row("a", "0.87", 1 / 3, 0.25, "why " * 30, 4), Row("b", "", -np.inf)])
    title, blank, head, rule, *lines = text.splitlines()
    assert title == "Title" and blank == "" and head.startswith("quantity") and set(rule) <= {*"- "}
    assert lines[0].split()[:4] == ["a", "0.87", "0.3333", "0.25"] and len(lines) > 3
    assert lines[-1].split() == ["b", "−∞"] and max(map(len, lines)) <= len(rule)


def test_fig4_harmonic_balance_is_the_closed_form():
    # Amplitude f0/√((1−Ω²)² + (2ζΩ)²): 1 at the two grazing values, so just below it just inside.
    assert_allclose([abs(fig4.response(v)) for _, v in fig4.GRAZING.values()], 1, rtol=1e-13)
    values = np.array([0.6, 0.866716, 1.117143, 1.3])
    size = fig4.response(values)
    circles, lines, distance, found, result = fig4.orbits(
        jnp.asarray(values), jnp.asarray(size.real)
    )
    assert np.all(result == jf.RESULTS.successful) and distance.max() < 1e-11
    assert_allclose(found, abs(size), rtol=1e-12)
    assert circles[..., 0].min() > 0 and lines.shape[1] == 8 * fig4.CIRCLES + 1


@pytest.mark.release
def test_fig5_smoothed_lanes_are_what_they_are_alone():
    # XLA's own arctangent is wrong for 50 lanes and more (jax-ml/jax issue 39352).
    values, counts = np.linspace(0.6, 1.3, 64), {"periods": 1, "transient": 1, "steps": 100}
    batch = spectra(fig5.smooth, values, fig5.X0, **counts).x_final
    for i in (0, 5, 21, 63):
        system, x0 = fig5.smooth(values[i]), jnp.asarray(fig5.X0)
        sol = jf.solve(system, x0, 0.0, 2 * system.period, system.period / 100)
        assert_allclose(batch[i], sol.x_final, rtol=1e-9)
    assert change_on_doubling(fig5.smooth, values[::16], jnp.asarray(fig5.X0), 300) < 1e-6


def test_fig5_starts_on_the_orbit():
    values = np.array([0.6, 0.8, 0.866])
    size = fig5.response(values)
    assert_allclose(fig5.on_orbit(values)[:, 0], 1 + size.real, rtol=1e-15)
    back = sweep_of(jf.systems.SDOscillator, values, fig5.on_orbit(values), 7, 2)
    assert_allclose(back, np.stack([fig5.on_orbit(values)] * 2, axis=1), rtol=0, atol=1e-9)


def test_fig5_finds_where_chaos_is():
    exponents = np.array([[-0.01, 0.0], [0.09, 0.0], [0.05, 0.0], [-0.01, 0.0]])
    assert fig5.edges(np.array([0.8, 0.87, 1.1, 1.2]), exponents[:, 0]) == "0.8700 to 1.1000"


@pytest.mark.release
@pytest.mark.long_run
def test_fig6_tells_chaos_from_periodic_motion_and_knows_how_long_it_lives():
    turn = np.arange(fig6.LOOK)
    one_sided, both_sides = 1 + 0.1 * turn % 2, np.cos(2 * np.pi * turn / 8)
    noise = np.random.default_rng(0).normal(size=fig6.LOOK)
    assert_array_equal(fig6.chaotic(np.stack([one_sided, both_sides, noise])), [0, 0, 1])
    life, error = fig6.mean_life(512, np.random.default_rng(0))
    assert 8 < error < 20 and abs(life - 144) < 4 * error  # of 2,048 lanes
    size = fig4.response(0.7)
    start = np.array([1 + size.real, -(size * 0.7).imag])
    states = fig6.sweep(np.array([0.7]), start, 50, 4)
    assert_allclose(
        states[0], np.tile(start, (4, 1)), rtol=0, atol=1e-9
    )  # t = 0 of the closed form


@pytest.mark.release
@pytest.mark.long_run
def test_fig10_finds_the_jump_and_the_two_attractors():
    value, error = fig10.jump(16, 200, rounds=6)
    assert abs(value - CUBIC_JUMPS) < 5e-9 + error and error < 1e-8  # known to nine digits
    inside, outside = (fig10.basin(omega, 3, 60) for omega in (4.55, 4.58))
    assert inside.any() and not outside.all()
    rest = fig10.sweep(np.array([4.55, 4.58]), fig10.REST, 200, 20)
    assert_array_equal(fig10.on_orbit(rest), [True, False])
    assert_array_equal(fig10.chaotic(rest), [False, True])


@pytest.mark.release
def test_fig11_exponents():
    _, sharp, orbit = fig11.batch(
        fig11.exact, np.array([4.6]), 30, {"periods": 300, "transient": 200}
    )
    error = np.std(sharp) / np.sqrt(29)
    assert abs(np.mean(sharp) - CUBIC_LYAPUNOV) < 4 * error and error < 0.008
    assert_allclose(orbit.exponents.sum(), 2 * ORBITAL, rtol=1e-6)
    assert np.all(abs(orbit.exponents - ORBITAL) < 4 * orbit.standard_error)


def cells(line):
    """The columns of a line of a table."""
    edges = np.cumsum([0, *(w + 2 for w in WIDTHS.values())])
    return [line[i:j].strip() for i, j in itertools.pairwise(edges)]


def number(text):
    """A value and its error, from 0.25, 0.378 ± 0.002 or 0.3799(4); None if it is no number."""
    found = re.fullmatch(r"(-?[\d.]+)(?: ± ([\d.]+)|\((\d+)\))?", text.replace("−", "-"))
    if not found:
        return None
    value, error, digits = found.groups()
    last = 10.0 ** -len(value.partition(".")[2])
    return float(value), float(error or 0) + float(digits or 0) * last + 0.5 * last


@pytest.mark.parametrize("name", ["fig4", "fig5", "fig8", "fig9", "fig11", "section5"])
def test_a_committed_table_agrees_with_its_references(name):
    # Within four standard errors, and a thousandth for what a finite run leaves.
    checked = 0
    for line in (RESULTS / f"{name}.txt").read_text().splitlines()[4:]:
        what, _, found, reference, _ = cells(line)
        pair = number(found), number(reference)
        if None in pair or "smallest" in what:
            continue
        (value, error), (exact, known) = pair
        assert abs(value - exact) <= 4 * np.hypot(error, known) + 1e-3 * abs(exact), line
        checked += 1
    assert checked >= 4


def test_every_figure_has_its_title_and_its_maker():
    modules = (fig4, fig5, fig6, fig8, fig9, fig10, fig11, section5)
    assert [module.__name__.rpartition(".")[2] for module in modules] == list(FIGURES)
    assert all(callable(module.make) and module.TITLE for module in modules)
    letters = {name for name in fig8.NAMES.values() if name in "abcd"}
    assert letters == {*"abcd"} and len(fig8.NAMES) == 9


def test_the_results_pages_are_what_their_command_writes():
    assert {path: path.read_text() for path in pages()} == pages()


def test_every_figure_is_put_beside_the_papers_and_printed_without_loss():
    assert list(CAPTIONS) == list(FIGURES)
    for name in FIGURES:
        assert (RESULTS / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        width = int.from_bytes((RESULTS / f"{name}.png").read_bytes()[16:20])
        assert abs(width / canvas.PIXELS * 25.4 - canvas.PAGE) < 0.2  # millimetres
