"""Averages of the lanes of a sweep, against closed forms of motions with and without contacts."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf

EPS = np.finfo(float).eps
LINEAR = jf.systems.ImpactOscillator(wall=9.0, amplitude=0.7, stiffness=2.0, damping=0.4)
OMEGA, DAMPING = np.linspace(0.5, 2.0, 13), np.linspace(0.2, 0.7, 6)


def power(t, x, side, system):
    return system.damping * x[1] ** 2


OF_LINEAR = {
    "power": power,
    "rms": jf.RMS(lambda t, x, side: x),
    "largest": jf.Maximum(lambda t, x, side: x),
    "least": jf.Minimum(lambda t, x, side: x[0]),
}


def linear(dtype=float, **options):
    """78 lanes, which are no whole number of blocks."""
    given = dict(transient=120, samples=3, steps=20, progress=False, average=OF_LINEAR)
    axes = OMEGA.astype(dtype), DAMPING.astype(dtype)
    start = jnp.zeros(2, dtype)
    names = "omega", "damping"
    return jf.bifurcation_diagram(LINEAR, names, axes, start, **given | options)


def of_linear(omega, damping):
    """The same in closed form."""
    force, k = 0.7, 2.0
    gap = (k - omega**2) ** 2 + (damping * omega) ** 2
    size = np.stack([force / np.sqrt(gap), omega * force / np.sqrt(gap)], axis=-1)
    return {
        "power": force**2 * damping * omega**2 / (2 * gap),
        "rms": size / np.sqrt(2),
        "largest": size,
        "least": -size[..., 0],
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "dtype, options, rtol",
    [
        # Of the method: 20 steps a period by a method of order eight.
        pytest.param(*(float, {"compact": False}, 2e-8), marks=pytest.mark.release),
        (float, {"steps": jf.Adaptive(rtol=1e-9, atol=1e-11), "compact": True}, 1e-8),
        # Integrals of one period have the rounding of that period, however many there were.
        pytest.param(
            *(np.float32, {"compact": True, "samples": 200}, 64 * np.finfo(np.float32).eps),
            marks=pytest.mark.release,
        ),
    ],
)
def test_a_linear_oscillator_takes_up_what_its_closed_form_says(dtype, options, rtol):
    found = linear(dtype, **options)
    assert found.successful.all()
    for name, exact in of_linear(*np.meshgrid(OMEGA, DAMPING, indexing="ij")).items():
        assert found.averages[name].dtype == dtype
        np.testing.assert_allclose(found.averages[name], exact, rtol=rtol, err_msg=name)


class Table(jf.System):
    """A ball on a table that swings by a cos ωt, with gravity one."""

    omega: jax.Array
    restitution: jax.Array
    swing: jax.Array

    slides: ClassVar[bool] = False

    @property
    def period(self):
        return 2 * jnp.pi / self.omega

    def speed(self, t):
        return -self.swing * self.omega * jnp.sin(self.omega * t)

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])

    def switching(self, t, x):
        return x[0] - self.swing * jnp.cos(self.omega * t)

    def reset(self, t, x, surface):
        table = self.speed(t)
        return jnp.stack([x[0], table - self.restitution * (x[1] - table)])


def lost(t, before, after, surfaces, system):
    """Energy in an impact, as the table sees it."""
    table = system.speed(t)
    return 0.5 * ((before[1] - table) ** 2 - (after[1] - table) ** 2)


OF_BALL = {
    "x": lambda t, x, side: x[0],
    "v": jf.RMS(lambda t, x, side: x[1]),
    "top": jf.Maximum(lambda t, x, side: x),
    "low": jf.Minimum(lambda t, x, side: x[1]),
    "impacts": jf.EventSum(lambda t, before, after, surfaces: surfaces),
    "lost": jf.EventSum(lost),
}
SWING = 0.5
BALL = dict(transient=160, samples=4, steps=10, stepper=jf.RK4())


def ball_start(omega, e):
    """A state near that on the orbit at t = 0, in flight."""
    xp = jnp if isinstance(omega, jax.Array) else np
    period = 2 * np.pi / omega
    table = period * (1 - e) / (2 * (1 + e))
    phase = (2 * np.pi - xp.arcsin(table / (SWING * omega))) / omega - period
    left = -phase
    height = SWING * xp.cos(omega * phase) + period / 2 * left - left**2 / 2
    return xp.stack([height, period / 2 - left], axis=-1)


def of_ball(omega, e):
    """The orbit of one impact a period T, with a = 1/2: v = ±T/2 and x ≤ a cos φ + T²/8, where the
    table goes up by w = −aω sin φ = T (1 − e)/(2 (1 + e))."""
    period = 2 * np.pi / omega
    table = period * (1 - e) / (2 * (1 + e))
    xp = jnp if isinstance(omega, jax.Array) else np
    height = xp.sqrt(SWING**2 - (table / omega) ** 2)
    half, four = period / 2, BALL["samples"]
    return {
        "x": height + period**2 / 12,
        "v": half / np.sqrt(3),
        "top": xp.stack([height + period**2 / 8, half], axis=-1),
        "low": -half,
        "impacts": four + 0 * half,
        "lost": four * 0.5 * (1 - e**2) * (half + table) ** 2,
    }


@pytest.fixture(scope="module")
def balls():
    """70 lanes with impacts at other times, two of which fail."""
    omega, e = np.linspace(1.2, 1.4, 70), np.linspace(0.65, 0.75, 70)
    rows, start = np.stack([omega, e], axis=1), ball_start(omega, e)
    rows[[3, 66], 0] = np.nan, np.inf
    system = Table(jnp.array(1.3), jnp.array(0.7), jnp.array(SWING))
    names = "omega", "restitution"
    found = jf.bifurcation_diagram(
        system, names, rows, start, average=OF_BALL, compact=False, progress=False, **BALL
    )
    return rows, found


@pytest.mark.release
def test_a_ball_that_hops_once_a_period_has_its_closed_form(balls):
    rows, found = balls
    good = np.isfinite(rows[:, 0])
    np.testing.assert_array_equal(found.successful, good)
    for name, exact in of_ball(*rows[good].T).items():
        own = found.averages[name]
        np.testing.assert_allclose(own[good], exact, rtol=1e-12, err_msg=name)
        assert np.isnan(own[~good]).all(), name


@pytest.mark.release
def test_one_lane_is_that_of_the_diagram_and_has_the_derivatives_of_the_closed_form(balls):
    rows, found = balls

    def averages(at):
        system = Table(at[0], at[1], jnp.array(SWING))
        start = jax.lax.stop_gradient(ball_start(*at))
        return jf.settled_average(system, OF_BALL, start, compact=True, **BALL).averages

    at = jnp.asarray(rows[[10, 40]])
    own, slopes = jax.vmap(averages)(at), jax.vmap(jax.jacfwd(averages))(at)
    exact = jax.vmap(jax.jacfwd(lambda at: of_ball(*at)))(at)
    for name in OF_BALL:
        np.testing.assert_allclose(own[name], found.averages[name][[10, 40]], rtol=1e-12)
        np.testing.assert_allclose(slopes[name], exact[name], rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.release
def test_what_is_put_in_is_taken_up_lost_and_stored():
    """Energy, at values of ω with periodic orbits and with chaos, whose samples are of their own
    time each."""
    omega = np.linspace(0.7, 1.5, 9)
    wall = jf.systems.ImpactOscillator(amplitude=0.9, damping=0.2, restitution=0.7)

    def energy(x):
        return 0.5 * (x[..., 0] ** 2 + x[..., 1] ** 2)

    def work(t, x, side, system):
        return x[1] * system.amplitude * jnp.cos(system.omega * t)

    d = jf.bifurcation_diagram(
        wall,
        "omega",
        omega,
        jnp.zeros(2),
        transient=10,
        samples=6,
        progress=False,
        compact=True,
        average={
            "put in": lambda t, x, side, system: (
                x[1] * system.amplitude * jnp.cos(system.omega * t)
            ),
            "taken up": power,
            "lost": jf.EventSum(lambda t, before, after, surfaces: energy(before) - energy(after)),
            "energy": jf.Maximum(lambda t, x, side: energy(x)),
        },
    )
    # From the first sample on, the same motion: what is stored between it and the last one.
    later = jf.bifurcation_diagram(
        wall, "omega", omega, jnp.zeros(2), transient=9, samples=7, progress=False, compact=True
    )
    np.testing.assert_allclose(later.xs[:, 1:], d.xs, rtol=0, atol=1e-12)
    stored = energy(later.xs[:, -1]) - energy(later.xs[:, 0])
    own, time = d.averages, 6 * 2 * np.pi / omega
    assert (own["lost"] > 0.1).all() and (own["energy"] > energy(d.xs).max(axis=1)).all()
    balance = (own["put in"] - own["taken up"]) * time - own["lost"]
    np.testing.assert_allclose(balance, stored, rtol=0, atol=1e-9)


class Relay(jf.System):
    """x' = A cos t − side: rests on x = 0 where the force is too weak to move it."""

    force: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return (self.force * jnp.cos(t) - side)[None]

    def switching(self, t, x):
        return x[0]


