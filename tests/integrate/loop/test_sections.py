"""Sections: where they are crossed, how exactly, and that they change nothing.

Against closed forms of oscillators and flights, against matrix exponentials of a relay, and against
`scipy.integrate.solve_ivp`.
"""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names

EPS = np.finfo(float).eps


class Spring(jf.System):
    """Stiffness `above` where x > 0, and 1 where x < 0."""

    above: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.where(side > 0, self.above, 1.0) * x[0]])

    def switching(self, t, x):
        return x[0]


class Flight(jf.System):
    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])


def rows(sol):
    """Times, states and sections of the crossings that there were."""
    n = int(sol.num_crossings)
    return tuple(
        np.asarray(v)[:n] for v in (sol.crossings.ts, sol.crossings.xs, sol.crossings.sections)
    )


@pytest.mark.release
def test_crossings_of_a_spring_of_two_stiffnesses():
    """One section is its surface, which both its pieces end on; it starts on that too."""
    sections = (
        jf.Section(lambda t, x: x[0]),
        jf.Section(lambda t, x: x[0], direction=1),
        jf.Section(lambda t, x: x[0] - 0.25),
        jf.maxima(lambda t, x: x[0]),
    )
    x0 = jnp.array([0.0, 1.0])

    def run(above, sections=()):
        return jf.solve(Spring(above), x0, 0.0, 6.0, 0.1, sections=sections)

    sol = run(jnp.array(4.0), sections)
    ts, xs, numbers = rows(sol)
    # x = sin 2t / 2 to π/2, then −sin t for a time π.
    first = np.pi / 12
    half = 1.5 * np.pi
    exact = [
        (first, 2), (np.pi / 4, 3), (np.pi / 2 - first, 2), (np.pi / 2, 0),
        (half, 0), (half, 1), (half + first, 2), (half + np.pi / 4, 3),
    ]  # fmt: skip
    np.testing.assert_allclose(ts, [t for t, _ in exact], rtol=0, atol=2e-11)
    assert sorted(zip(ts.round(9), numbers, strict=True)) == [(round(t, 9), k) for t, k in exact]
    np.testing.assert_allclose(xs[numbers == 2, 0], 0.25, rtol=0, atol=8 * EPS)
    np.testing.assert_allclose(xs[numbers == 3], [[0.5, 0], [0.5, 0]], rtol=0, atol=2e-11)
    # What is watched changes no bit of the motion, and no contact.
    alone = run(jnp.array(4.0))
    assert np.array_equal(alone.x_final, sol.x_final) and alone.crossings is None
    assert np.array_equal(alone.events.ts, sol.events.ts) and sol.num_events == 2

    # d/dk of the time π/(2√k) to the quarter, and of the half-turn π/√k.
    by = np.asarray(jax.jacfwd(lambda k: run(k, sections).crossings.ts)(jnp.array(4.0)))
    turn = -0.5 * np.pi * 4**-1.5
    np.testing.assert_allclose(by[[1, 3, 4]], [turn / 2, turn, turn], rtol=1e-9)


@pytest.mark.slow
def test_what_jumps_across_zero_crosses_there_and_what_is_thrown_back_does_not():
    """A ball dropped from 1/2 falls for a time of 1, and flies for 1.6·0.8ⁿ⁻¹."""
    sections = (
        jf.Section(lambda t, x: x[0]),
        jf.Section(lambda t, x: x[1]),
        jf.minima(lambda t, x: x[0]),
        jf.maxima(lambda t, x: x[0]),
    )
    sol = jf.solve(
        jf.systems.BouncingBall(g=1.0, restitution=0.8),
        jnp.array([0.5, 0.0]),
        0.0,
        3.0,
        0.1,
        sections=sections,
        stepper=diffrax.Midpoint(),
    )
    ts, xs, numbers = rows(sol)
    assert numbers.tolist() == [1, 2, 1, 3, 1, 2]
    np.testing.assert_allclose(ts, [1, 1, 1.8, 1.8, 2.6, 2.6], rtol=0, atol=64 * EPS)
    np.testing.assert_allclose(xs[:3], [[0, 0.8], [0, 0.8], [0.32, 0]], rtol=0, atol=64 * EPS)


