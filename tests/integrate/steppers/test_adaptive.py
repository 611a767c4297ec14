"""Steps that follow a tolerance: their errors, how many they are, and that all verbs take them."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxfil as jf
from jaxfil import RESULTS

STEPPERS = {
    "Dopri8": diffrax.Dopri8(),
    "Dopri5": diffrax.Dopri5(),
    "Tsit5": diffrax.Tsit5(),
    "Rodas5P": jf.Rodas5P(),
    "Taylor": jf.Taylor(),
}


class Orbit(jf.System):
    """A planet and its sun, which it meets no surface round."""

    def vector_field(self, t, x, side):
        r3 = jnp.sqrt(x[0] ** 2 + x[1] ** 2) ** 3
        return jnp.stack([x[2], x[3], -x[0] / r3, -x[1] / r3])


def planet(e, t):
    """The state of a planet of eccentricity e, at time t after its perihelion."""
    u = brentq(lambda u: u - e * np.sin(u) - t, t - 2, t + 2, xtol=1e-15)
    b, c = np.sqrt(1 - e * e), 1 - e * np.cos(u)
    return np.array([np.cos(u) - e, b * np.sin(u), -np.sin(u) / c, b * np.cos(u) / c])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        v if v in ("Dopri8", "Taylor") else pytest.param(v, marks=pytest.mark.release)
        for v in STEPPERS
    ],
)
def test_an_eccentric_orbit_is_right_to_the_tolerance(name):
    e, t = 0.95, 2 * np.pi + 1.0
    x0 = jnp.asarray(planet(e, 0.0))
    for rtol in (1e-5, 1e-8):
        sol = jf.solve(
            Orbit(), x0, 0.0, t, jf.Adaptive(rtol, rtol), stepper=STEPPERS[name],
            estimate_error=True, throw=False,
        )  # fmt: skip
        assert sol.result == RESULTS.successful
        error = np.max(abs(sol.x_final - planet(e, t)))
        # What an error at perihelion becomes behind it: the condition of the orbit.
        condition = (1 + e) / (1 - e) ** 2
        assert error < 10 * condition * rtol
        assert_allclose(np.max(sol.errors), error, rtol=0.5, atol=0)


def test_steps_vary_by_orders():
    x0 = jnp.asarray(planet(0.99, 0.0))
    at = diffrax.SaveAt(steps=True)
    sol = jf.solve(Orbit(), x0, 0.0, 6.0, jf.Adaptive(1e-8, 1e-8), saveat=at)
    h = np.diff(np.asarray(sol.ts)[: int(sol.stats["num_saved"])])
    assert h.max() > 1000 * h.min()
    longest = jf.solve(Orbit(), x0, 0.0, 6.0, jf.Adaptive(1e-8, 1e-8, dtmax=0.1), saveat=at)
    h = np.diff(np.asarray(longest.ts)[: int(longest.stats["num_saved"])])
    assert 0.09 < h.max() <= 0.1 * (1 + 1e-12)


class Dragged(jf.System):
    """A block on a rough table, pulled to and fro: it sticks and slips."""

    pull: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.pull * jnp.cos(t) - side])

    def switching(self, t, x):
        return x[1]


@pytest.mark.release
def test_what_ends_a_stick_is_seen_in_any_step():
    # While it sticks all steps are exact, be they as long as ten turns of the force.
    pulls, x0, t1 = jnp.linspace(1.005, 1.6, 12), jnp.zeros(2), 200.0

    def run(pull, step):
        sol = jf.solve(Dragged(pull), x0, 0.0, t1, step, throw=False)
        return sol.num_events, sol.x_final, sol.result

    fixed = jax.vmap(lambda pull: run(pull, 0.05))(pulls)
    for rtol in (1e-2, 1e-4, 1e-6):
        step = jf.Adaptive(rtol, rtol)
        events, x, result = jax.vmap(lambda pull, step=step: run(pull, step))(pulls)
        assert np.all(np.asarray(result == RESULTS.successful))
        assert_array_equal(events, fixed[0])
        assert_allclose(x, fixed[1], rtol=0, atol=100 * rtol)


@pytest.mark.parametrize(
    "name",
    [v if v == "Dopri8" else pytest.param(v, marks=pytest.mark.release) for v in STEPPERS],
)
def test_a_relative_tolerance_alone_lets_a_mass_stick(name):
    # v = v0 + a sin t − t until it is zero, and then zero to rounding.
    pull, speeds, step = 0.4, np.array([0.7, 1.1]), jf.Adaptive(1e-8, 0.0)

    @jax.vmap
    def end(v0):
        system, x0 = Dragged(jnp.array(pull)), jnp.stack([1.0, v0])
        sol = jf.solve(system, x0, 0.0, 30.0, step, stepper=STEPPERS[name], throw=False)
        return sol.x_final, sol.result == RESULTS.successful, sol.stats["num_steps"]

    found, right, steps = end(speeds)
    stops = [brentq(lambda t, v=v: v + pull * np.sin(t) - t, 0.1, 5.0, xtol=1e-15) for v in speeds]
    exact = 1 + speeds * stops + pull * (1 - np.cos(stops)) - np.square(stops) / 2
    assert right.all() and np.all(steps < 60)
    assert_allclose(found, np.stack([exact, 0 * exact], axis=1), rtol=0, atol=1e-7)


class Pulse(jf.System):
    """A push at t = 60, which is below 1e-200 some 21 widths before it."""

    width: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.exp(-(((t - 60.0) / self.width) ** 2))])


def test_a_pulse_inside_of_a_long_step_is_seen_from_far_before_it():
    widths = np.array([1.0, 2.0, 5.0])

    @jax.vmap
    def end(width):
        step = jf.Adaptive(1e-8, 1e-10)
        sol = jf.solve(Pulse(width), jnp.zeros(2), 0.0, 120.0, step, stepper=jf.Taylor())
        return sol.x_final, sol.stats["num_steps"]

    found, steps = end(widths)
    speeds = np.sqrt(np.pi) * widths
    assert_allclose(found, np.stack([60 * speeds, speeds], axis=1), rtol=1e-7)
    assert np.all(steps < 80)


@pytest.mark.parametrize("name", ["Dopri8", pytest.param("Taylor", marks=pytest.mark.release)])
def test_a_force_is_followed_while_it_holds_a_mass(name):
    # The mass sticks all the time, and the friction is the load a cos t.
    a, t1 = jnp.array([0.03, 0.4]), 100.0

    def force(t, x, side):
        return side

    def run(a):
        sections = [jf.Section(lambda t, x, side: side - a / 2, direction=1), jf.maxima(force)]
        step, still = jf.Adaptive(1e-8), jnp.zeros(2)
        sol = jf.solve(Dragged(a), still, 0.0, t1, step, stepper=STEPPERS[name], sections=sections)
        return sol.crossings.ts, sol.crossings.sections, sol.num_crossings

    ts, which, count = jax.vmap(run)(a)
    above = 2 * np.pi * np.arange(1, 17) - np.pi / 3
    tops = 2 * np.pi * np.arange(1, 16)
    for k in range(2):
        found, number = ts[k, : count[k]], which[k, : count[k]]
        assert_allclose(found[number == 0], above[above < t1], rtol=0, atol=1e-9)
        assert_allclose(found[number == 1], tops[tops < t1], rtol=0, atol=1e-9)


def test_the_largest_force_that_holds_a_mass_is_found_without_a_mean_beside_it():
    class Forced(Dragged):
        period = 2 * np.pi

    found = jf.settled_average(
        Forced(jnp.array(0.03)), {"top": jf.Maximum(lambda t, x, side: side),
                                  "low": jf.Minimum(lambda t, x, side: side)},
        jnp.zeros(2), transient=3, samples=4, steps=jf.Adaptive(1e-8))  # fmt: skip
    values = found.averages["top"], found.averages["low"]
    assert_allclose(values, (0.03, -0.03), rtol=0, atol=1e-12)


class Refractory(jf.System):
    """v' = 3 − v, which fires at a threshold that drops from 10 to 1 when a timer s runs out."""

    wait: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([3 - x[0], jnp.ones_like(t)])

    def switching(self, t, x):
        return jnp.stack([jnp.where(x[1] < 0, 10.0, 1.0) - x[0], -x[1]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, jnp.stack([0 * t, -self.wait]), x)


@pytest.mark.slow
def test_a_guard_that_jumps_below_zero_at_another_surface_is_reached_there():
    # v is above 1 when the threshold drops, so that it fires each 0.7.
    first, start, step = np.log(1.5), jnp.array([0.0, 0.2]), jf.Adaptive(1e-9, 1e-12)
    sol = jf.solve(Refractory(jnp.array(0.7)), start, 0.0, 2.2, step, max_events=32)
    ts = sol.events.ts[: sol.num_events][sol.events.members[: sol.num_events, 0]]
    assert_allclose(ts, first + 0.7 * np.arange(3), rtol=0, atol=1e-9)


class Wall(jf.System):
    """x'' = −sin x, thrown back at x = 0 by a clock's kick as well."""

    e: jax.Array
    every: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.sin(x[0]) - 0.1 * x[1]])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return x.at[1].multiply(-self.e)

    def tick(self, t, x, clock):
        return x.at[1].add(0.3)

    @property
    def clocks(self):
        return (jf.Clock(self.every),)


