"""Sections that ask for the side, the mode and the reaction, against motions worked out by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.sweep.identity import identity_of_section
from tests.problems.systems import UnitBelt


class Table(jf.System):
    """A mass that is pressed on its floor with 1 − a sin t, and another one that falls on its."""

    a: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.a * jnp.sin(t) - 1, x[3], -jnp.ones_like(t)])

    def switching(self, t, x):
        return jnp.stack([x[0], x[2]])

    def reset(self, t, x, surface):
        return x.at[2 * surface + 1].multiply(-0.5)


class Friction(eqx.Module):
    """The friction on the mass, over a level."""

    force: jax.Array
    level: jax.Array

    def __call__(self, t, x, side):
        return -self.force * side - self.level


def sticks(t, x, mode):
    return 0.5 - jnp.abs(mode)


def belt(force, level, **options):
    """A run from (−2, 0): it slips below the belt, above it, sticks, and slips again."""
    sections = (
        jf.Section(Friction(force, level)),
        jf.Section(sticks, direction=1),
        jf.Section(sticks, direction=-1),
        jf.maxima(lambda t, x, side: side * x[0]),
    )
    x0 = jnp.array([-2.0, 0.0])
    return jf.solve(UnitBelt(force), x0, 0.0, 4.5, 0.1, sections=sections, max_events=12, **options)


def times(force, level):
    """By hand: circles round ±F, of which the second one is left where the belt's velocity comes
    again; on the belt the spring grows by 1 in a unit of time."""
    radius = force + 2
    first = jnp.arcsin(1 / radius)
    above = 2 * force - jnp.sqrt(radius**2 - 1)
    stuck = first + 2 * jnp.arctan(-above)
    x = -force - above
    return first, stuck, stuck + level - x, stuck + force - x


def rows(sol):
    n = int(sol.num_crossings)
    return np.asarray(sol.crossings.ts)[:n], np.asarray(sol.crossings.sections)[:n]


@pytest.mark.slow
def test_where_it_begins_to_stick_and_how_hard_it_is_held_are_sections():
    force, level = jnp.array(1.25), jnp.array(0.5)
    sol = belt(force, level)
    ts, numbers = rows(sol)
    first, stuck, half, slips = (float(v) for v in times(force, level))
    # At the first contact friction turns round at once: its section is crossed by a jump.
    at = {0: [first, half], 1: [stuck], 2: [slips]}
    for k, exact in at.items():
        np.testing.assert_allclose(ts[numbers == k], exact, rtol=0, atol=1e-12)
    # F side = −x while it sticks: x side is largest where the spring is slack.
    slack = half - float(level)
    np.testing.assert_allclose(ts[numbers == 3], [slack], rtol=0, atol=1e-12)
    # What is watched changes no bit of the motion.
    alone = jf.solve(UnitBelt(force), jnp.array([-2.0, 0.0]), 0.0, 4.5, 0.1, max_events=12)
    assert np.array_equal(alone.x_final, sol.x_final)
    assert np.array_equal(alone.events.ts, sol.events.ts)


@pytest.mark.release
def test_derivatives_of_the_time_of_a_force_are_exact_to_the_second():
    z = jnp.array([1.25, 0.5])

    _, numbers = rows(belt(*z))
    place = int(np.flatnonzero(numbers == 0)[1])

    def exact(z):
        return times(*z)[2]

    def found(z):
        return belt(*z).crossings.ts[place]

    np.testing.assert_allclose(jax.jacfwd(found)(z), jax.grad(exact)(z), rtol=0, atol=1e-12)
    np.testing.assert_allclose(jax.hessian(found)(z), jax.hessian(exact)(z), rtol=0, atol=1e-10)


@pytest.mark.release
def test_how_hard_it_is_pressed_is_a_section_of_two_surfaces():
    """The floor presses back with 1 − a sin t, at rest from the start, as long as that is positive;
    the other mass falls for a time of 4."""
    sections = (
        jf.Section(lambda t, x, reaction: reaction[0] - 0.75),
        jf.maxima(lambda t, x, reaction: reaction[0]),
        jf.Section(lambda t, x, mode: mode[0] - 1.5),
    )

    @jax.jit
    def run(a):
        x0 = jnp.array([0.0, 0.0, 8.0, 0.0])
        return jf.solve(Table(a), x0, 0.0, 6.0, 0.1, sections=sections, max_events=40)

    ts, numbers = rows(run(jnp.array(0.5)))
    np.testing.assert_allclose(ts[numbers == 0], [np.pi / 6, 5 * np.pi / 6], rtol=0, atol=1e-12)
    np.testing.assert_allclose(ts[numbers == 1], [1.5 * np.pi], rtol=0, atol=1e-12)
    assert 2 not in numbers
    ts, numbers = rows(run(jnp.array(1.5)))
    np.testing.assert_allclose(ts[numbers == 0][0], np.arcsin(1 / 6), rtol=0, atol=1e-12)
    np.testing.assert_allclose(ts[numbers == 2][0], np.arcsin(2 / 3), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_diagram_is_sampled_at_a_force_and_averages_from_there_on():
    """From the jump of friction to where it has come back to two fifths of its limit."""
    forces = np.array([1.25, 1.5])
    diagram = jf.bifurcation_diagram(
        UnitBelt(jnp.array(1.0)),
        "force",
        forces,
        np.array([-2.0, 0.0]),
        transient=0,
        samples=2,
        section=jf.Section(lambda t, x, side: -side - 0.4),
        max_return=8.0,
        average=lambda t, x, mode: jnp.where(mode == 0, 1.0, 0.0),
        progress=False,
    )
    first, stuck, level, _ = times(forces, 0.4 * forces)
    np.testing.assert_allclose(diagram.times, np.stack([first, level], 1), rtol=0, atol=1e-11)
    np.testing.assert_allclose(diagram.xs[:, 1, 0], 0.4 * forces, rtol=0, atol=1e-11)
    share = (level - stuck) / (level - first)
    np.testing.assert_allclose(diagram.averages["average"], share, rtol=0, atol=1e-11)


def test_a_record_tells_apart_what_sections_ask_for():
    """The programs of these two are the same."""
    section, same = jf.Section(lambda t, x, side: side), jf.Section(lambda t, x, mode: mode)
    names = [identity_of_section(s, UnitBelt(jnp.array(1.0)), np.zeros(2)) for s in (section, same)]
    assert names[0] != names[1]


def test_what_a_section_cannot_be_given_is_refused_by_name():
    with pytest.raises(ValueError, match=r"`sections\[0\].function` must take \(t, x, side\), got"):
        solved(lambda t, x, a, b: x[0])
    with pytest.raises(ValueError, match="must be affine in its reactions"):
        solved(lambda t, x, reaction: reaction[0] ** 2)


def solved(function):
    x0 = jnp.array([0.0, 0.0, 8.0, 0.0])
    jf.solve(Table(jnp.array(0.5)), x0, 0.0, 6.0, 0.1, sections=jf.Section(function))


class Box(jf.System):
    """A ball in a box that is shaken, with dry friction on its floor: two walls and a surface."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -0.4 * side[2]])

    def switching(self, t, x):
        gap = x[0] - 0.8 * jnp.sin(t)
        return jnp.stack([0.3 + gap, 0.3 - gap, x[1] - 0.8 * jnp.cos(t)])

    def reset(self, t, x, surface):
        w = 0.8 * jnp.cos(t)
        return jnp.where(surface == 2, x, jnp.stack([x[0], w - 0.5 * (x[1] - w)]))


@pytest.mark.release
def test_a_section_of_the_mode_beside_friction_and_walls():
    # It sticks until the floor's acceleration, 0.8 sin t, exceeds the friction's.
    slips = jf.Section(lambda t, x, mode: jnp.abs(mode[2]) - 0.5)
    sol = jf.solve(Box(), jnp.array([0.25, 0.8]), 0.0, 0.6, 0.05, sections=slips)
    np.testing.assert_allclose(sol.crossings.ts[0], np.arcsin(0.5), rtol=1e-13)