@pytest.mark.slow
def test_on_a_slide_it_is_the_blend_that_is_averaged(tmp_path):
    """It leaves at cos t₁ = 1/A and comes back at A (sin t₂ − sin t₁) = t₂ − t₁; in between the
    force is on one side, elsewhere side = A cos t holds against it."""
    from scipy.optimize import brentq

    force = np.array([1.1, 1.5])
    run = dict(transient=1, samples=2, steps=20, compact=True, progress=False)
    values = {
        "work": lambda t, x, side, system: system.force * side * jnp.cos(t),
        "share": lambda t, x, side: 0.5 * (1 + side),
        "side": jf.RMS(lambda t, x, side: side),
        "farthest": jf.Maximum(lambda t, x, side: x[0]),
        "hold": jf.Minimum(lambda t, x, side: jnp.cos(t) * side),
        "contacts": jf.EventSum(lambda t, before, after, surfaces: surfaces),
    }

    def sweep(average=values, **options):
        given = run | {"checkpoint": tmp_path / "kept"} | options
        relay, start = Relay(jnp.array(1.2)), jnp.array([0.0])
        return jf.bifurcation_diagram(relay, "force", force, start, average=average, **given)

    def height(t, a, t1):
        return a * (np.sin(t) - np.sin(t1)) - t + t1

    found = sweep()
    for i, a in enumerate(force):
        t1 = -np.arccos(1 / a)
        t2 = brentq(height, -t1, t1 + np.pi, args=(a, t1))
        flights = 2 * a * (np.sin(t2) - np.sin(t1))
        slides = a**2 * ((np.pi - (t2 - t1)) - 0.5 * (np.sin(2 * t2) - np.sin(2 * t1)))
        np.testing.assert_allclose(found.averages["work"][i], (flights + slides) / (2 * np.pi))
        np.testing.assert_allclose(found.averages["share"][i], 0.5, rtol=1e-12)
        # side² is 1 in a flight and (A cos t)² on a slide, where that of both sides is 1.
        side = np.sqrt((2 * (t2 - t1) + slides) / (2 * np.pi))
        np.testing.assert_allclose(found.averages["side"][i], side, rtol=1e-12)
        top = height(-t1, a, t1)
        np.testing.assert_allclose(found.averages["farthest"][i], top, rtol=1e-12)
        # Where it has gone too far to come back before the force has turned.
        hold = min(np.cos(t2), 0.0)
        np.testing.assert_allclose(found.averages["hold"][i], hold, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(found.averages["contacts"], 8)
    again = sweep()
    assert found.averages.keys() == again.averages.keys()
    for name, own in found.averages.items():
        np.testing.assert_array_equal(again.averages[name], own)
    with pytest.raises(ValueError, match=r"average was .*share: mean.* and is share: RMS"):
        sweep({"share": jf.RMS(values["share"])})
    one = sweep(values["work"], checkpoint=None)
    np.testing.assert_array_equal(one.averages["average"], found.averages["work"])


class Part(jf.System):
    """A part that never leaves a table at 0.6 sin t, with gravity one."""

    amplitude: jax.Array
    slides = False
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])

    def switching(self, t, x):
        return x[0] - self.amplitude * jnp.sin(t)

    def reset(self, t, x, surface):
        return jnp.stack([x[0], self.amplitude * jnp.cos(t)])


