"""Fields that feel reactions: dry friction proportional to the force that holds a motion at rest.

The block, the rod and the ladder are compared with closed forms, or with their own equations of
motion, integrated by SciPy with the contact forces eliminated by hand.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxfil as jf
from jaxfil import RESULTS

G = 9.81


class Block(jf.System):
    """A block (x, v) pushed by a force on a table that shakes, at a height y over it; it is thrown
    back with friction."""

    mu: jax.Array
    shake: jax.Array
    push: jax.Array
    e: jax.Array

    omega = 15.0

    def vector_field(self, t, x, side, reaction):
        table = -self.shake * self.omega**2 * jnp.sin(self.omega * t)
        friction = -self.mu * reaction[0] * side[1]
        return jnp.stack([x[1], self.push + friction, x[3], -G - table + reaction[0]])

    def switching(self, t, x):
        return jnp.stack([x[2], x[1]])

    def reset(self, t, x, surface):
        rub = jnp.minimum(abs(x[1]), self.mu * (1 + self.e) * abs(x[3]))
        bounced = x.at[3].multiply(-self.e).at[1].add(-jnp.sign(x[1]) * rub)
        return jnp.where(surface == 0, bounced, x)


class Leaning(Block):
    """The same without saying that the table holds it: friction is all that is said."""

    def vector_field(self, t, x, side, reaction):
        table = -self.shake * self.omega**2 * jnp.sin(self.omega * t)
        friction = -self.mu * reaction[0] * side[1]
        return jnp.stack([x[1], self.push + friction, x[3], -G - table])

    def reset(self, t, x, surface):
        # What the reset does, the reaction does too.
        return jnp.where(surface == 0, x.at[3].multiply(-self.e), x)


def block(mu=0.5, shake=0.02, push=3.0, e=0.0, of=Block):
    return of(*(jnp.asarray(v, float) for v in (mu, shake, push, e)))


def pushed(mu, shake, push, t1):
    """Times of slip and stick, and x and v at t1, of a block at rest on a table that it does not
    leave."""
    w, x, t, times = Block.omega, 0.0, 0.0, []

    def spare(s):
        return mu * (G - shake * w * w * np.sin(w * s)) - push

    def first_root(f, t):
        s = np.linspace(t + 1e-7, t1, 20001)
        k = np.flatnonzero((f(s)[:-1] > 0) & (f(s)[1:] <= 0))
        return brentq(f, s[k[0]], s[k[0] + 1], xtol=1e-15) if len(k) else None

    while True:
        if spare(t) > 0:
            t = first_root(spare, t)
            if t is None:
                return times, x, 0.0
            times.append(t)

        def velocity(s, t=t):
            return (push - mu * G) * (s - t) - mu * shake * w * (np.cos(w * s) - np.cos(w * t))

        def way(s, t=t):
            far = s - t
            turn = -mu * shake * (np.sin(w * s) - np.sin(w * t) - w * np.cos(w * t) * far)
            return (push - mu * G) * far**2 / 2 + turn

        end = first_root(velocity, t)
        if end is None:
            return times, x + way(t1), velocity(t1)
        times.append(end)
        x, t = x + way(end), end


LANES = [(0.5, 0.02, 3.0), (0.35, 0.03, 3.2), (0.2, 0.02, 3.0), (1.0, 0.01, 3.0)]


def solve(system, x0, t1, dt=0.01, t0=0.0, **options):
    return jf.solve(system, jnp.asarray(x0), t0, t1, dt, throw=False, **options)


@jax.jit
@jax.vmap
def moved(p, e, x0, t0, t1):
    """The motions of blocks, and the slopes of the way by (μ, shake, push): one program for all
    that is asked of them. Of each the normal force and the friction are observed 20 times."""

    def forces(t, x, side, reaction):
        return jnp.stack([reaction[0], -p[0] * reaction[0] * side[1]])

    def way(p):
        saved = diffrax.SaveAt(ts=t0 + (t1 - t0) * jnp.linspace(0.05, 1.0, 20))
        sol = solve(block(*p, e), x0, t1, t0=t0, saveat=saved, observe=forces)
        return sol.x_final[0], sol

    return jax.jacfwd(way, has_aux=True)(p)


def motions(lanes=LANES, e=0.0, x0=(0.0, 0.0, 0.0, 0.0), t0=0.0, t1=2.0):
    n = len(LANES)
    start = jnp.broadcast_to(jnp.asarray(x0), (n, 4))
    e, t0, t1 = (jnp.full(n, v) for v in (e, t0, t1))
    return moved(jnp.broadcast_to(jnp.asarray(lanes), (n, 3)), e, start, t0, t1)


def motion(lane=(0.5, 0.02, 3.0), **options):
    """Of one block."""
    return jax.tree.map(lambda leaf: leaf[0], motions([lane], **options))


@pytest.mark.slow
@pytest.mark.parametrize("of", [pytest.param(Block, marks=pytest.mark.release), Leaning])
def test_friction_of_a_block_on_a_shaken_table(of):
    if of is Block:
        _, sol = motions()
    else:
        blocks = jax.vmap(lambda *v: block(*v, of=of))(*jnp.array(LANES).T)
        sol = jax.vmap(lambda b: solve(b, np.zeros(4), 2.0))(blocks)
    assert np.all(np.asarray(sol.result == RESULTS.successful))
    for i, lane in enumerate(LANES):
        times, x, v = pushed(*lane, 2.0)
        assert int(sol.num_events[i]) == len(times)
        assert_allclose(sol.events.ts[i][: len(times)], times, rtol=0, atol=1e-11)
        assert_allclose(sol.x_final[i], [x, v, 0, 0], rtol=0, atol=1e-12)


@pytest.mark.release
def test_derivatives_through_friction_that_feels_a_reaction():
    lane = 0.5, 0.02, 3.0
    slope, _ = motion(lane, t1=1.0)
    for i in range(3):
        step = np.eye(3)[i] * 1e-6
        high, low = (pushed(*(np.array(lane) + k * step), 1.0)[1] for k in (1, -1))
        assert_allclose(slope[i], (high - low) / 2e-6, rtol=1e-7, atol=0)


@pytest.mark.slow
def test_runs_chained_at_a_slip_are_the_whole_run():
    times, x, v = pushed(0.5, 0.02, 3.0, 2.0)
    state, t = jnp.zeros(4), 0.0
    for t1 in (times[0], 0.12, times[1], 2.0):
        _, sol = motion(x0=state, t1=t1, t0=t)
        assert sol.result == RESULTS.successful
        state, t = sol.x_final, t1
    assert_allclose(state, [x, v, 0, 0], rtol=0, atol=1e-12)


def test_friction_and_bounces_that_die_out():
    # All that a floor gives until it holds the block is g t, whatever the bounces: μ of it is
    # friction, in the impacts at first and in the slide then.
    mu, v0, e, h = 0.3, 8.0, 0.5, 1.0
    stop, rest = v0 / (mu * G), np.sqrt(2 * h / G) * (1 + e) / (1 - e)
    _, sol = motion((mu, 0.0, 0.0), e=e, x0=(0.0, v0, h, 0.0), t1=4.0)
    assert sol.result == RESULTS.successful
    assert sol.mode_final.tolist() == [2, 0]
    assert rest < stop
    last = int(sol.num_events) - 1
    assert_allclose(sol.events.ts[last], stop, rtol=1e-12, atol=0)
    assert sol.events.members[last].tolist() == [False, True]


def test_what_holds_a_block_is_observed():
    _, sol = motion(t1=1.0)
    assert_allclose(sol.ts, np.linspace(0.05, 1.0, 20), rtol=1e-15, atol=0)
    normal = G - 0.02 * 225 * np.sin(15 * np.asarray(sol.ts))
    stuck = np.asarray(sol.modes)[:, 1] == 0
    assert stuck.any() and not stuck.all()
    friction = np.where(stuck, -3.0, -0.5 * normal)
    assert_allclose(sol.observed, np.stack([normal, friction], axis=1), rtol=1e-12, atol=0)


@pytest.mark.release
def test_single_precision():
    b = jax.tree.map(lambda v: v.astype(jnp.float32), block())
    sol = solve(b, np.zeros(4, np.float32), 2.0)
    times, x, _ = pushed(0.5, 0.02, 3.0, 2.0)
    assert sol.result == RESULTS.successful and int(sol.num_events) == len(times)
    assert_allclose(sol.events.ts[: len(times)], times, rtol=0, atol=2e-5)
    assert_allclose(sol.x_final[0], x, rtol=0, atol=1e-6)


class Rod(jf.System):
    """A rod of mass 1 and length 2, its tip on a rough floor: centre (x, y), angle θ."""

    mu: jax.Array

    def vector_field(self, t, x, side, reaction):
        c, s, n = jnp.cos(x[2]), jnp.sin(x[2]), reaction[0]
        rub = -self.mu * n * side[1]
        return jnp.stack([x[3], x[4], x[5], rub, n - G, 3 * (s * rub - c * n)])

    def switching(self, t, x):
        return jnp.stack([x[1] - jnp.sin(x[2]), x[3] + jnp.sin(x[2]) * x[5]])

    def reset(self, t, x, surface):
        c = jnp.cos(x[2])
        hit = -(x[4] - c * x[5]) / (1 + 3 * c * c)
        return jnp.where(surface == 0, x.at[4].add(hit).at[5].add(-3 * c * hit), x)


def on_its_tip(angle, slip, spin):
    """The state of a rod whose tip slides."""
    s, c = np.sin(angle), np.cos(angle)
    return np.array([0.0, s, angle, slip - s * spin, c * spin, spin])


def slipping(mu, x0, t1):
    """The motion of a rod whose tip slips, until it stops or t1: time and state."""
    side = np.sign(x0[3] + np.sin(x0[2]) * x0[5])

    def field(t, q):
        c, s = np.cos(q[2]), np.sin(q[2])
        n = (G - s * q[5] ** 2) / (1 + 3 * c * c + 3 * mu * side * s * c)
        rub = -mu * n * side
        return [*q[3:], rub, n - G, 3 * (s * rub - c * n)]

    def stops(t, q):
        return q[3] + np.sin(q[2]) * q[5]

    stops.terminal = True
    run = solve_ivp(field, (0, t1), x0, "DOP853", events=stops, rtol=1e-12, atol=1e-12)
    return run.t[-1], run.y[:, -1]


RODS = [(0.5, 1.0, -1.0, 0.0), (0.3, 1.2, 0.5, 0.2), (0.8, 0.9, 2.0, -0.5)]


@jax.jit
@jax.vmap
def turned(mu, x0, t1):
    """The motions of as many rods."""
    return solve(Rod(mu), x0, t1)


@pytest.mark.release
def test_a_rod_slips_on_its_tip():
    mu = jnp.array([rod[0] for rod in RODS])
    x0 = np.stack([on_its_tip(*rod[1:]) for rod in RODS])
    sol = turned(mu, jnp.asarray(x0), jnp.array([0.7] * 3))
    assert np.all(np.asarray(sol.result == RESULTS.successful))
    for i, rod in enumerate(RODS):
        t, x = slipping(rod[0], x0[i], 0.7)
        assert_allclose(sol.events.ts[i, 0], t, rtol=0, atol=1e-11)
        assert_allclose(sol.events.xs[i, 0], x, rtol=0, atol=1e-10)


@pytest.mark.release
def test_painleves_paradox_is_told():
    # G = 1 + 3 cos²θ − 3 μ sin θ cos θ is negative: pressed, no force holds the tip; lifted by its
    # spin, it may rise or be held. A rod at rest sticks all the same.
    angle, mu = 1.1, 2.0
    s, c = np.sin(angle), np.cos(angle)
    assert 1 + 3 * c * c - 3 * mu * s * c < 0 < 4.0**2 * s - G
    starts = [on_its_tip(angle, *v) for v in ((-1.0, 0.0), (-1.0, 4.0), (0.0, 0.0))]
    sol = turned(jnp.array([mu] * 3), jnp.stack(starts), jnp.array([0.1] * 3))
    told = [RESULTS.mode_undecided, RESULTS.nonunique, RESULTS.successful]
    assert all(bool((sol.result == right)[i]) for i, right in enumerate(told))
    assert sol.mode_final[2].tolist() == [2, 0]
    # A pendulum about its tip, θ'' = −(3/4) g cos θ.
    run = solve_ivp(
        lambda t, q: [q[1], -0.75 * G * np.cos(q[0])],
        (0, 0.1),
        [angle, 0.0],
        "DOP853",
        rtol=1e-12,
        atol=1e-13,
    )
    assert_allclose(sol.x_final[2, [2, 5]], run.y[:, -1], rtol=0, atol=1e-12)


class Ladder(jf.System):
    """A rod of mass 1 and length 2 that leans on a rough wall and stands on a rough floor."""

    mu: jax.Array

    def vector_field(self, t, x, side, reaction):
        c, s, floor, wall = jnp.cos(x[2]), jnp.sin(x[2]), reaction[0], reaction[1]
        low, high = -self.mu * floor * side[2], -self.mu * wall * side[3]
        turn = 3 * (c * high + s * wall - c * floor - s * low)
        return jnp.stack([x[3], x[4], x[5], low + wall, high + floor - G, turn])

    def switching(self, t, x):
        c, s = jnp.cos(x[2]), jnp.sin(x[2])
        return jnp.stack([x[1] - s, x[0] - c, x[3] - s * x[5], x[4] + c * x[5]])

    def reset(self, t, x, surface):
        c, s = jnp.cos(x[2]), jnp.sin(x[2])
        floor, wall = -(x[4] - c * x[5]) / (1 + 3 * c * c), -(x[3] + s * x[5]) / (1 + 3 * s * s)
        on_floor = x.at[4].add(floor).at[5].add(-3 * c * floor)
        on_wall = x.at[3].add(wall).at[5].add(3 * s * wall)
        return jnp.where(surface == 0, on_floor, jnp.where(surface == 1, on_wall, x))


def leaning(angle, spin):
    s, c = np.sin(angle), np.cos(angle)
    return np.array([c, s, angle, -s * spin, c * spin, spin])


def forces(mu, angle, spin):
    """Of floor and wall, and θ'', of a ladder that slides down."""
    c, s = np.cos(angle), np.sin(angle)
    rows = [[-mu, 1, s], [1, mu, -c], [3 * (c - s * mu), -3 * (c * mu + s), 1]]
    return np.linalg.solve(rows, [-c * spin**2, G - s * spin**2, 0])


@pytest.mark.release
def test_a_ladder_slides_down_until_it_leaves_the_wall():
    mu, angle, spin = 0.2, 1.1, -0.05

    def leaves(t, q):
        return forces(mu, *q)[1]

    leaves.terminal = True
    run = solve_ivp(
        lambda t, q: [q[1], forces(mu, *q)[2]],
        (0, 3),
        [angle, spin],
        "DOP853",
        events=leaves,
        rtol=1e-12,
        atol=1e-13,
    )
    starts = jnp.stack([leaning(angle, spin), leaning(1.2, 0.0)])
    sol = jax.vmap(lambda mu, x0: solve(Ladder(mu), x0, 1.0))(jnp.array([mu, 0.7]), starts)
    assert np.all(np.asarray(sol.result == RESULTS.successful))
    assert_allclose(sol.events.ts[0, 0], run.t_events[0], rtol=0, atol=1e-11)
    assert_allclose(sol.events.xs[0, 0, [2, 5]], run.y_events[0][0], rtol=0, atol=1e-11)
    # A rougher one stays where it is, held by more forces than are needed.
    assert_allclose(sol.x_final[1], starts[1], rtol=0, atol=1e-13)


class Squared(Block):
    def vector_field(self, t, x, side, reaction):
        return super().vector_field(t, x, side, reaction**2)


class Floating(jf.System):
    def vector_field(self, t, x, side, reaction):
        return jnp.stack([x[1], reaction - 1.0])

    def switching(self, t, x):
        return x[0]


def test_what_cannot_be_held_is_refused():
    system = Squared(*(jnp.array(v) for v in (0.5, 0.02, 3.0, 0.0)))
    with pytest.raises(ValueError, match=r"`vector_field` of Squared must be affine in its reac"):
        solve(system, np.zeros(4), 1.0)
    with pytest.raises(ValueError, match=r"`vector_field` of Floating must not take `reaction`"):
        solve(Floating(), np.zeros(2), 1.0)


@pytest.mark.release
def test_sweeps_and_averages_of_what_feels_a_reaction():
    sweep = jf.bifurcation_diagram(
        Forced(*(jnp.array(v) for v in (0.5, 0.02, 3.0, 0.0))), "mu", np.array([0.35, 0.5]),
        jnp.zeros(4), transient=0, samples=2, progress=False, steps=60,
        observe=lambda t, x, side, reaction: jnp.stack([x[0], reaction[0]]),
    )  # fmt: skip
    period = 2 * np.pi / Block.omega
    for i, mu in enumerate((0.35, 0.5)):
        for k in (1, 2):
            _, x, _ = pushed(mu, 0.02, 3.0, k * period)
            assert_allclose(sweep.xs[i, k - 1, 0], x, rtol=0, atol=1e-11)
    assert_allclose(sweep.xs[..., 1], G, rtol=1e-9, atol=0)
    span = np.zeros(4), 0.0, period, 0.01
    mean = jf.average(block(), lambda t, x, side, reaction: reaction, *span)
    assert_allclose(mean.value, [G, 0.0], rtol=1e-10, atol=1e-12)
    with pytest.raises(ValueError, match=r"The observable must be affine in its reactions"):
        jf.average(block(), lambda t, x, side, reaction: reaction**2, *span)


class Forced(Block):
    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Clamped(jf.System):
    """A block on a table, pushed by a force of 1 and pressed by n (t − t0) with friction."""

    mu: jax.Array
    n: jax.Array
    t0: jax.Array

    @property
    def clocks(self):
        return (jf.Clock(10.0, self.t0),)

    def vector_field(self, t, x, side, reaction):
        pressed = jnp.where(t < self.t0, 3.0, self.n * (t - self.t0))
        rub = self.mu * reaction[0] * side[1]
        return jnp.stack([x[1], 1.0 - rub, x[3], reaction[0] - pressed])

    def switching(self, t, x):
        return jnp.stack([x[2], x[1]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, x.at[3].set(0.0), x)


@pytest.mark.release
def test_a_clamp_that_closes_from_zero_lets_the_block_slip_first():
    """v = s − s²/2 until it sticks at s = 2, with s = t − t0 and μ n = 1. At a start at t0, and at
    a tick, before which it sticks."""
    for t0, mu in ((0.0, 2.0), (1.0, 0.5), (1.0, 2.0)):
        system = Clamped(*(jnp.array(v) for v in (mu, 1 / mu, t0)))
        sol = jf.solve(system, jnp.zeros(4), 0.0, 3.5, 0.3, stepper=diffrax.Dopri8(), compact=True)
        assert_allclose(sol.x_final, [2 / 3, 0, 0, 0], rtol=0, atol=1e-12)
        assert sol.mode_final.tolist() == [2, 0]
