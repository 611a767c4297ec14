"""What a surface with a reset does: thrown back, let through, carried off, and rest on it.

Every motion here is made of parabolas, lines and sines, and compared with them.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from jaxfil.model.outcomes import outcome_names

G = 9.8


def ball(restitution=0.5):
    return jf.systems.BouncingBall(g=G, restitution=restitution)


def solve(system, x0, t1, dt=0.1, t0=0.0, **options):
    x0 = jnp.asarray(x0, float)
    return jf.solve(system, x0, t0, t1, dt, throw=False, **options)


def kinds(sol):
    return np.asarray(sol.events.kinds)[: int(sol.num_events)].tolist()


class Kick(jf.System):
    """x'' = −x; at t = 1 the velocity jumps."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0]])

    def switching(self, t, x):
        return t - 1.0

    def reset(self, t, x, surface):
        return x.at[1].add(0.7)


class Toggle(jf.System):
    """x'' = −x; the third state changes sign at each zero of x."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0], jnp.zeros(())])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return x.at[2].multiply(-1.0)


class Rocking(jf.System):
    """θ'' = −sgn θ; θ' → e θ' as θ passes 0."""

    e: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -side])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], self.e * x[1]])


class Corner(jf.System):
    """A free point between two walls at a right angle, restitution 1/2 and 1."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[2], x[3], 0 * x[0], 0 * x[0]])

    def switching(self, t, x):
        return x[:2]

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, x.at[2].multiply(-0.5), x.at[3].multiply(-1.0))


class Table(jf.System):
    """A ball on a table that shakes, x and x' as seen from the ground: z = a sin t, e = 1/2."""

    a: jax.Array
    e: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.full((), -1.0)])

    def switching(self, t, x):
        return x[0] - self.a * jnp.sin(t)

    def reset(self, t, x, surface):
        v = self.a * jnp.cos(t)
        return jnp.stack([x[0], v - self.e * (x[1] - v)])


def test_a_ball_on_the_floor_that_moves_down_bounces_at_t0():
    sol = solve(ball(), (0, -2), 0.1, 0.01)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.x_final, [0.051, 0.02], rtol=1e-13)
    assert kinds(sol) == [EventKind.impact] and float(sol.events.ts[0]) == 0


@pytest.mark.parametrize("above", [0.0, 1e-15, -1e-16])
def test_a_ball_on_the_floor_that_moves_up_has_left(above):
    sol = solve(ball(), (above, 2), 0.1, 0.01)
    assert int(sol.num_events) == 0
    assert_allclose(sol.x_final, [0.2 - 0.049, 2 - 0.98], rtol=1e-13)


@pytest.mark.parametrize("above", [0.0, 1e-15])
def test_a_run_goes_on_from_a_recorded_impact(above):
    whole = solve(ball(), (10, 0), 2.0)
    x = whole.events.xs[0] + jnp.array([above, 0.0])
    later = solve(ball(), x, 2.0, t0=whole.events.ts[0])
    assert int(later.num_events) == 1
    assert_allclose(later.x_final, whole.x_final, rtol=1e-13)


def test_an_impact_is_not_undone_in_backward_time():
    end = solve(ball(), (10, 0), 2.0).x_final
    back = solve(ball(), end, 0.0, t0=2.0)
    assert back.result == RESULTS.irreversible_reset
    assert_allclose(back.t_final, np.sqrt(20 / G), rtol=1e-13)


@pytest.mark.parametrize("dt", [0.03, 0.1, 1.0])
def test_a_kick_goes_on_through_its_surface(dt):
    sol = solve(Kick(), (1, 0), 3.0, dt)
    assert sol.result == RESULTS.successful and kinds(sol) == [EventKind.impact]
    v, c, s = -np.sin(1) + 0.7, np.cos(2), np.sin(2)
    end = [c * np.cos(1) + s * v, c * v - s * np.cos(1)]
    assert_allclose(sol.x_final, end, rtol=0, atol=1e-6 if dt == 1 else 1e-12)