LEVELS = (np.arange(12) - 5.5) / 6


class Quantizer(jf.System):
    """x″ = −x, read by twelve comparators; it crosses all and slides on none."""

    slides = False
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0]])

    def switching(self, t, x):
        return x[0] - LEVELS


@pytest.mark.release
def test_root_mean_squares_of_reactions_and_of_many_sides():
    """The function is affine in them, as it must be, and its square is not. The pressure is
    1 − a sin t, and the staircase has its value between two levels for the time that cos t is
    there."""

    def rms(system, function, x0):
        run = dict(transient=0, samples=1, steps=40, compact=True, stepper=jf.RK4())
        average = {"it": jf.RMS(function)}
        return jf.settled_average(system, average, jnp.array(x0), **run).averages["it"]

    pressure = rms(Part(jnp.array(0.6)), lambda t, x, reaction: reaction, [0.0, 0.6])
    np.testing.assert_allclose(pressure, np.sqrt(1 + 0.6**2 / 2), rtol=1e-12)
    stairs = rms(Quantizer(), lambda t, x, side: jnp.sum(side) / 12, [1.0, 0.0])
    shares = -np.diff(np.arccos([-1.0, *LEVELS, 1.0])) / np.pi
    exact = np.sqrt(shares @ ((2 * np.arange(13) - 12) / 12) ** 2)
    # The error of RK4 in the times of the crossings.
    np.testing.assert_allclose(stairs, exact, rtol=1e-5)