def pendulum(e, period, t1):
    """The state of `Wall` at t1, by SciPy between impacts and kicks."""
    t, x, k = 0.0, np.array([1.0, 0.0]), 1

    def hits(t, x):
        return x[0]

    hits.terminal, hits.direction = True, -1
    while t < t1:
        end = min(k * period, t1)
        run = solve_ivp(lambda t, x: [x[1], -np.sin(x[0]) - 0.1 * x[1]], (t, end), x, "DOP853",
                        events=hits, rtol=1e-13, atol=1e-13)  # fmt: skip
        t, x = run.t[-1], run.y[:, -1].copy()
        if run.t_events[0].size:
            x = np.array([0.0, -e * x[1]])
        elif t == k * period:
            x[1] += 0.3
            k += 1
    return x


@pytest.mark.slow
def test_impacts_and_clocks_with_their_derivatives():
    e, period = jnp.array([0.5, 0.8]), jnp.array([0.9, 1.3])

    def end(e, period):
        sol = jf.solve(
            Wall(e, period), jnp.array([1.0, 0.0]), 0.0, 5.0, jf.Adaptive(1e-11, 1e-12), throw=False
        )
        return sol.x_final, (sol.result, sol.stats)

    def with_end(e, period):
        x, told = end(e, period)
        return x, (x, *told)

    jacobian = jax.jacfwd(with_end, argnums=(0, 1), has_aux=True)
    slopes, (x, result, stats) = jax.jit(jax.vmap(jacobian))(e, period)
    assert np.all(np.asarray(result == RESULTS.successful))
    for i in range(2):
        point = np.array([e[i], period[i]])
        assert_allclose(x[i], pendulum(*point, 5.0), rtol=0, atol=2e-10)
        for j in range(2):
            step = np.eye(2)[j] * 1e-5
            high, low = (pendulum(*(point + k * step), 5.0) for k in (1, -1))
            assert_allclose(slopes[j][i], (high - low) / 2e-5, rtol=0, atol=1e-7)
    # A lane alone takes the same steps.
    _, (_, alone) = end(e[1], period[1])
    assert int(alone["num_steps"]) == int(stats["num_steps"][1])