def test_a_toggle_goes_on_through_its_surface():
    sol = solve(Toggle(), (1, 0, 1), 10.0)
    assert_allclose(sol.events.ts[:3], np.pi * np.array([0.5, 1.5, 2.5]), rtol=1e-12)
    assert int(sol.num_events) == 3
    assert_allclose(sol.x_final, [np.cos(10), -np.sin(10), -1], rtol=0, atol=1e-11)


def test_a_rocking_block_goes_through_with_its_new_rate():
    # Down from 1/2 in 1; then up to v²/2 and back, each quarter of the swing lasts v.
    sol = solve(Rocking(jnp.asarray(0.9)), (0.5, 0), 3.0)
    assert_allclose(sol.events.ts[:2], [1.0, 1 + 2 * 0.9], rtol=1e-12)
    s = 3 - 2.8
    assert_allclose(sol.x_final, [0.81 * s - s * s / 2, 0.81 - s], rtol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("lag", [0.0, 1e-16, 1e-14, 1e-12, 1e-9])
def test_both_walls_of_a_corner_throw_back(lag):
    sol = solve(Corner(), (1, 1 + lag, -1, -1), 3.0, 0.3)
    assert sol.result == RESULTS.successful and kinds(sol) == [EventKind.impact] * 2
    assert_array_equal(np.asarray(sol.events.members)[:2], [[True, False], [False, True]])
    assert_allclose(sol.x_final, [1, 2 - lag, 0.5, 1], rtol=1e-13)


@pytest.mark.slow
def test_a_start_in_a_corner_is_thrown_back_from_both_walls():
    sol = solve(Corner(), (0, 0, -1, -1), 1.0, 0.3)
    assert_allclose(sol.x_final, [0.5, 1, 0.5, 1], rtol=1e-13)


class Cradle(jf.System):
    """Equal beads on a line that touch from the start; restitution e."""

    e: jax.Array

    def vector_field(self, t, x, side):
        return jnp.concatenate([x[4:], jnp.zeros(4)])

    def switching(self, t, x):
        return x[1:4] - x[:3]

    def reset(self, t, x, surface):
        v, share = x[4:], 0.5 * (1 + self.e)
        dv = v[surface + 1] - v[surface]
        v = v.at[surface].add(share * dv).at[surface + 1].add(-share * dv)
        return jnp.concatenate([x[:4], v])


@pytest.mark.release
def test_a_wave_runs_through_beads_that_touch():
    x0 = [-1, 0, 0, 0, 1, 0, 0, 0]
    sol = solve(Cradle(jnp.asarray(1.0)), x0, 3.0, 0.1)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.x_final, [0, 0, 0, 2, 0, 0, 0, 1], rtol=0, atol=1e-13)
    surfaces = np.asarray(sol.events.surfaces)[: int(sol.num_events)]
    assert_array_equal(surfaces, [0, 1, 2])
    assert_allclose(sol.events.ts[:3], 1.0, rtol=1e-14)


@pytest.mark.parametrize("e", [0.0, 0.2, 0.5, 0.8])
@pytest.mark.parametrize("dt", [0.02, 0.3])
def test_a_ball_comes_to_rest(e, dt):
    first = np.sqrt(20 / G)
    sol = solve(ball(e), (10, 0), 20.0, dt, saveat=diffrax.SaveAt(ts=jnp.array([0.5, 15.0, 20.0])))
    assert sol.result == RESULTS.successful
    assert_allclose(sol.xs[1:], 0, rtol=0, atol=1e-14)
    assert_array_equal(sol.modes[1:, 0], 2)
    last = float(sol.events.ts[int(sol.num_events) - 1])
    assert_allclose(last, first * (1 + e) / (1 - e), rtol=1e-12)


@pytest.mark.slow
def test_the_time_of_rest_has_its_derivative():
    def rest(e, height):
        sol = solve(ball(e), jnp.stack([height, 0 * height]), 20.0)
        return sol.events.ts[sol.num_events - 1]

    by_e, by_height = jax.jacfwd(rest, argnums=(0, 1))(jnp.asarray(0.5), jnp.asarray(10.0))
    first = np.sqrt(20 / G)
    assert_allclose(by_e, first * 2 / (1 - 0.5) ** 2, rtol=1e-7)
    assert_allclose(by_height, 3 * first / 20, rtol=1e-7)