@pytest.mark.slow
def test_derivatives_of_a_crossing_are_exact_to_the_second():
    """A flight from the height h at the speed v ends at t = v + √(v² + 2h), with −√(v² + 2h)."""
    ground = jf.Section(lambda t, x: x[0], direction=-1)

    def landing(z, adjoint=diffrax.ForwardMode()):  # noqa: B008
        found = jf.poincare_map(
            Flight(), z, ground, 0.25, max_time=8.0, stepper=diffrax.Midpoint(), adjoint=adjoint
        )
        return jnp.stack([found.ts, found.xs[1]])

    def exact(z):
        root = jnp.sqrt(z[1] ** 2 + 2 * z[0])
        return jnp.stack([z[1] + root, -root])

    z = jnp.array([1.3, 2.1])
    np.testing.assert_allclose(landing(z), exact(z), rtol=16 * EPS)
    np.testing.assert_allclose(jax.jacfwd(landing)(z), jax.jacfwd(exact)(z), rtol=1e-13)
    found = jax.hessian(lambda z: landing(z)[0])(z)
    np.testing.assert_allclose(found, jax.hessian(exact)(z)[0], rtol=1e-10)


@pytest.mark.slow
def test_a_run_ends_at_a_crossing_or_at_a_bound_with_an_outcome_of_its_own():
    sections = (
        jf.Section(lambda t, x: x[0] - 0.5, terminal=2),
        jf.bound(lambda t, x: 3.0 - x[0]),
    )

    def run(v):
        x0 = jnp.stack([jnp.zeros_like(v), v])
        return jf.solve(
            Flight(), x0, 0.0, 4.0, 0.25, sections=sections, throw=False, stepper=diffrax.Midpoint()
        )

    # Twice through 1/2; too slow to come there; too fast; outside at t0 it would not start.
    sol = jax.vmap(run)(jnp.array([2.0, 0.5, 5.0]))
    names = [jf.RESULTS.section_reached, jf.RESULTS.successful, jf.RESULTS.out_of_bounds]
    for i, name in enumerate(names):
        assert bool((sol.result == name)[i])
    ends = [2 + np.sqrt(3), 4.0, 5 - np.sqrt(19)]
    np.testing.assert_allclose(sol.t_final, ends, rtol=16 * EPS)
    np.testing.assert_allclose(sol.xs[0, 0], [0.5, -np.sqrt(3)], rtol=16 * EPS)
    assert np.isinf(sol.xs[2]).all() and sol.num_crossings.tolist() == [2, 0, 2]
    outside = jf.solve(
        Flight(), jnp.array([4.0, 0.0]), 0.0, 1.0, 0.25, sections=sections, throw=False
    )
    assert outside.result == jf.RESULTS.out_of_bounds and outside.t_final == 0


