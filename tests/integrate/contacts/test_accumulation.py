"""Infinitely many switchings in a finite time: twisting controllers and spirals into a corner.

The twisting controller is that of Levant (1993), in the form in which Siconos solves it; with a
load on it no closed form is known, and derivatives are compared with differences. On a spiral of
two relays |x1| + |x2| falls at a constant rate.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil import EventKind
from jaxfil.model.outcomes import RESULTS, outcome_names


class Twisting(jf.System):
    """x1'' = -10 sgn x1 - 3 sgn x1' + load cos t about x1 = point, and z' = -z + x1 - point."""

    load: float = 0.0
    point: float = 0.0

    def vector_field(self, t, x, side):
        push = -10.0 * side[0] - 3.0 * side[1] + self.load * jnp.cos(t)
        return jnp.stack([x[1], push, x[0] - self.point - x[2]])

    def switching(self, t, x):
        return jnp.stack([x[0] - self.point, x[1]])


class Spiral(jf.System):
    """x' = M sgn x, round the origin and into it."""

    rate: float

    def vector_field(self, t, x, side):
        inward, round_ = self.rate * side, jnp.stack([-side[1], side[0]])
        return round_ - inward

    def switching(self, t, x):
        return x


def turned(angle, a, b):
    """A vector in coordinates turned by an angle."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * a + s * b, c * b - s * a


class Turned(jf.System):
    """The unloaded controller alone, in such coordinates."""

    angle: jax.Array

    def vector_field(self, t, x, side):
        _, velocity = turned(-self.angle, x[0], x[1])
        return jnp.stack(turned(self.angle, velocity, -10.0 * side[0] - 3.0 * side[1]))

    def switching(self, t, x):
        return jnp.stack(turned(-self.angle, x[0], x[1]))


def at_rest(a, b):
    """When the unloaded controller has come to rest from (a, b), both positive: parabolas."""
    top = a + b * b / 26
    turn = jnp.sqrt(2 * top / 7) + jnp.sqrt(14 * top) / 13
    return b / 13 + turn / (1 - jnp.sqrt(7 / 13))


def last_event(sol):
    return sol.events.ts[sol.num_events - 1]


def run(system, x0, t1, dt, **options):
    return jf.solve(system, jnp.asarray(x0), 0.0, t1, dt, max_events=2000, **options)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [1.0, 0.1, 0.03])
def test_twisting_controller_comes_to_rest(dt):
    sol = run(Twisting(), [10.0, 10.0, 1.0], 13.0, dt)
    assert_allclose(last_event(sol), at_rest(10.0, 10.0), rtol=0, atol=3e-13)
    assert_allclose(sol.x_final[:2], 0.0, rtol=0, atol=0)
    np.testing.assert_array_equal(sol.mode_final, [0, 0])
    i = int(sol.num_events) - 1
    assert sol.events.members[i].all() and sol.events.kinds[i] == EventKind.stick.value
    assert i < 150


def test_twisting_controller_holds_against_a_load():
    # While |load| < 7 it comes to rest; held there it gives way to more than 13 alone.
    ends = [run(Twisting(load), [1.0, 1.0, 1.0], 20.0, 0.1).x_final for load in (0.0, 4.0, 6.0)]
    for x in ends:
        assert_allclose(x[:2], 0.0, rtol=0, atol=0)
    # What x3 was moved by on the way has decayed by e^-17.
    assert_allclose([x[2] for x in ends], 0.0, rtol=0, atol=1e-7)


@pytest.mark.parametrize("point, near", [(1.0, 1e-8), (-1e3, 1e-6)])
def test_point_of_rest_anywhere(point, near):
    # x1 is known to eps |point|, and x2 with it to the square root: so is the time.
    at_zero = last_event(run(Twisting(2.0), [10.0, 10.0, 1.0], 20.0, 0.1))
    sol = run(Twisting(2.0, point), [10.0 + point, 10.0, 1.0], 20.0, 0.1)
    assert_allclose(last_event(sol), at_zero, rtol=0, atol=near)
    assert_allclose(sol.x_final[:2], [point, 0.0], rtol=0, atol=0)


def test_what_rides_along_is_carried_to_the_limit():
    # x3 to its closed form between the contacts of a run that stops short of the limit.
    t1 = float(at_rest(1.0, 1.0))
    whole = run(Twisting(), [1.0, 1.0, 1.0], t1 + 0.5, 0.25)
    short = run(Twisting(), [1.0, 1.0, 1.0], t1 - 1e-6, 1e-3)
    assert_allclose(whole.x_final[2], short.x_final[2] * np.exp(-0.5 - 1e-6), rtol=0, atol=1e-13)


@pytest.mark.release
def test_derivatives_of_the_limit_are_exact():
    # Of a method of order three, which is exact on parabolas: second derivatives compile for long.
    def time(x):
        return last_event(run(Twisting(), [x[0], x[1], 0.0], 6.0, 0.1, stepper=diffrax.Bosh3()))

    # Of one pair of directions after the other, which compiles in half the time, with the slopes.
    @jax.jit
    def second(x, u, v):
        return jax.jvp(lambda x: jax.jvp(time, (x,), (u,))[1], (x,), (v,))

    x0, eye = jnp.array([2.0, 1.0]), jnp.eye(2)
    exact = jax.jit(jax.grad(lambda x: at_rest(*x)))(x0)
    hessian = jax.jit(jax.hessian(lambda x: at_rest(*x)))(x0)
    slopes, curvatures = zip(*(second(x0, u, v) for u in eye for v in eye), strict=True)
    assert_allclose(np.reshape(slopes, (2, 2)), np.stack([exact, exact], axis=1), rtol=1e-11)
    assert_allclose(np.reshape(curvatures, (2, 2)), hessian, rtol=1e-8)


@pytest.mark.slow
def test_derivatives_of_what_follows():
    def end(p):
        x = run(Twisting(p[0]), p[1:], 7.0, 0.05, stepper=diffrax.Tsit5()).x_final[2]
        return x, x

    slopes_and_value = jax.jit(jax.jacfwd(end, has_aux=True))
    p, step = jnp.array([1.0, 1.0, 1.0, 1.0]), 1e-5
    ends = [[slopes_and_value(p + d)[1] for d in (d, -d)] for d in step * jnp.eye(4)]
    differences = np.subtract(*np.transpose(ends)) / (2 * step)
    assert_allclose(slopes_and_value(p)[0], differences, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("rate, x0, dt", [(0.3, 1.0, 0.03), (0.3, 1.0, 1.0), (0.00125, 0.01, 0.1)])
def test_spirals_end_in_their_point(rate, x0, dt):
    # The last one turns 370 times, each time by a hundredth less.
    sol = run(Spiral(rate), [x0, 0.0], 10.0, dt)
    assert_allclose(last_event(sol), x0 / (2 * rate), rtol=1e-12)
    assert_allclose(sol.x_final, 0.0, rtol=0, atol=0)
    np.testing.assert_array_equal(sol.mode_final, [0, 0])


@pytest.mark.slow
def test_spirals_outward_and_round_do_not_end():
    for rate in (-0.1, 0.0):
        sol = run(Spiral(rate), [1.0, 0.0], 5.0, 1.0)
        assert_allclose(abs(sol.x_final).sum(), 1.0 - 10.0 * rate, rtol=1e-13)


@pytest.mark.slow
def test_limit_whose_mode_is_rounding_is_told_or_right():
    """In turned coordinates rounding may move the state off the line x1' = 0, and then nothing goes
    on from the limit. Whether it does depends on the processor; where it does not, the motion
    rests, within 32 eps of the terms of H, where contacts are located."""

    @jax.jit
    @jax.vmap
    def ends(angle):
        x0 = jnp.stack(turned(angle, 2.0, 1.0))
        sol = run(Turned(angle), x0, 10.0, 0.1, throw=False)
        return sol.result, sol.t_final, last_event(sol), sol.x_final, sol.mode_final

    results, t_final, last, x, modes = ends(jnp.pi / 6 + jnp.linspace(0, 1, 8))
    rests = np.asarray(results == RESULTS.successful)
    told = outcome_names(results)[~rests]
    assert {*told.tolist()} <= {"zeno", "nonunique", "mode_undecided"}
    assert_allclose(np.where(rests, last, t_final), at_rest(2.0, 1.0), rtol=1e-12)
    np.testing.assert_array_equal(modes[rests], 0)
    assert_allclose(x[rests], 0.0, rtol=0, atol=32 * np.finfo(float).eps * np.sqrt(5.0))


@pytest.mark.release
def test_batch_of_controllers():
    @jax.jit
    @jax.vmap
    def ends(x):
        x0 = jnp.stack([x, x, 0.0])
        sol = run(Twisting(), x0, 13.0, 0.1, throw=False, stepper=diffrax.Bosh3())
        return sol.result == RESULTS.successful, last_event(sol), at_rest(x, x)

    successful, found, exact = ends(jnp.linspace(0.5, 10.0, 16))
    assert successful.all()
    assert_allclose(found, exact, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_single_precision():
    with jax.enable_x64(False):
        sol = run(Twisting(), np.float32([10.0, 10.0, 1.0]), 13.0, 0.1)
        assert_allclose(last_event(sol), at_rest(10.0, 10.0), rtol=4e-6)
        np.testing.assert_array_equal(sol.mode_final, [0, 0])


class TwoBalls(jf.System):
    """Two balls above a floor, independent of each other, in units in which gravity is 2."""

    slides = False

    def vector_field(self, t, x, side):
        down = -2 * jnp.ones_like(t)
        return jnp.stack([x[1], down, x[3], down])

    def switching(self, t, x):
        return x[::2]

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, x.at[1].mul(-0.5), x.at[3].mul(-0.5))


def one_ball(v, t):
    """Height and velocity at t of a ball thrown up from the floor at v, by its flights of lengths
    v, v/2, v/4, …"""
    if t >= 2 * v:
        return 0.0, 0.0
    while t >= v:
        t, v = t - v, v / 2
    return t * (v - t), v - 2 * t


@pytest.mark.release
def test_balls_that_come_to_rest_one_after_the_other():
    """Their impacts alternate, and every second one is part of a turn of constant ratio; the
    other ball is below the floor at the limit of these turns."""
    second = jnp.array([0.515, 0.515, 0.505, 0.75, 0.4, 0.98])
    ends = jnp.array([1.01, 1.2, 1.0, 1.1, 0.9, 1.5])

    def end(v, t1):
        x0 = jnp.stack([0 * v, 0.5 + 0 * v, 0 * v, v])
        return jf.solve(TwoBalls(), x0, 0.0, t1, 0.1, max_events=256, compact=True).x_final

    for v, t1, x in zip(second, ends, jax.vmap(end)(second, ends), strict=True):
        exact = [*one_ball(0.5, float(t1)), *one_ball(float(v), float(t1))]
        assert_allclose(x, exact, atol=1e-12)


def twisting(t):
    """(x, x') of the controller from (0, 1) without a load, half turn by half turn: up at 13, down
    at 7."""
    q, start, v, sign = np.sqrt(7 / 13), 0.0, 1.0, 1.0
    for _ in range(200):
        up, top = v / 13, v * v / 26
        down, tau = np.sqrt(2 * top / 7), t - start
        if tau <= up:
            return sign * np.array([v * tau - 6.5 * tau**2, v - 13 * tau])
        if tau <= up + down:
            return sign * np.array([top - 3.5 * (tau - up) ** 2, -7 * (tau - up)])
        start, v, sign = start + up + down, v * q, -sign
    return np.zeros(2)


@pytest.mark.release
def test_what_is_saved_follows_all_turns():
    """Between saved steps too."""
    x0, ts = jnp.array([0.0, 1.0, 0.0]), np.linspace(0.0, 1.0, 401)
    dense = jf.solve(Twisting(), x0, 0.0, 1.0, 0.25, saveat=diffrax.SaveAt(dense=True))
    exact = np.array([twisting(t) for t in ts])
    assert_allclose(dense.evaluate(ts)[:, :2], exact, rtol=0, atol=1e-7)
    steps = jf.solve(Twisting(), x0, 0.0, 1.0, 0.25, saveat=diffrax.SaveAt(steps=True))
    n = int(steps.stats["num_saved"])
    exact = np.array([twisting(float(t)) for t in steps.ts[:n]])
    assert_allclose(steps.xs[:n, :2], exact, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_sections_see_all_turns():
    """Down through x = 1e-4, from the top v²/26 of each of the turns that are high enough."""
    level, q = 1e-4, np.sqrt(7 / 13)
    v = q ** np.arange(0, 10, 2)
    start = (1 / 13 + np.sqrt(1 / 91)) * (1 - v) / (1 - q)
    exact = start + v / 13 + np.sqrt(2 * (v * v / 26 - level) / 7)
    section = jf.Section(lambda t, x: x[0] - level, -1)
    x0 = jnp.array([0.0, 1.0, 0.0])
    sol = jf.solve(Twisting(), x0, 0.0, 1.0, 0.25, sections=section)
    assert int(sol.num_crossings) == 5
    assert_allclose(sol.crossings.ts[:5], exact, rtol=0, atol=1e-10)


class Band(jf.System):
    """x' = ±1 between two thresholds, each of which is moved to q times the other one when that is
    reached, but no nearer to zero than a least width."""

    q: jax.Array
    least: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], 0 * t, 0 * t, 0 * t])

    def switching(self, t, x):
        return jnp.stack([x[2] - x[0], x[0] - x[3]])

    def reset(self, t, x, surface):
        top = x.at[1].set(-1.0).at[3].set(-jnp.maximum(self.q * x[2], self.least))
        bottom = x.at[1].set(1.0).at[2].set(jnp.maximum(-self.q * x[3], self.least))
        return jnp.where(surface == 0, top, bottom)


class Gripper(jf.System):
    """A puck of speed 1 between two plates that approach it at `q` each, up to a hit at a distance
    below the least one, which latches them."""

    q: jax.Array
    least: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], 0 * t, -self.q * (1 - x[3]), 0 * t])

    def switching(self, t, x):
        return jnp.stack([x[2] - x[0], x[2] + x[0]])

    def reset(self, t, x, surface):
        latch = jnp.where(x[2] < self.least, 1.0, x[3])
        return jnp.stack([x[0], -x[1], x[2], latch])


def band(q, least, t1):
    t, x, v, a, b, count = 0.0, 0.0, 1.0, 1.0, -1.0, 0
    while (dt := (a - x) if v > 0 else (x - b)) and t + dt < t1:
        t, count = t + dt, count + 1
        if v > 0:
            x, v, b = a, -1.0, -max(q * a, least)
        else:
            x, v, a = b, 1.0, max(-q * b, least)
    return np.array([x + v * (t1 - t), v, a, b]), count


def gripper(q, least, t1):
    t, x, v, gap, latch, count = 0.0, 0.0, 1.0, 1.0, 0.0, 0
    while t + (dt := (gap - v * x) / (1 + q * (1 - latch))) < t1:
        t, x, v, gap, count = t + dt, x + v * dt, -v, gap - q * (1 - latch) * dt, count + 1
        latch = float(gap < least)
    dt = t1 - t
    return np.array([x + v * dt, v, gap - q * (1 - latch) * dt, latch]), count


@pytest.mark.release
@pytest.mark.parametrize(
    "system, exact, t1, last",
    [(Band, band, 4.3007, "successful"), (Gripper, gripper, 3.2003, "zeno")],
)
def test_turns_that_a_reset_will_end_have_no_limit(system, exact, t1, last):
    """Without a least width they have one, at which the band rests. The plates do not, and no
    motion is left between them."""
    start = jnp.array([0.0, 1.0, 1.0, -1.0 if system is Band else 0.0])
    p = np.array([[0.5, 2e-3], [0.4, 3e-3], [0.45, 0.05], [0.5, 0.0]])

    @jax.vmap
    def run(p):
        def end(p):
            sol = jf.solve(system(*p), start, 0.0, t1, 0.3, stepper=jf.RK4(), throw=False)
            return sol.x_final, (sol.x_final, sol.num_events, sol.result)

        return jax.jacfwd(end, has_aux=True)(p)

    slopes, (xs, counts, results) = run(jnp.asarray(p))
    assert outcome_names(results).tolist() == ["successful"] * 3 + [last]
    for one, x, count, slope in zip(p[:3], xs, counts, slopes, strict=False):
        right, number = exact(*one, t1)
        assert count == number
        assert_allclose(x, right, atol=1e-9)
        h = 1e-7 * np.eye(2)
        by = [(exact(*(one + d), t1)[0] - exact(*(one - d), t1)[0]) / 2e-7 for d in h]
        assert_allclose(slope, np.transpose(by), rtol=1e-5, atol=1e-5)
    assert counts[3] < 20
    assert_allclose(xs[3, [0, 2]], 0.0, atol=1e-14)


class Tanks(jf.System):
    """Two leaking tanks; the inflow is moved to one of them when it is empty (Alur and Henzinger,
    1997)."""

    leaks: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[2] - self.leaks[0], 1 - x[2] - self.leaks[1], 0 * t])

    def switching(self, t, x):
        return x[:2]

    def reset(self, t, x, surface):
        return x.at[2].set(jnp.where(surface == 0, 1.0, 0.0))


@pytest.mark.slow
def test_a_limit_that_no_reaction_can_hold_has_no_continuation():
    """Both tanks are empty, and together they leak faster than they fill."""
    leaks = jnp.array([[0.7, 0.8], [0.9, 0.6], [0.6, 0.65]])

    @jax.vmap
    def run(leaks):
        start = jnp.array([1.0, 0.6, 1.0])
        sol = jf.solve(Tanks(leaks), start, 0.0, 8.0, 0.5, stepper=jf.RK4(), throw=False)
        return sol.result, sol.t_final

    results, times = run(leaks)
    assert outcome_names(results).tolist() == ["zeno"] * 3
    assert_allclose(times, 1.6 / (leaks.sum(1) - 1), rtol=1e-12)


class Dosed(jf.System):
    """x'' = −2 sgn x − sgn x', at rest at t = 3.027, and y' = 1 from t = 2.96 to 3."""

    rate: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -2 * side[0] - side[1], self.rate * 0.5 * (1 + side[2])])

    def switching(self, t, x):
        return jnp.stack([x[0], x[1], (t - 2.96) * (3.0 - t)])


@pytest.mark.release
def test_a_surface_that_is_crossed_and_crossed_back_before_the_limit_is_seen():
    # The turns agree from t = 2.938 on.
    sol = jf.solve(Dosed(jnp.array(1.0)), jnp.array([-0.5, 0.5, 0.0]), 0.0, 4.0, 0.8)
    assert_allclose(sol.x_final, [0, 0, 0.04], rtol=0, atol=1e-12)


class Landing(jf.System):
    """Balls with y_i'' = −1 on a floor, each with an e of its own, and z_i' the reaction of it."""

    slides = False
    e: jax.Array

    def vector_field(self, t, x, side, reaction):
        v = x[2:4]
        return jnp.concatenate([v, reaction - 1.0, reaction])

    def switching(self, t, x):
        return x[:2]

    def reset(self, t, x, surface):
        return x.at[2 + surface].multiply(-self.e[surface])


@pytest.mark.slow
def test_balls_that_come_to_rest_at_one_time_have_the_derivatives_of_each():
    # From rest at h a ball is at rest from T = √(2h) (1 + 2e/(1 − e)) on, and z = t − T. The second
    # one rests at the same time, just after it and long before it.
    e = jnp.array([[0.5, 0.5], [0.5, 0.8], [0.5, 0.8], [0.8, 0.5]])
    after = jnp.array([0.0, 0.0, 1e-6, -1.0])
    lasts = 1 + 2 * e / (1 - e)
    rest = np.sqrt(2.0) * lasts[:, 0]
    h = jnp.stack([jnp.ones(4), ((rest + after) / lasts[:, 1]) ** 2 / 2], axis=1)

    def end(h, e, t1):
        x0 = jnp.concatenate([h, jnp.zeros(4)])
        sol = jf.solve(Landing(e), x0, 0.0, t1, 0.05, throw=False)
        return sol.x_final[4:], (sol.result, sol.x_final[4:])

    jacobian = jax.jit(jax.vmap(jax.jacfwd(end, has_aux=True)))
    slopes, (results, z) = jacobian(h, e, rest + 1.0)
    assert (outcome_names(results) == "successful").all()
    assert_allclose(z, 1.0 - np.stack([0 * after, after], axis=1), atol=1e-10)
    exact = -np.stack([rest, rest + after], axis=1) / (2 * h)
    # Contacts of both within the rounding of times are one landing, which relates their times to
    # each other to within that rounding in units of a flight.
    for found, own in zip(slopes, exact, strict=True):
        assert_allclose(found, np.diag(own), atol=1e-4 * abs(own).max())


class Controllers(jf.System):
    """Controllers x_i'' = −2 sgn x_i − sgn x_i', and z_i' = 1 while x_i approaches zero."""

    def vector_field(self, t, x, side):
        _, v, _ = jnp.split(x, 3)
        near, way = jnp.split(side, 2)
        return jnp.concatenate([v, -2.0 * near - way, 0.5 * (1 - near * way)])

    def switching(self, t, x):
        return x[: 2 * len(x) // 3]


@pytest.mark.slow
def test_controllers_that_come_to_rest_at_one_time_have_no_derivative():
    # From rest at q a controller approaches zero for √(2q), and departs for a third of that time,
    # to −q/3.
    def end(q):
        x0 = jnp.concatenate([q, jnp.zeros(4)])
        sol = jf.solve(Controllers(), x0, 0.0, 9.0, 0.05, throw=False)
        return sol.x_final[4:], (sol.result, sol.x_final[4:])

    starts = jnp.array([[1.0, 1.0], [1.0, 1.3]])
    slopes, (results, z) = jax.jit(jax.vmap(jax.jacfwd(end, has_aux=True)))(starts)
    assert (outcome_names(results) == "successful").all()
    near = np.sqrt(2 * starts) / (1 - np.sqrt(1 / 3))
    exact = near + (9.0 - 4 * near / 3) / 2
    assert_allclose(z, exact, rtol=1e-9)
    assert np.isnan(slopes[0]).all()
    assert_allclose(slopes[1], np.diag(near[1] / 6 / starts[1]), atol=1e-9)


class Rocking(jf.System):
    """A block of unit mass on two legs at ±b, with the moment of inertia J; gravity is 1. The
    impact of a leg takes its velocity."""

    J: jax.Array
    b: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[2], x[3], -jnp.ones_like(t), jnp.zeros_like(t)])

    def switching(self, t, x):
        return jnp.stack([x[0] - self.b * x[1], x[0] + self.b * x[1]])

    def reset(self, t, x, surface):
        arm = jnp.where(surface == 0, -self.b, self.b)
        push = -(x[2] + arm * x[3]) / (1 + self.b**2 / self.J)
        return x.at[2].add(push).at[3].add(arm * push / self.J)