class Hovering(jf.System):
    """q'' = −1e-6 above a wall at 0.9, beside x'' = −25 x."""

    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.full((), -1e-6), x[3], -25 * x[2]])

    def switching(self, t, x):
        return x[0] - 0.9

    def reset(self, t, x, surface):
        return x.at[1].multiply(-0.5)


def test_bounces_too_low_to_be_told_leave_the_rest_of_the_state_its_time():
    # Of a height of rounding, they last for 1e-4: carried by their field at once, the oscillator
    # would end up 1e-6 from its circle.
    sol = solve(Hovering(), (0.9 + 1e-9, 0.0, 1.0, 0.0), 2.0, 0.02)
    assert sol.result == RESULTS.successful
    assert sol.mode_final[0] == 2
    assert_allclose(sol.x_final[2:], [np.cos(10), -5 * np.sin(10)], rtol=1e-11)


@pytest.mark.slow
def test_a_ball_lies_on_a_table_until_it_shakes():
    # Contact is lost where −a sin t = −1; until then x = a sin t, then a parabola.
    a = 1.5
    start, leave = -np.pi / 2, np.arcsin(1 / a)
    x0 = (-a, 0.0)

    def end(a, t1):
        x0 = jnp.stack([-a, 0 * a])
        return solve(Table(a, jnp.asarray(0.5)), x0, t1, 0.1, t0=start).x_final

    sol = solve(Table(jnp.asarray(a), jnp.asarray(0.5)), x0, leave + 0.5, 0.1, t0=start)
    assert sol.result == RESULTS.successful
    assert kinds(sol) == [EventKind.slip]
    assert_allclose(sol.events.ts[0], leave, rtol=1e-12)
    flight = [
        1.0 + a * np.cos(leave) * 0.5 - 0.125,
        a * np.cos(leave) - 0.5,
    ]
    assert_allclose(sol.x_final, flight, rtol=1e-11)
    slope = jax.jacfwd(end)(jnp.asarray(a), leave + 0.5)
    h = 1e-6
    above, below = (end(jnp.asarray(a + s * h), leave + 0.5) for s in (1, -1))
    assert_allclose(slope, (above - below) / (2 * h), rtol=1e-8)


def test_a_ball_comes_to_rest_on_a_shaking_table():
    # a = 1/2: the table never falls as fast as the ball, which ends up on it.
    table = Table(jnp.asarray(0.5), jnp.asarray(0.3))
    sol = solve(table, (1, 0), 20.0, 0.1)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.x_final, [0.5 * np.sin(20), 0.5 * np.cos(20)], rtol=1e-13)
    assert sol.mode_final[0] == 2


@pytest.mark.parametrize("place", [0.0, -1e-9])
def test_a_wall_at_the_rest_position(place):
    # Pressed against the wall until cos 2t changes sign; x = −1/3 of the forced sine then.
    system = jf.systems.ImpactOscillator(
        wall=0.0, amplitude=1.0, omega=2.0, restitution=0.8, damping=0.0, stiffness=1.0
    )
    times = jnp.array([0.5, 3.0])
    sol = solve(system, (place, 0), 3.0, 0.05, saveat=diffrax.SaveAt(ts=times))
    assert sol.result == RESULTS.successful
    s = 3.0 - np.pi / 4
    # x'' + x = −sin 2s from rest: x = (sin 2s − 2 sin s)/3.
    assert_allclose(sol.xs[0], 0, rtol=0, atol=1e-14)
    assert_allclose(sol.xs[1, 0], (np.sin(2 * s) - 2 * np.sin(s)) / 3, rtol=1e-9)