def test_a_bound_is_left_in_either_direction_of_time_and_from_itself():
    """A flight x + vt − t²/2 is above 0 up to v ± √(v² + 2x)."""
    inside = jf.bound(lambda t, x: x[0])

    def run(x, v, t1):
        flight = Flight(), jnp.stack([x, v]), 0.0, t1, 0.25
        return jf.solve(*flight, sections=inside, throw=False, stepper=diffrax.Midpoint())

    # The last lanes have both ends in one step, and one that they do not come to.
    lanes = [(1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (0.0, 0.0), (0.0, 0.1), (0.0, 3.0)]
    x, v = np.transpose(lanes)
    root = np.sqrt(v**2 + 2 * x)
    for sign in (1, -1):
        sol = jax.jit(jax.vmap(run, (0, 0, None)))(jnp.asarray(x), jnp.asarray(v), 5.0 * sign)
        ends = sign * np.maximum(sign * v + root, 0)
        left = abs(ends) < 5
        np.testing.assert_allclose(sol.t_final, np.where(left, ends, 5 * sign), atol=16 * EPS)
        np.testing.assert_array_equal(sol.result == jf.RESULTS.out_of_bounds, left)
        np.testing.assert_allclose(np.asarray(sol.x_final)[left, 0], 0, atol=32 * EPS)
    # A run goes no further from where another one has ended.
    ended = jf.solve(
        Flight(), sol.x_final[0], sol.t_final[0], -5.0, 0.25, sections=inside, throw=False
    )
    assert ended.result == jf.RESULTS.out_of_bounds and ended.t_final == sol.t_final[0]


def test_the_saved_steps_of_a_run_end_where_a_section_ends_it():
    """A flight from 0 at v is at 1/2 again at v + √(v² − 1); one at 3 is out of bounds at once."""
    sections = jf.Section(lambda t, x: x[0] - 0.5, -1, terminal=1), jf.bound(lambda t, x: 2 - x[0])
    saveat = diffrax.SaveAt(steps=True, t0=True)

    def steps(x, v):
        flight = Flight(), jnp.stack([x, v]), 0.0, 4.0, 0.25
        how = dict(sections=sections, saveat=saveat, stepper=diffrax.Midpoint(), max_events=4)
        sol = jf.solve(*flight, throw=False, **how)
        return sol.ts, sol.xs, sol.t_final

    # The third comes to t1, and the last one to the section at a step, 1/2 + √1.
    x, v = jnp.array([0.0, 0.0, 0.0, 3.0, 0.875]), jnp.array([1.5, 3.0, 0.5, 0.0, 0.5])
    ts, xs, ends = jax.jit(jax.vmap(steps))(x, v)
    exact = [1.5 + np.sqrt(1.25), 3 - np.sqrt(5), 4.0, 0.0, 1.5]
    for i, end in enumerate(exact):
        saved = np.asarray(ts[i])[np.isfinite(ts[i])]
        assert (np.diff(saved) > 0).all() and saved[-1] == ends[i]
        np.testing.assert_allclose(saved[-1], end, rtol=16 * EPS)
        want = x[i] + v[i] * saved - saved**2 / 2
        np.testing.assert_allclose(xs[i][: len(saved), 0], want, rtol=0, atol=32 * EPS)


class Clockwork(jf.System):
    """x' = 1, with a surface at 0."""

    def vector_field(self, t, x, side):
        return jnp.ones_like(x)

    def switching(self, t, x):
        return x[0]


def test_a_crossing_at_the_end_belongs_to_the_run_as_a_contact_does():
    """The span is (t0, t1]: chained runs cross as often as the whole one, in either direction."""
    # From x at t0 to t1: past 0, to 0, from 0, just not to 0, an empty span; and backward.
    lanes = [
        (-1.0, 0.0, 1.1, 1), (-1.0, 0.0, 1.0, 1), (-0.3, 0.1, 0.4, 1), (0.0, 1.0, 2.0, 0),
        (-1.0, 0.0, 1 - 1e-12, 0), (-1.0, 0.0, 0.0, 0), (1.0, 0.0, -1.0, 1), (0.0, 1.0, 0.0, 0),
    ]  # fmt: skip
    x0, t0, t1, count = np.transpose(lanes)
    passing = jf.Section(lambda t, x: x[0])
    ending = jf.Section(lambda t, x: x[0] * (2 + x[0]), terminal=1)

    @jax.jit
    @jax.vmap
    def run(x0, t0, t1):
        how = dict(throw=False, stepper=diffrax.Midpoint(), max_events=4)
        return jf.solve(Clockwork(), x0[None], t0, t1, 0.25, sections=(passing, ending), **how)

    sol = run(*map(jnp.asarray, (x0, t0, t1)))
    np.testing.assert_array_equal(sol.num_events, count)
    np.testing.assert_array_equal((sol.crossings.sections == 1).sum(1), count)
    np.testing.assert_array_equal(sol.result == jf.RESULTS.section_reached, count == 1)
    at = np.asarray(sol.crossings.ts)[count == 1, 0]
    np.testing.assert_allclose(at, (t0 - x0)[count == 1], rtol=0, atol=8 * EPS)


# A relay in a loop with a plant of third order, x' = A x + b u, u = −sgn c·x.
A = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -1.0]])
B = np.array([0.0, 0.0, 1.0])


class RelayFeedback(jf.System):
    gain: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.asarray(A, x.dtype) @ x - self.gain * side * jnp.asarray(B, x.dtype)

    def switching(self, t, x):
        return x[0]


def flow(t):
    """e^{At}: A is −1 and a nilpotent matrix."""
    return np.exp(-t) * np.array([[1.0, t, t * t / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]])


def half_turn(x, u):
    """The state at the next switch of the relay, and how long it takes."""
    rest = -np.linalg.solve(A, B * u)

    def at(t):
        return flow(t) @ (x - rest) + rest

    grid = np.linspace(1e-6, 20, 401)
    values = np.array([at(t)[0] for t in grid])
    (i,) = np.flatnonzero(np.diff(np.sign(values)))[:1]
    t = brentq(lambda t: at(t)[0], grid[i], grid[i + 1], xtol=1e-15, rtol=4 * EPS)
    return at(t), t