@pytest.mark.release
def test_followed_lanes_have_averages_of_their_own():
    """Each starts where the last one has ended, but with no integral of it."""
    names = dict(transient=120, samples=3, steps=20, progress=False, average=OF_LINEAR)
    values = np.linspace(0.5, 2.0, 18)
    d = jf.bifurcation_diagram(LINEAR, "omega", values, jnp.zeros(2), follow="down", **names)
    for name, exact in of_linear(values, 0.4).items():
        np.testing.assert_allclose(d.averages[name], exact, rtol=2e-8, err_msg=name)


@pytest.mark.parametrize(
    "average, told",
    [
        ({}, "`average` must be a function"),
        ({1: power}, "`average` must be a function"),
        ({"a": None}, "`average\\['a'\\]` must be a callable"),
        (lambda t: t, "`average` must take"),
        (jf.RMS(lambda t, x, side: "a"), "`average` must return"),
        (jf.EventSum(lambda t, x: x), "`average` must take \\(t, before, after, surfaces\\)"),
    ],
)
def test_what_cannot_be_averaged_is_refused_by_name(average, told):
    with pytest.raises(ValueError, match=told):
        linear(average=average)


@pytest.mark.release
def test_the_slope_of_an_extreme_within_a_step_is_that_of_the_method():
    """At 10 steps a period x is known to 2e-7; the cubic through a step knows its largest cube to
    1e-4."""

    def largest(omega):
        lane = eqx.tree_at(lambda system: system.omega, LINEAR, omega)
        average = {"largest": jf.Maximum(lambda t, x, side: x[0] ** 3)}
        run = dict(transient=60, samples=2, steps=10, compact=True)
        return jf.settled_average(lane, average, jnp.zeros(2), **run).averages["largest"]

    def exact(omega):
        return (0.7 / jnp.sqrt((2 - omega**2) ** 2 + (0.4 * omega) ** 2)) ** 3

    omega = jnp.array([0.6, 1.1, 1.5])
    slopes = jax.vmap(jax.grad(largest))(omega)
    np.testing.assert_allclose(slopes, jax.vmap(jax.grad(exact))(omega), rtol=5e-6)