@pytest.mark.slow
def test_a_sweep_over_restitution_through_zero():
    e = np.linspace(-0.5, 0.5, 11)
    end = jax.vmap(lambda e: solve(ball(e), (0.5 * G, 0), 1.5).x_final)(jnp.asarray(e))
    # At the floor at t = 1 with -g: thrown back for 2e, at rest, or let through.
    flight = np.stack([G * (e / 2 - 0.125), G * (e - 0.5)], axis=1)
    free = (e < -1e-9) | (e > 0.26)
    assert_allclose(end[free], flight[free], rtol=1e-12, atol=1e-14)
    assert_allclose(end[abs(e) < 1e-9], 0, rtol=0, atol=1e-13)
    assert np.all(np.asarray(end)[e > -1e-9, 0] >= -1e-15)


class Stack(jf.System):
    """Two balls, one above the other, above a floor; no restitution anywhere."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[2], x[3], jnp.full((), -1.0), jnp.full((), -1.0)])

    def switching(self, t, x):
        return jnp.stack([x[0], x[1] - x[0]])

    def reset(self, t, x, surface):
        mean = 0.5 * (x[2] + x[3])
        return jnp.where(surface == 0, x.at[2].set(0.0), x.at[2].set(mean).at[3].set(mean))


@pytest.mark.slow
def test_two_balls_come_to_rest_on_each_other():
    sol = solve(Stack(), (0.5, 2, 0, 0), 5.0)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.x_final, 0, rtol=0, atol=1e-13)
    assert_array_equal(sol.mode_final, [2, 2])


class Column(jf.System):
    """Beads of radius 0.1, one above the other, above a floor (Siconos, BeadsColumn): equal masses
    that part at e times the speed at which they meet."""

    e: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        q, v = jnp.split(x, 2)
        return jnp.concatenate([v, jnp.full_like(q, -9.81)])

    def switching(self, t, x):
        q, _ = jnp.split(x, 2)
        return jnp.concatenate([q[:1] - 0.1, q[1:] - q[:-1] - 0.2])

    def reset(self, t, x, surface):
        q, v = jnp.split(x, 2)
        upper = jnp.maximum(surface, 1)
        push = 0.5 * (1 + self.e) * (v[upper] - v[upper - 1])
        pair = v.at[upper].add(-push).at[upper - 1].add(push)
        return jnp.concatenate([q, jnp.where(surface == 0, v.at[0].multiply(-self.e), pair)])


def fall(q, e, count):
    """The first impacts of a column that falls from rest: times and surfaces, parabola by
    parabola in extended precision."""
    q, g, t, last = np.array(q, np.longdouble), np.longdouble(9.81), np.longdouble(0), None
    v, ts, surfaces = np.zeros_like(q), [], []
    while len(ts) < count:
        gaps, closing = np.diff(q) - np.longdouble(0.2), -np.diff(v)
        height = max(q[0] - np.longdouble(0.1), 0)
        waits = [(v[0] + np.sqrt(v[0] ** 2 + 2 * g * height)) / g]
        waits += [gap / c if c > 0 else np.inf for gap, c in zip(gaps, closing, strict=True)]
        waits = [np.inf if k == last and k else wait for k, wait in enumerate(waits)]
        j = int(np.argmin(waits))
        h = waits[j]
        q, v, t, last = q + h * v - g * h * h / 2, v - g * h, t + h, j
        if j == 0:
            v[0] = -e * v[0]
        else:
            push = (1 + np.longdouble(e)) / 2 * (v[j] - v[j - 1])
            v[j], v[j - 1] = v[j] - push, v[j - 1] + push
        ts.append(float(t))
        surfaces.append(j)
    return np.array(ts), np.array(surfaces)


def column(e, q):
    x0 = jnp.concatenate([q, jnp.zeros_like(q)])
    options = dict(throw=False, max_events=3000, stepper=diffrax.Bosh3())
    return jf.solve(Column(e), x0, 0.0, 4.0, 0.02, **options)


@pytest.mark.release
def test_a_column_of_beads_meets_as_its_parabolas_do():
    q, e, count = np.array([0.5, 0.95, 1.3]), 0.9, 40
    ts, surfaces = fall(q, e, count)
    sol = column(jnp.asarray(e), jnp.asarray(q))
    assert_array_equal(sol.events.surfaces[:count], surfaces)
    assert_allclose(sol.events.ts[:count], ts, rtol=0, atol=1e-11)


@pytest.mark.release
def test_columns_of_beads_come_to_rest_and_not_through_the_floor():
    rng = np.random.default_rng(0)
    es, q = rng.uniform(0.0, 0.75, 64), np.cumsum(rng.uniform(0.21, 0.5, (64, 3)), axis=1)
    # One after the other, of the program that is there; in lanes each waits for the longest.
    sols = [column(jnp.asarray(e), jnp.asarray(start)) for e, start in zip(es, q, strict=True)]
    sol = jax.tree.map(lambda *leaves: np.stack(leaves), *sols)
    told = np.asarray((sol.result == RESULTS.max_events_reached) | (sol.result == RESULTS.zeno))
    assert np.asarray(told | (sol.result == RESULTS.successful)).all()
    # Columns that bounce for longest, 7 in 100, fill the table; all of them have e above 0.62.
    assert not told[es < 0.6].any() and told.sum() <= 4
    assert_allclose(
        sol.x_final[~told, :3], np.tile([0.1, 0.3, 0.5], (64 - told.sum(), 1)), rtol=0, atol=1e-15
    )
    assert_array_equal(np.asarray(sol.mode_final)[~told], 2)
    # On the way no bead was in another or in the floor.
    happened = np.arange(3000)[None] < np.asarray(sol.num_events)[:, None]
    heights = np.asarray(sol.events.xs[..., :3])[happened]
    gaps = np.diff(heights, axis=-1, prepend=-0.1) - 0.2
    assert gaps.min() > -1e-13


@pytest.mark.slow
def test_beads_that_lie_on_each_other_stay():
    sol = column(jnp.asarray(0.5), jnp.array([0.1, 0.3, 0.5]))
    assert_array_equal(sol.mode_final, [2, 2, 2])
    assert int(sol.num_events) == 0
    assert_allclose(sol.x_final, [0.1, 0.3, 0.5, 0, 0, 0], rtol=0, atol=1e-15)


def test_a_batch_of_balls_is_what_each_is_alone():
    es = jnp.array([0.0, 0.3, 0.9, 1.0])
    run = lambda e: solve(ball(e), (1, 0), 3.0).x_final  # noqa: E731
    together = jax.jit(jax.vmap(run))(es)
    alone = jnp.stack([run(e) for e in es])
    assert_allclose(together, alone, rtol=0, atol=1e-12)


def test_rocking_that_dies_out_is_told():
    # Each half of a swing lasts twice its speed: 1 + 2 (1/2 + 1/4 + …) = 3. No rule completes it.
    sol = solve(Rocking(jnp.asarray(0.5)), (0.5, 0), 5.0)
    assert sol.result == RESULTS.zeno
    # A swing of speed v has the height v²/2: rounding hides those below the root of eps.
    assert_allclose(sol.t_final, 3.0, rtol=0, atol=4 * np.sqrt(np.finfo(float).eps))


class Clutch(jf.System):
    """A ball that a floor stops if it is fast, and lets through if it is slow."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], jnp.where(abs(x[1]) > 0.5, 0.0, x[1])])