@pytest.mark.slow
def test_the_return_map_of_a_relay_is_that_of_its_matrix_exponentials():
    up = jf.Section(lambda t, x: x[0], direction=1)

    def returned(x):
        return jf.poincare_map(RelayFeedback(jnp.array(1.0)), x, up, 0.1, max_time=20.0)

    starts = np.array([[0.0, 0.3, 0.2], [0.0, 0.05, 0.4]])
    found = returned(jnp.asarray(starts))
    for x, there, t in zip(starts, found.xs, found.ts, strict=True):
        middle, t1 = half_turn(x, -1.0)
        end, t2 = half_turn(middle, 1.0)
        np.testing.assert_allclose(there, end, rtol=0, atol=1e-12)
        np.testing.assert_allclose(t, t1 + t2, rtol=0, atol=1e-11)
    # The limit cycle: x* = −e^{Ah} x* + … is crossed by the map of half a turn and a sign, whose
    # Jacobian is (I − v c/(c v)) e^{Ah}, v the field at the switch (Åström 1995).
    by = jax.jacfwd(lambda x: returned(x).xs)(jnp.asarray(starts[0]))
    middle, t1 = half_turn(starts[0], -1.0)
    end, t2 = half_turn(middle, 1.0)
    exact = np.eye(3)
    for x, t, u in ((middle, t1, -1.0), (end, t2, 1.0)):
        v = A @ x + B * u
        exact = (np.eye(3) - np.outer(v, [1.0, 0, 0]) / v[0]) @ flow(t) @ exact
    np.testing.assert_allclose(by, exact, rtol=0, atol=1e-11)


def test_crossings_are_those_of_an_independent_program():
    """A forced pendulum, both ways in time: all sections at once, to 1e-10."""

    class Pendulum(jf.System):
        def vector_field(self, t, x, side):
            return jnp.stack([x[1], -jnp.sin(x[0]) - 0.1 * x[1] + 0.7 * jnp.cos(0.9 * t)])

    def f(t, x):
        return [x[1], -np.sin(x[0]) - 0.1 * x[1] + 0.7 * np.cos(0.9 * t)]

    def plane(t, x):
        return x[0] * x[1] - 0.1

    def speed(t, x):
        return x[1] - 0.3 * np.sin(t)

    speed.direction = -1
    x0 = [0.4, 0.2]
    sections = (jf.Section(plane), jf.Section(lambda t, x: x[1] - 0.3 * jnp.sin(t), direction=-1))
    sol = jf.solve(Pendulum(), jnp.array(x0), 0.0, 20.0, 0.1, sections=sections)
    ts, xs, numbers = rows(sol)
    other = solve_ivp(f, (0, 20), x0, "DOP853", events=(plane, speed), rtol=1e-13, atol=1e-14)
    for k in range(2):
        np.testing.assert_allclose(ts[numbers == k], other.t_events[k], rtol=0, atol=1e-10)
        np.testing.assert_allclose(xs[numbers == k], other.y_events[k], rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    "make, told",
    [
        (lambda: jf.Section(3.0), "`function` must be a callable"),
        (lambda: jf.Section(lambda t, x: x[0], direction=2), "`direction` must be"),
        (lambda: jf.Section(lambda t, x: x[0], terminal=0), "`terminal` must be"),
        (
            lambda: watched(lambda t, x: x),
            "must return a real scalar of the state's dtype, float64, got shape",
        ),
        (lambda: watched(7), "`sections` must be a jaxfil.Section or a sequence"),
    ],
)
def test_what_is_no_section_is_refused_by_name(make, told):
    with pytest.raises(ValueError, match=told):
        make()


def watched(function):
    section = jf.Section(function) if callable(function) else [function]
    jf.solve(Flight(), jnp.zeros(2), 0.0, 1.0, 0.1, sections=section)


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [None, jf.RK4(), diffrax.Tsit5()], ids=repr)
@pytest.mark.parametrize("start, turns", [(0.1, 0), (0.5, 1), (1.3, 2), (3.0, 4)])
def test_what_stands_still_is_not_crossed(stepper, start, turns):
    """A mass under dry friction of 0.4 turns at kπ, each time by 0.8 nearer, until it sticks for
    good, which is no turn."""
    sections = jf.maxima(lambda t, x: x[0]), jf.minima(lambda t, x: x[0]), jf.Section(velocity)
    coulomb, x0 = jf.systems.CoulombOscillator(), jnp.array([start, 0.0])
    run = {"stepper": stepper, "sections": sections, "throw": False}
    sol = jf.solve(coulomb, x0, 0.0, 30.0, 0.1, **run)
    assert sol.result == jf.RESULTS.successful
    # It starts at its first turn, and the last one is where it sticks.
    count = max(turns - 1, 0)
    assert sol.num_crossings == 2 * count
    times = np.sort(np.asarray(sol.crossings.ts[: 2 * count]))
    np.testing.assert_allclose(
        times, np.repeat(np.pi * np.arange(1, turns), 2)[: 2 * count], rtol=1e-4
    )