@pytest.mark.release
def test_what_is_saved():
    wall, x0, tolerance = Wall(jnp.array(0.6), jnp.array(1.1)), jnp.array([1.0, 0.0]), 1e-10
    ts = jnp.linspace(0.0, 4.0, 9)

    def run(saveat, **options):
        step = jf.Adaptive(tolerance, tolerance)
        return jf.solve(wall, x0, 0.0, 4.0, step, saveat=saveat, **options)

    saved = run(diffrax.SaveAt(ts=ts))
    dense = run(diffrax.SaveAt(dense=True))
    steps = run(diffrax.SaveAt(steps=True))
    right = np.stack([pendulum(0.6, 1.1, t) if t > 0 else x0 for t in np.asarray(ts)])
    assert_allclose(saved.xs, right, rtol=0, atol=1e-8)
    assert_allclose([dense.evaluate(t) for t in ts], right, rtol=0, atol=1e-8)
    rows = int(steps.stats["num_saved"])
    assert np.all(np.isinf(steps.ts[rows:]))
    assert_allclose(steps.xs[rows - 1], right[-1], rtol=0, atol=1e-8)


@pytest.mark.release
def test_reverse_mode_and_backward_time():
    def end(e, adjoint):
        wall = Wall(e, jnp.array(1.1))
        step = jf.Adaptive(1e-9, 1e-9)
        return jf.solve(wall, jnp.array([1.0, 0.0]), 0.0, 3.0, step, adjoint=adjoint).x_final[0]

    backward = diffrax.RecursiveCheckpointAdjoint()
    e = jnp.array(0.6)
    reverse = jax.jit(jax.grad(lambda e: end(e, backward)))(e)
    assert_allclose(
        reverse, jax.jit(jax.jacfwd(lambda e: end(e, diffrax.ForwardMode())))(e), rtol=1e-9
    )
    x0, step = jnp.asarray(planet(0.5, 1.0)), jf.Adaptive(1e-10, 1e-10)
    back = jf.solve(Orbit(), x0, 1.0, 0.0, step).x_final
    assert_allclose(back, planet(0.5, 0.0), rtol=0, atol=1e-8)