def test_a_ball_that_is_stopped_falls_through_what_does_not_hold_it():
    # At zero speed the floor does nothing, so that the ball falls on from there.
    sol = solve(Clutch(), (0.5, 0), 5.0)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.x_final, [-8, -4], rtol=1e-13)


class Caught(jf.System):
    """A mass that is pushed to q = 0 from both sides, and put there at t = 1, to rest."""

    clocks = (jf.Clock(10.0, 1.0),)

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -side])

    def switching(self, t, x):
        return x[0]

    def tick(self, t, x, clock):
        return 0 * x


def test_a_map_that_leads_nowhere_is_told():
    # It would have to be held there, on a surface of its velocity too.
    sol = solve(Caught(), (0.9, 0), 5.0)
    assert sol.result == RESULTS.reset_undecided
    assert_allclose(sol.t_final, 1.0, rtol=1e-13)


class Away(jf.System):
    """A mass (q, v) that an acceleration of 2 takes away from a wall at q = 0."""

    e: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], 2.0 + 0 * t])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return x.at[1].multiply(-self.e)


@pytest.mark.slow
def test_rounding_of_the_first_velocity_does_not_hold_a_mass_at_a_wall_that_it_is_pulled_from():
    """As a run leaves it that was cut at the tick that ends a rest."""

    @jax.jit
    @jax.vmap
    def ends(v, e):
        x0 = jnp.stack([0 * v, v])
        sol = jf.solve(Away(e), x0, 0.0, 1.0, 0.05, throw=False, compact=True)
        return sol.x_final, sol.result

    v = -np.array([1e-3, 1e-9, 1e-14, 1e-16, 1e-20, 1e-67, 1e-300, 0.0, -1e-60])
    x, results = ends(jnp.asarray(np.tile(v, 2)), jnp.repeat(jnp.array([0.5, 0.0]), len(v)))
    assert set(map(str, outcome_names(results))) == {"successful"}
    bounce = np.concatenate([-0.5 * np.minimum(v, 0), 0 * v])
    np.testing.assert_allclose(x, np.stack([1 + bounce, 2 + bounce], axis=1), rtol=1e-13)