class Swing(jf.System):
    """x = 0.05 + sin t, beside a y that rests at 0, with a constant in its extremes."""

    shift: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.cos(t), -self.shift * x[1]])


@pytest.mark.slow
def test_extremes_at_kinks_and_the_size_of_what_rests_with_their_derivatives():
    """|x| is least where its rate jumps, and of two lines the lower one is largest where they
    cross, at 3x = p − 1. A mean square of zero has no derivative by its square root."""

    def lower(t, x, side, system):
        return jnp.minimum(system.shift - x[0], 1 + 2 * x[0])

    average = {
        "closest": jf.Minimum(lambda t, x, side: jnp.abs(x[0])),
        "peak": jf.Maximum(lower),
        "idle": jf.RMS(lambda t, x, side: x[1]),
        "power": lambda t, x, side: x[0] ** 2,
    }

    def averages(shift):
        x0 = jnp.array([0.05, 0.0])
        run = {"transient": 0, "samples": 1, "stepper": jf.RK4()}
        return jf.settled_average(Swing(shift), average, x0, **run).averages

    p = jnp.asarray(0.9)
    exact = {"closest": 0.0, "peak": (1 + 2 * p) / 3, "idle": 0.0, "power": 0.05**2 + 0.5}
    slopes = {"closest": 0.0, "peak": 2 / 3, "idle": 0.0, "power": 0.0}
    values, found = jax.jvp(averages, (p,), (jnp.ones_like(p),))
    for name in exact:
        assert_allclose(values[name], exact[name], rtol=0, atol=1e-5, err_msg=name)
        assert_allclose(found[name], slopes[name], rtol=0, atol=1e-6, err_msg=name)
    assert_array_equal(jax.grad(lambda p: averages(p)["idle"])(p), 0.0)


class Lifted(jf.System):
    """x'' = −x, or v' = √(0.1 − v) below, which is NaN above 0.1."""

    period = 2 * np.pi
    slides = False

    def vector_field(self, t, x, side):
        below = jnp.sqrt(0.1 - x)
        return jnp.where(side > 0, jnp.stack([x[1], -x[0]]), below)

    def switching(self, t, x):
        return x[0] + 3.0


class Lower(eqx.Module):
    """The lower one of two curves."""

    slope: jax.Array

    def __call__(self, t, x, side):
        return jnp.minimum(x[0] + 0.05 * t, self.slope * x[1] + 0.05 * t * x[0])


@pytest.mark.release
def test_extremes_have_second_derivatives_also_beside_a_side_that_is_not_a_number():
    """The largest x is the amplitude. The lower one of two curves is largest where they cross."""

    def largest(p):
        average = {"top": jf.Maximum(lambda t, x, side: x[0]), "peak": jf.Maximum(Lower(p[1]))}
        x0 = jnp.stack([p[0] * jnp.sin(p[2]), p[0] * jnp.cos(p[2])])
        run = dict(transient=0, samples=1, steps=40, compact=True)
        found = jf.settled_average(Lifted(), average, x0, **run).averages
        return jnp.stack([found["top"], found["peak"]])

    def exact(p):
        def curves(t):
            x, v = p[0] * jnp.sin(t + p[2]), p[0] * jnp.cos(t + p[2])
            return jnp.stack([x + 0.05 * t, p[1] * v + 0.05 * t * x])

        t = jnp.asarray(0.8)
        for _ in range(8):
            (a, b), (ra, rb) = jax.jvp(curves, (t,), (jnp.ones(()),))
            t = t - (a - b) / (ra - rb)
        return jnp.stack([p[0], curves(t)[0]])

    p = jnp.array([1.3, 0.7, -0.2])
    assert_allclose(jax.jacrev(largest)(p), jax.jacfwd(exact)(p), rtol=0, atol=1e-12)
    of_top, of_peak = jax.jacfwd(jax.jacrev(largest))(p)
    assert_allclose(of_top, np.zeros((3, 3)), rtol=0, atol=1e-12)
    assert_allclose(of_peak, jax.hessian(exact)(p)[1], rtol=0, atol=1e-12)