def test_spans_within_rounding_and_empty_ones_are_run():
    def end(t0):
        return jf.solve(
            Orbit(), jnp.asarray(planet(0.5, 1.0)), t0, 0.3, jf.Adaptive(1e-8), throw=False
        )

    # 0.1 + 0.2 is the number after 0.3.
    t0 = jnp.array([0.1 + 0.2, 0.3, 0.3 - 1e-15, 0.0])
    sol = jax.jit(jax.vmap(end))(t0)
    assert (sol.result == jf.RESULTS.successful).all()
    assert_allclose(sol.x_final[:3], [planet(0.5, 1.0)] * 3, rtol=1e-13)
    assert_allclose(sol.t_final, 0.3, rtol=4e-16)


def test_single_precision():
    x0 = jnp.asarray(planet(0.9, 0.0), jnp.float32)
    sol = jf.solve(Orbit(), x0, 0.0, 5.0, jf.Adaptive(1e-5, 1e-6))
    assert sol.x_final.dtype == jnp.float32
    assert_allclose(sol.x_final, planet(0.9, 5.0), rtol=0, atol=1e-2)
    # A tolerance below rounding asks for the least error there is.
    fine = jf.solve(Orbit(), x0, 0.0, 5.0, jf.Adaptive(1e-12, 0.0), throw=False)
    assert fine.result == RESULTS.successful