class Billiard(jf.System):
    """The unit circle, whose reset also puts the state back on it."""

    slides = False

    def vector_field(self, t, x, side):
        return jnp.concatenate([x[2:], 0 * x[2:]])

    def switching(self, t, x):
        return 1 - x[0] ** 2 - x[1] ** 2

    def reset(self, t, x, surface):
        n = x[:2] / jnp.sqrt(x[0] ** 2 + x[1] ** 2)
        return jnp.concatenate([n, x[2:] - 2 * (n @ x[2:]) * n])


def test_a_start_on_a_curved_wall_is_thrown_back():
    sol = solve(Billiard(), [1.0, 0.0, 1.0, 0.3], 1.0)
    assert_allclose(sol.x_final, [0.0, 0.3, -1.0, 0.3], rtol=0, atol=1e-14)


class Drawn(jf.System):
    """A mass pressed on a wall at y = 1 and drawn to it, y' = v + c (1 − y), whose reset halves and
    reverses v, a part of the velocity."""

    c: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1] + self.c * (1 - x[0]), 2.0 + 0 * t])

    def switching(self, t, x):
        return 1 - x[0]

    def reset(self, t, x, surface):
        return x.at[1].multiply(-0.5)


def test_a_reset_of_a_part_of_the_velocity_comes_to_rest():
    run = lambda c: solve(Drawn(c), [1.0, 0.01], 1.0)  # noqa: E731
    sols = jax.vmap(run)(jnp.array([0.0, 1.0, 3.0]))
    assert_array_equal(outcome_names(sols.result), "successful")
    assert_array_equal(sols.mode_final, 2)
    assert_allclose(sols.x_final, [[1.0, 0.0]] * 3, rtol=0, atol=1e-14)


class Adhesive(jf.System):
    """A ball above a wall, with gravity, a growing lift and an attraction √x."""

    lift: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.lift * t - 1 - jnp.sqrt(jnp.maximum(x[0], 0.0))])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -0.3 * x[1]])


@pytest.mark.slow
def test_a_rest_where_a_root_in_the_field_has_no_slope():
    """It bounces until t = 1, rests, and is lifted off at 1/lift = 2."""

    def lifted(lift):
        sol = jf.solve(Adhesive(lift), jnp.array([0.1, 0.0]), 0.0, 2.5, 0.01)
        time = sol.events.ts[sol.num_events - 1]
        return time, (time, sol.events.kinds[sol.num_events - 1])

    slope, (time, kind) = jax.jit(jax.jacfwd(lifted, has_aux=True))(jnp.asarray(0.5))
    assert kind == EventKind.slip
    assert_allclose([time, slope], [2.0, -4.0], rtol=1e-9)