class Driven(jf.System):
    """x' = −x + cos ωt, seen with a period that ω does not change."""

    omega: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return -x + jnp.cos(self.omega * t)


def test_the_derivative_by_a_frequency_beside_the_period_grows_with_time():
    """It repeats at ω = 1, where elapsed times restart, but its change with ω does not."""
    first, count = 6, 2

    def mean(omega):
        average = {"p": lambda t, x: x[0] * jnp.cos(t)}
        run = dict(transient=first, samples=count, steps=40, compact=True)
        return jf.settled_average(Driven(omega), average, jnp.zeros(1), **run).averages["p"]

    def exact(w):
        t = jnp.linspace(first, first + count, 8001)[:-1] * 2 * jnp.pi
        x = (jnp.cos(w * t) + w * jnp.sin(w * t) - jnp.exp(-t)) / (1 + w * w)
        dt = 2 * jnp.pi * count / t.size
        ends = jnp.stack([t[0], t[-1] + dt])
        edge = (jnp.cos(w * ends) + w * jnp.sin(w * ends)) / (1 + w * w) * jnp.cos(ends)
        return jnp.mean(x * jnp.cos(t)) + (edge[1] - edge[0]) / (2 * t.size)

    w = jnp.ones(())
    want = jax.jvp(exact, (w,), (w,))[1]
    assert_allclose(jax.grad(mean)(w), want, rtol=1e-5)


class Damped(jf.System):
    """x' = −k x + F cos ωt."""

    k: jax.Array
    force: jax.Array
    omega: jax.Array

    def vector_field(self, t, x, side):
        return -self.k * x + self.force * jnp.cos(self.omega * t)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def test_a_lane_that_fails_takes_nothing_from_the_gradient_of_others():
    """The mean of x² is F²/(2 (k² + ω²)) for x' = −k x + F cos ωt, with the period 2π/ω."""

    def total(p):
        def one(x0):
            average = {"power": lambda t, x: x[0] ** 2, "rms": jf.RMS(lambda t, x: x[0])}
            run = dict(transient=8, samples=2, steps=20, compact=True)
            found = jf.settled_average(Damped(*p), average, x0, **run)
            return found.averages["power"] + found.averages["rms"], found.result

        means, results = jax.vmap(one)(jnp.asarray([[0.0], [np.nan], [1.0]]))
        return jnp.where(results == jf.RESULTS.successful, means, 0.0).sum(), results

    def exact(p):
        power = p[1] ** 2 / (2 * (p[0] ** 2 + p[2] ** 2))
        return 2 * (power + jnp.sqrt(power))

    p = jnp.asarray([1.0, 0.8, 1.3])
    slope, results = jax.jit(jax.grad(total, has_aux=True))(p)
    assert list(jf.RESULTS.names(results)) == ["successful", "nonfinite", "successful"]
    assert_allclose(slope, jax.grad(exact)(p), rtol=0, atol=1e-6)


class Ringing(jf.System):
    """x'' + x'/5 + x = 0."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - 0.2 * x[1]])


@pytest.mark.parametrize("steps", [4, 40])
def test_extremes_at_a_section_are_those_between_its_crossings(steps):
    """The velocity falls from the first crossing of x = 0 on, up to the next one; it was larger
    before it."""
    w = np.sqrt(0.99)
    exact = np.exp(-0.1 * (np.pi - np.arctan(w / 0.1)) / w)
    found = jf.settled_average(
        Ringing(),
        {"top": jf.Maximum(lambda t, x, side: x[1])},
        jnp.array([-1.0, 0.0]),
        transient=0,
        samples=2,
        steps=steps,
        section=jf.Section(lambda t, x: x[0], 1),
        max_return=20.0,
    )
    np.testing.assert_allclose(found.averages["top"], exact, rtol=0, atol=1e-8)


class Resonant(jf.System):
    """x'' = −x − d x' + cos t, which settles to x = sin t/d."""

    damping: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - self.damping * x[1] + jnp.cos(t)])


