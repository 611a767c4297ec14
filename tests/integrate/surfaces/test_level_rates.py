"""Surfaces whose rate dH/dt vanishes on every side, alone and several at once: the next derivative
decides in its place, in a list of combinations as by pivoting."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names


class Brake(jf.System):
    """x'' = (t − s)(p − sgn x') from t = s on, before that x'' = 0: a brake closes on a mass at
    rest, with a force that grows from zero. It holds while |p| ≤ 1."""

    push: jax.Array
    closes: jax.Array

    def vector_field(self, t, x, side):
        closed = 0.5 * (1 + side[1]) * (t - self.closes)
        return jnp.stack([x[1], closed * (self.push - side[0])])

    def switching(self, t, x):
        return jnp.stack([x[1], t - self.closes])


class TickingBrake(jf.System):
    """The same, as one surface with a clock."""

    push: jax.Array
    closes: jax.Array

    @property
    def clocks(self):
        return (jf.Clock(100.0, self.closes),)

    def vector_field(self, t, x, side):
        since = t - self.closes
        force = jnp.where(since > 0, since, 0.0)
        return jnp.stack([x[1], force * (self.push - side)])

    def switching(self, t, x):
        return x[1]


# Times that are points of the grid and others, which the rounding of t − s is on either side of.
TIMES = jnp.array([1.0, 0.97, 1.03, 0.613, 1.111, 0.77])


@pytest.mark.parametrize("kind", [Brake, TickingBrake])
@pytest.mark.slow
def test_a_brake_that_closes_from_zero_holds(kind):
    def end(push, closes):
        sol = jf.solve(kind(push, closes), jnp.zeros(2), 0.0, 2.0, 0.1, throw=False)
        return sol.x_final, sol.result

    pushes = jnp.array([0.3, 1.5])
    run = jax.jit(jax.vmap(jax.vmap(end, (None, 0)), (0, None)))
    found, results = run(pushes, TIMES)
    assert (outcome_names(results) == "successful").all()
    since = 2.0 - np.asarray(TIMES)
    # With p = 1.5 it moves on with x'' = (t − s)/2.
    moved = np.stack([since**3 / 12, since**2 / 4], axis=-1)
    np.testing.assert_allclose(found[0], 0.0, atol=1e-14)
    np.testing.assert_allclose(found[1], moved, rtol=1e-12)


class Pressed(jf.System):
    """A block on a block, pressed from t = 0 on with a force t: ground friction t, friction between
    them t/2, pull p t on the upper one."""

    push: jax.Array

    def vector_field(self, t, x, side):
        ground, between = -t * side[0], 0.5 * t * side[1]
        return jnp.stack([ground + between, self.push * t - between])

    def switching(self, t, x):
        return jnp.stack([x[0], x[1] - x[0]])


def test_blocks_pressed_on_each_other_from_zero_hold_or_slip():
    def end(push):
        sol = jf.solve(Pressed(push), jnp.zeros(2), 0.0, 1.0, 0.1, throw=False)
        return sol.x_final, sol.result

    found, results = jax.jit(jax.vmap(end))(jnp.array([0.3, 0.8]))
    assert (outcome_names(results) == "successful").all()
    # With p = 0.8 the upper one slips, at v' = (p − 1/2) t, and the lower one is held by t.
    np.testing.assert_allclose(found, [[0.0, 0.0], [0.0, 0.15]], atol=1e-14)


class Detents(jf.System):
    """Masses with x'' = r t − g sgn x − h sgn x', each at rest in its detent until r t = g + h."""

    rates: jax.Array
    signs: jax.Array

    def vector_field(self, t, x, side):
        n = len(self.rates)
        held = side * self.signs
        return jnp.concatenate([x[n:], self.rates * t - held[:n] - 0.5 * held[n:]])

    def switching(self, t, x):
        return x * self.signs


@pytest.mark.release
@pytest.mark.parametrize("n", [1, 2])
def test_masses_in_detents_rest_until_the_load_moves_them(n):
    def end(rates, signs):
        system = Detents(rates, signs)
        sol = jf.solve(system, jnp.zeros(2 * n), 0.0, 2.0, 0.07, throw=False)
        return sol.x_final, sol.result, sol.num_events

    rates = jnp.array([[1.0, 0.5], [-1.2, 0.9], [0.9, 1.2]])[:, :n]
    # The sign of H is a matter of definition.
    signs = jnp.array([[1.0, 1.0, 1.0, 1.0], [1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, -1.0, 1.0]])
    signs = signs[:, : 2 * n]
    found, results, events = jax.jit(jax.vmap(end))(rates, signs)
    assert (outcome_names(results) == "successful").all()
    assert (events <= 4 * n).all()
    size = np.abs(rates)
    since = np.maximum(2.0 - 1.5 / size, 0.0)
    exact = np.sign(rates) * np.stack([size * since**3 / 6, size * since**2 / 2])
    np.testing.assert_allclose(found, np.concatenate(list(exact), axis=1), atol=1e-10)


class Twisting(jf.System):
    """Masses with x'' = −2 sgn x − sgn x', which come to rest one after the other."""

    def vector_field(self, t, x, side):
        n = len(x) // 2
        return jnp.concatenate([x[n:], -2.0 * side[:n] - side[n:]])

    def switching(self, t, x):
        return x


@pytest.mark.slow
def test_twisting_masses_stay_at_rest_when_another_arrives():
    x0 = jnp.array([0.5, 1.3, 0.0, 0.0])
    sol = jf.solve(Twisting(), x0, 0.0, 8.0, 0.1, throw=False)
    assert outcome_names(sol.result) == "successful"
    np.testing.assert_allclose(sol.x_final, 0.0, atol=1e-12)
    np.testing.assert_array_equal(sol.mode_final, 0)
    # Each turn is a fraction √(1/3) of the last one.
    turn = np.sqrt(2 * 1.3) + np.sqrt(2 * 1.3) / 3
    assert float(sol.events.ts[sol.num_events - 1]) == pytest.approx(
        turn / (1 - np.sqrt(1 / 3)), rel=1e-9
    )


class Repelling(jf.System):
    """x_i' = s_i + s_{i+1}/10."""

    def vector_field(self, t, x, side):
        return side + 0.1 * jnp.roll(side, -1)

    def switching(self, t, x):
        return x


class Snaps(jf.System):
    """A chain of masses joined by springs with the force sgn of their elongation, which repels."""

    def vector_field(self, t, x, side):
        _, v = jnp.split(x, 2)
        return jnp.concatenate([v, side - jnp.append(side[1:], 0.0)])

    def switching(self, t, x):
        u, _ = jnp.split(x, 2)
        return u - jnp.append(jnp.zeros(1), u[:-1])


@pytest.mark.parametrize("system, size", [(Repelling(), 4), (Snaps(), 8)])
@pytest.mark.slow
def test_several_motions_of_many_surfaces_are_not_one(system, size):
    sol = jf.solve(system, jnp.zeros(size), 0.0, 0.3, 0.1, throw=False)
    assert outcome_names(sol.result) == "nonunique"


class Elsewhere(jf.System):
    """x'' = a(side of z), z' = 1, y' = sgn x: x is switched by a surface that x is not on."""

    above: jax.Array
    below: jax.Array

    def vector_field(self, t, x, side):
        force = jnp.where(side[1] > 0, self.above, self.below)
        return jnp.stack([x[1], force, 0.01 * jnp.ones_like(t), side[0]])

    def switching(self, t, x):
        return jnp.stack([x[0], x[2]])


def test_the_next_derivative_is_that_on_the_side_of_other_surfaces():
    def end(above, below, z):
        x0 = jnp.array([0.0, 0.0, 0.0, 0.0]).at[2].set(z)
        sol = jf.solve(Elsewhere(above, below), x0, 0.0, 0.5, 0.05, throw=False)
        return sol.x_final, sol.result

    cases = jnp.array([[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [0.0, -1.0, 1.0], [2.0, -1.0, 1.0]])
    found, results = jax.jit(jax.vmap(end))(*cases.T)
    assert (outcome_names(results) == "successful").all()
    force = np.where(cases[:, 2] > 0, cases[:, 0], cases[:, 1])
    # What stands still is on the side H > 0.
    exact = np.stack([force / 8, force / 2, cases[:, 2] + 0.005, np.where(force < 0, -0.5, 0.5)], 1)
    np.testing.assert_allclose(found, exact, atol=1e-13)


class SwitchedOn(jf.System):
    """From t = 1 on x' = −s and y' = −2 s, with s = sgn x."""

    def vector_field(self, t, x, side):
        on = 0.5 * (1 + side[1])
        return jnp.stack([-on * side[0], -2 * on * side[0]])

    def switching(self, t, x):
        return jnp.stack([x[0], t - 1.0])


@pytest.mark.release
def test_a_slide_that_another_contact_switches_on_has_its_derivative():
    def end(x0):
        return jf.solve(SwitchedOn(), x0, 0.0, 2.0, 0.07).x_final

    # Beside the surface x takes |x0| to come back, so that y(2) = y0 − 2 x0.
    exact = [[0.0, 0.0], [-2.0, 1.0]]
    x0 = jnp.array([0.0, 0.3])
    np.testing.assert_allclose(jax.jacfwd(end)(x0), exact, atol=1e-12)
    np.testing.assert_allclose(jax.jacrev(end)(x0), exact, atol=1e-12)


class Undefined(jf.System):
    """v sticks at 0, y stays at 1, where the field of y < 0 is no number, and z has the rate 1
    below its threshold and 3 above."""

    def vector_field(self, t, x, side):
        _, y, _, c = x
        stays = jnp.where(side[1] > 0, 0.0 * y, jnp.sqrt(-y))
        return jnp.stack([-side[0], stays, jnp.where(side[2] > 0, 1.0, 3.0), 0.0 * c])

    def switching(self, t, x):
        v, y, z, c = x
        return jnp.stack([v, y + c, 1.0 - z + c])


@pytest.mark.parametrize("compact", [True, False])
@pytest.mark.slow
def test_a_field_that_is_no_number_elsewhere_hides_no_contact(compact):
    x0 = jnp.array([0.0, 1.0, 0.03, 0.0])
    sol = jf.solve(Undefined(), x0, 0.0, 2.0, 0.1, throw=False, compact=compact)
    assert outcome_names(sol.result) == "successful"
    np.testing.assert_allclose(sol.x_final, [0.0, 1.0, 1 + 3 * (2 - 0.97), 0.0], atol=1e-12)


class Flow(jf.System):
    """x' = −1 above x = 0 and −2 below; the field of y < 0 is no number."""

    def vector_field(self, t, x, side):
        flow = jnp.where(side[1] > 0, 0.0 * x[1], jnp.sqrt(-x[1]))
        return jnp.stack([jnp.where(side[0] > 0, -1.0, -2.0) + flow, 0.0 * x[1]])

    def switching(self, t, x):
        return x


@pytest.mark.slow
def test_a_field_that_is_no_number_elsewhere_decides_nothing():
    sol = jf.solve(Flow(), jnp.array([1.03, 1.0]), 0.0, 2.0, 0.1, throw=False)
    assert outcome_names(sol.result) == "successful"
    np.testing.assert_allclose(sol.x_final, [-2 * (2 - 1.03), 1.0], atol=1e-12)


class TimeOptimal(jf.System):
    """x'' = −sgn H to rest at zero in the shortest time, with H = x + x'|x'|/2, which has a kink at
    the surface x' = 0."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -side[0]])

    def switching(self, t, x):
        return jnp.stack([x[0] + x[1] * jnp.abs(x[1]) / 2, x[1]])


class Walled(TimeOptimal):
    """The same beside a wall far away."""

    def switching(self, t, x):
        return jnp.append(super().switching(t, x), 50 - x[0])

    def reset(self, t, x, surface):
        return jnp.where(surface == 2, x.at[1].multiply(-0.5), x)


@pytest.mark.release
@pytest.mark.parametrize("system", [TimeOptimal(), Walled()])
def test_a_time_optimal_motion_ends_at_rest_where_its_switching_curve_has_a_kink(system):
    # At the kink H'' is not the derivative of either motion: rounding of x' takes a side.
    starts = jnp.array([[1.0, 0.5], [2.0, -0.3], [-1.0, -0.5], [0.7, 0.0], [-0.3, 0.2], [0, 0]])

    def end(x0):
        sol = jf.solve(system, x0, 0.0, 8.0, 0.1, max_events=4, throw=False)
        last = jnp.where(sol.num_events > 0, sol.events.ts[sol.num_events - 1], 0.0)
        return sol.x_final, sol.result, last

    found, results, arrived = jax.jit(jax.vmap(end))(starts)
    assert (outcome_names(results) == "successful").all()
    x, v = np.asarray(starts).T
    towards = np.where(x + v * abs(v) / 2 >= 0, 1.0, -1.0)
    by_hand = towards * v + 2 * np.sqrt(v**2 / 2 + towards * x)
    np.testing.assert_allclose(arrived, by_hand, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found, 0.0, rtol=0, atol=1e-15)


class OnAFloor(jf.System):
    """A block that rests on a floor, or falls to it, pushed along it by p t against t sgn x'."""

    push: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], t * (self.push - side[0]), x[3], -jnp.ones_like(t)])

    def switching(self, t, x):
        return jnp.stack([x[1], x[2]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 1, x.at[3].multiply(-0.5), x)


@pytest.mark.release
def test_a_friction_that_grows_from_zero_beside_a_floor_has_its_own_next_derivative():
    # On both sides it was taken as on one, so that the block left to a side and came back.
    def run(push, height):
        x0 = jnp.stack([0.0 * push, 0.0 * push, height, 0.0 * push])
        sol = jf.solve(OnAFloor(push), x0, 0.0, 3.0, 0.1, max_events=64, throw=False)
        on_friction = jnp.sum(sol.events.surfaces[:64] == 0)
        return sol.x_final, sol.result, on_friction

    pushes, heights = jnp.array([0.5, -0.5, 1.5, -1.5]), jnp.array([0.0, 1.0])
    found, results, contacts = jax.jit(jax.vmap(jax.vmap(run, (None, 0)), (0, None)))(
        pushes, heights
    )
    assert (outcome_names(results) == "successful").all()
    beyond = np.sign(pushes) * np.maximum(np.abs(pushes) - 1, 0) * 4.5
    np.testing.assert_allclose(found[..., 0], np.repeat(beyond[:, None], 2, 1), atol=1e-13)
    assert not np.any(contacts)