@pytest.mark.release
def test_diagrams_take_a_tolerance():
    system, values = jf.systems.ImpactOscillator(), np.linspace(0.3, 0.5, 5)

    def diagram(steps, **options):
        return jf.bifurcation_diagram(
            system, "amplitude", values, jnp.zeros(2), transient=60, samples=4, steps=steps,
            progress=False, **options,
        )  # fmt: skip

    fixed, free = diagram(100), diagram(jf.Adaptive(1e-10, 1e-12))
    assert_allclose(free.xs, fixed.xs, rtol=0, atol=1e-7)
    section = jf.Section(lambda t, x: x[1], direction=-1)
    at = {"section": section, "max_return": 20.0}
    fixed, free = (diagram(s, **at) for s in (100, jf.Adaptive(1e-10, 1e-12)))
    assert_allclose(free.xs, fixed.xs, rtol=0, atol=1e-7)


@pytest.mark.release
def test_orbits_and_exponents_take_a_tolerance():
    system, step = jf.systems.ImpactOscillator(amplitude=0.4), jf.Adaptive(1e-11, 1e-12)
    x0 = jnp.zeros(2)
    fixed = jf.periodic_orbit(system, x0, transient=60, steps=100)
    free = jf.periodic_orbit(system, x0, transient=60, steps=step)
    assert_allclose(free.x0, fixed.x0, rtol=0, atol=1e-9)
    assert_allclose(free.multipliers, fixed.multipliers, rtol=0, atol=1e-8)
    options = {"periods": 40, "transient": 20}
    fixed = jf.lyapunov_spectrum(system, fixed.x0, steps=100, **options)
    free = jf.lyapunov_spectrum(system, free.x0, steps=step, **options)
    assert_allclose(free.exponents, fixed.exponents, rtol=0, atol=1e-6)


@pytest.mark.release
def test_returns_averages_and_fits_take_a_tolerance():
    block, x0, step = jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0]), jf.Adaptive(1e-10)
    back = jf.poincare_map(block, x0, jf.Section(lambda t, x: x[0]), step, max_time=9.0)
    # A quarter of a turn about 0.4: x = 0.4 + 2.6 cos t.
    assert_allclose(back.ts, np.arccos(-0.4 / 2.6), rtol=0, atol=1e-8)
    mean = jf.average(block, lambda t, x, side: x[0], x0, 0.0, np.pi, step)
    assert_allclose(mean.value, 0.4, rtol=0, atol=1e-8)
    ts = jnp.linspace(0.5, 2.5, 5)
    data = 0.4 + 2.6 * jnp.cos(ts)
    guess = jf.systems.CoulombOscillator(friction=0.3)
    found = jf.fit(guess, ("friction",), ts, data, x0, step, observe=lambda t, x: x[0])
    assert_allclose(found.values, [0.4], rtol=0, atol=1e-8)


def test_a_budget_that_is_too_small_is_told():
    x0 = jnp.asarray(planet(0.99, 0.0))
    sol = jf.solve(Orbit(), x0, 0.0, 6.0, jf.Adaptive(1e-8), max_steps=20, throw=False)
    assert sol.result == RESULTS.max_steps_reached


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: jf.Adaptive(0.0), r"`rtol` must be a positive number, got 0"),
        (lambda: jf.Adaptive(1e-6, -1.0), r"`atol` must not be negative, got -1"),
        (lambda: jf.Adaptive(dtmax=0.0), r"`dtmax` must be a positive number, got 0"),
        (lambda: jax.jit(lambda r: jf.Adaptive(r).rtol)(1e-6), r"`rtol` must be a constant"),
    ],
)
def test_a_tolerance_is_checked(make, told):
    with pytest.raises(ValueError, match=told):
        make()


@pytest.mark.parametrize("stepper", [jf.RK4(), diffrax.Euler()])
def test_a_stepper_without_an_estimate_is_refused(stepper):
    told = r"`stepper` must have an error estimate that is more than a test for instability"
    with pytest.raises(ValueError, match=told):
        jf.solve(Orbit(), jnp.ones(4), 0.0, 1.0, jf.Adaptive(), stepper=stepper)