@pytest.mark.release
@pytest.mark.parametrize(
    "steps", [pytest.param(jf.Adaptive(1e-6, 1e-9), marks=pytest.mark.release), 2]
)
def test_extremes_within_steps_as_long_as_a_period(steps):
    # The cubic through both ends of such a step is 3 % off, or has no maximum.
    average = {
        "high": jf.Maximum(lambda t, x, side: x[0]),
        "low": jf.Minimum(lambda t, x, side: x[0]),
    }

    def amplitude(damping):
        kept = {"transient": 40, "samples": 3, "steps": steps, "stepper": jf.Taylor(32)}
        found = jf.settled_average(Resonant(damping), average, jnp.zeros(2), **kept)
        return jnp.stack([found.averages["high"], found.averages["low"]])

    # A batch, in which steps without contacts go another way than in a single lane.
    dampings = jnp.linspace(0.4, 0.8, 9)
    value, slope = jax.jit(jax.vmap(lambda d: jax.jvp(amplitude, (d,), (1.0,))))(dampings)
    np.testing.assert_allclose(value * dampings[:, None], [[1, -1]] * 9, rtol=1e-6)
    np.testing.assert_allclose(slope * dampings[:, None] ** 2, [[-1, 1]] * 9, rtol=1e-5)


class Turning(jf.System):
    """A rotation of frequency one."""

    rate: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([self.rate * x[1], -self.rate * x[0]])


def test_averages_at_a_section_late_in_single_precision():
    """What is constant is its own mean, up to the rounding of the times. A step of 1/40 is 102 or
    103 of their spacings, and in a sum that has grown since the start each adds a number that has
    been rounded up, or down, every time."""
    loads = np.array([9.81, 3.3, 5.7, 6.9], np.float32)
    found = jf.settled_average(
        Turning(np.float32(1.0)),
        {"loads": lambda t, x, side: loads * jnp.ones_like(t), "side": lambda t, x: x[0]},
        np.array([1.0, 0.0], np.float32),
        section=jf.Section(lambda t, x: x[1], direction=-1),
        max_return=8.0,
        transient_time=3000.0,
        samples=12,
        steps=40,
        stepper=jf.RK4(),
    )
    error = 2 * np.spacing(np.float32(3069)) / (11 * 2 * np.pi)
    np.testing.assert_allclose(found.averages["loads"], loads, rtol=error)
    np.testing.assert_allclose(found.averages["side"], 0, rtol=0, atol=2 * error)


@pytest.mark.slow
def test_derivatives_by_numbers_that_functions_close_over():
    """x' = -x + k cos t from its orbit, x = k (cos t + sin t)/2, and loads j x or j x²."""

    def averages(k, j):
        class Lag(jf.System):
            slides = False
            period = 2 * np.pi

            def vector_field(self, t, x, side):
                return -x + k * jnp.cos(t)

            def switching(self, t, x):
                return x[0]

        loads = {
            "mean": lambda t, x, side: j * x[0] ** 2,
            "largest": jf.Maximum(lambda t, x, side: j * x[0]),
            "crossed": jf.EventSum(lambda t, before, after, surfaces: j * surfaces),
        }
        run = {"transient": 1, "samples": 2, "compact": True}
        return jf.settled_average(Lag(), loads, jnp.stack([k / 2]), **run).averages

    def by_hand(k, j):
        return {"mean": j * k**2 / 4, "largest": j * k / np.sqrt(2), "crossed": 4 * j + 0 * k}

    for transformed in (jax.jacfwd, jax.jacrev):
        found, wanted = (transformed(f, (0, 1))(1.7, 0.6) for f in (averages, by_hand))
        for name, rates in wanted.items():
            assert_allclose(found[name], rates, rtol=1e-8, atol=1e-12)