@pytest.mark.slow
def test_a_block_rocks_to_rest():
    # On one leg the other one, raised by h, falls at 1 − ρ, with ρ = (J − b²)/(J + b²), and from
    # impact to impact of either one its velocity is ρ times smaller.
    J, b, h = jnp.array([1.0, 1.0, 2.0]), jnp.array([0.6, 0.9, 0.7]), 0.3

    def rest(J, b):
        ratio = (J - b**2) / (J + b**2)
        fall = 1 - ratio
        return jnp.sqrt(2 * h / fall) + 2 * ratio * jnp.sqrt(2 * h * fall) / fall**2

    def last(J, b, t1):
        x0 = jnp.stack([h / 2 + 0 * b, h / (2 * b), 0 * b, 0 * b])
        sol = jf.solve(Rocking(J, b), x0, 0.0, t1, 0.05, max_events=256, throw=False)
        return sol.events.ts[sol.num_events - 1], sol

    found = jax.jit(jax.vmap(jax.value_and_grad(last, (0, 1), has_aux=True)))
    (times, sol), slopes = found(J, b, rest(J, b) + 2)
    assert (outcome_names(sol.result) == "successful").all()
    np.testing.assert_array_equal(sol.mode_final, 2)
    assert_allclose(times, rest(J, b), rtol=1e-11)
    assert_allclose(slopes, jax.vmap(jax.grad(rest, (0, 1)))(J, b), rtol=1e-7)