def velocity(t, x):
    return x[1]


@pytest.mark.slow
def test_a_ball_at_rest_does_not_turn():
    ball = jf.systems.BouncingBall(g=1.0, restitution=0.5)
    sections = jf.maxima(lambda t, x: x[0]), jf.Section(velocity, -1)
    sol = jf.solve(ball, jnp.array([1.0, 0.0]), 0.0, 40.0, 0.1, sections=sections)
    last = np.asarray(sol.crossings.ts[: int(sol.num_crossings)]).max()
    # From 1 the first fall takes √2, each flight half of the one before.
    assert last <= 3 * np.sqrt(2.0) and sol.mode_final[0] == 2


@pytest.mark.release
def test_a_diagram_of_a_stuck_mass_has_no_samples():
    for section in (jf.maxima(lambda t, x: x[0]), jf.Section(velocity)):
        diagram = jf.bifurcation_diagram(
            jf.systems.CoulombOscillator(),
            "friction",
            np.array([0.4, 1.2]),
            np.array([3.0, 0.0]),
            transient=4,
            samples=6,
            section=section,
            max_return=20.0,
            progress=False,
        )
        assert set(outcome_names(diagram.results)) == {"section_not_reached"}


class Falling(jf.System):
    """x' = −x³, whose first stages overflow in a step of one."""

    def vector_field(self, t, x, side):
        return -(x**3)


def test_a_section_at_a_step_that_is_taken_back_decides_nothing():
    """1/x² = 1/x₀² + 2 t, and log(x + c) is not finite at some trial steps."""
    section = jf.Section(lambda t, x: jnp.log(x[0] + 1e-3) - jnp.log(0.5 + 1e-3))
    sol = jf.solve(Falling(), jnp.array([1e3]), 0.0, 3.0, 1.0, sections=section, max_steps=4096)
    plain = jf.solve(Falling(), jnp.array([1e3]), 0.0, 3.0, 1.0, max_steps=4096)
    np.testing.assert_array_equal(sol.x_final, plain.x_final)
    np.testing.assert_allclose(sol.crossings.ts[0], 2.0, rtol=1e-4)


class Harmonic(jf.System):
    """x'' = −x."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0]])


# With a tolerance, steps of about a period.
LONG = {"stepper": jf.Taylor(32), "max_events": 64, "throw": False}
MIDDLE, LEFT = jf.Section(lambda t, x: x[0]), jf.bound(lambda t, x: x[0] + 0.9)


@pytest.mark.parametrize("phase", [0.0, 0.4, 1.2])
@pytest.mark.parametrize("t1", [100.0, -100.0])
def test_crossings_in_steps_as_long_as_a_period(phase, t1):
    x0 = jnp.array([np.cos(phase), -np.sin(phase)])
    sol = jf.solve(Harmonic(), x0, 0.0, t1, jf.Adaptive(), sections=MIDDLE, **LONG)
    zeros = (np.arange(-40, 40) + 0.5) * np.pi - phase
    exact = np.sort(zeros[(zeros * t1 > 0) & (abs(zeros) < 100)] * np.sign(t1))
    assert sol.num_crossings == len(exact)
    np.testing.assert_allclose(
        sol.crossings.ts[: len(exact)] * np.sign(t1), exact, rtol=0, atol=1e-4
    )


def test_a_bound_is_left_in_a_step_as_long_as_a_period():
    x0 = jnp.array([1.0, 0.0])
    sol = jf.solve(Harmonic(), x0, 0.0, 100.0, jf.Adaptive(), sections=LEFT, **LONG)
    assert outcome_names(sol.result) == "out_of_bounds"
    np.testing.assert_allclose(sol.t_final, np.arccos(-0.9), rtol=0, atol=1e-6)