class Rubbing(jf.System):
    """A mass on a spring with dry friction, which turns at t = π."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - 0.4 * side])

    def switching(self, t, x):
        return x[1]


@pytest.mark.parametrize("stepper", [diffrax.Heun(), diffrax.Bosh3()])
def test_a_method_of_low_order_follows_a_tolerance(stepper):
    """x = −0.4 − 1.8 cos(t − π) after the turn, from x = 3; the error is some ten tolerances."""
    end = jnp.array([-0.4 - 1.8 * np.cos(5 - np.pi), 1.8 * np.sin(5 - np.pi)])
    run = dict(stepper=stepper, max_steps=20_000)
    for tolerance in (1e-4, 1e-6):
        step = jf.Adaptive(tolerance, tolerance)
        sol = jf.solve(Rubbing(), jnp.array([3.0, 0.0]), 0.0, 5.0, step, **run)
        error = float(jnp.max(abs(sol.x_final - end)))
        assert 0.1 * tolerance < error < 10 * tolerance
        np.testing.assert_allclose(sol.events.ts[0], np.pi, atol=10 * tolerance)


def test_a_tolerance_is_one_number_each():
    assert_array_equal([jf.Adaptive().rtol, jf.Adaptive().atol], [1e-6, 1e-9])
    assert repr(jf.Adaptive(1e-4, dtmax=2.0)) == "Adaptive(rtol=0.0001, atol=1e-09, dtmax=2.0)"


class SuperTwisting(jf.System):
    """A sliding variable s under super-twisting control with a disturbance: √|s| at its surface."""

    def root(self, s, side):
        return jnp.sqrt(abs(s))

    def vector_field(self, t, x, side):
        s, z = x
        rate = z - 1.5 * jnp.sqrt(2.0) * self.root(s, side) * side
        return jnp.stack([rate, jnp.cos(t) - 2.2 * side])

    def switching(self, t, x):
        return x[0]


class NoRoot(SuperTwisting):
    """The same, and no number on the other side of the surface."""

    def root(self, s, side):
        return jnp.sqrt(side * s)


@pytest.mark.slow
def test_a_field_that_is_not_lipschitz_at_its_surface():
    # Times by SciPy in √|s|, regular between crossings, at 1e-12; they accumulate at 1.02087.
    times = [0.5957122716079, 0.9049448696824, 1.0111853682887, 1.0184625676052]
    x0, step = jnp.array([1.0, 0.0]), jf.Adaptive(1e-9, 1e-12)
    sol = jf.solve(SuperTwisting(), x0, 0.0, 10.0, step, throw=False)
    assert sol.result == RESULTS.zeno
    assert_allclose(sol.events.ts[:4], times, rtol=0, atol=1e-10)
    # The side that is not a number is never visited.
    blind = jf.solve(NoRoot(), x0, 0.0, 10.0, step, throw=False)
    assert blind.result == RESULTS.zeno
    assert_allclose(blind.events.ts[:4], times, rtol=0, atol=1e-10)
    assert int(blind.stats["num_iterations"]) < 2000


@pytest.mark.release
def test_a_bifurcation_of_an_orbit_with_a_tolerance(tmp_path):
    system, step = jf.systems.SDOscillator(omega=0.84), jf.Adaptive(1e-9, 1e-12)
    orbit = jf.periodic_orbit(system, jnp.array([1.9, 0.0]), steps=step)
    found = jf.find_bifurcation(system, "omega", orbit, "grazing")
    # (1 − ω²)² + (2ζω)² = f0² where the orbit, linear until then, touches.
    omega, zeta, f0 = found.value, system.zeta, system.f0
    assert_allclose((1 - omega**2) ** 2 + (2 * zeta * omega) ** 2, f0**2, rtol=1e-10, atol=0)
    # Its picture has states enough, and a file keeps the tolerance.
    assert orbit.trajectory().xs.shape[0] > 100
    orbit.save(tmp_path / "orbit.npz")
    back = jf.load(tmp_path / "orbit.npz", system=system)
    assert back.options.stepper == orbit.options.stepper
