"""Where the solution is unique and where it is not: intersections slid on, two-folds, and slides
backward in time, against closed forms and NumPy's roots."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from jaxfil.integrate.surfaces import filippov, weights as sliding_weights
from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.system.components import Components
from tests.results import run, table


class Relays(jf.System):
    """x' = M sgn x."""

    matrix: jax.Array

    def vector_field(self, t, x, side):
        return self.matrix @ side

    def switching(self, t, x):
        return x


class Turning(Relays):
    """x' = M(t) sgn x, M = [[-1, t], [t, -1]] + matrix."""

    def vector_field(self, t, x, side):
        return jnp.stack([t * side[1] - side[0], t * side[0] - side[1]]) + self.matrix @ side


class TwoFold(jf.System):
    """The normal form of a two-fold at x = 0, with the same v on both sides."""

    v: jax.Array

    def vector_field(self, t, x, side):
        one = jnp.ones_like(t)
        above = jnp.stack([-x[1], one, self.v])
        below = jnp.stack([x[2], self.v, one])
        return jnp.where(side > 0, above, below)

    def switching(self, t, x):
        return x[0]


class Shown(jf.System):
    """(x, y)' is a table of the sides of x and y, which changes from the first to the second while
    t goes from 0 to 1; the weights are shown by z' = side."""

    first: jax.Array
    second: jax.Array

    def vector_field(self, t, x, side):
        rows = self.first + (self.second - self.first) * jnp.clip(t, 0.0, 1.0)
        p, q = (1 + side) / 2
        shares = jnp.stack([p * q, p * (1 - q), (1 - p) * q, (1 - p) * (1 - q)])
        return jnp.concatenate([shares @ rows, side])

    def switching(self, t, x):
        return x[:2]


class Fold(jf.System):
    """y' = x - 1 above and 1 below, x' = 1: slides for x < 1."""

    def vector_field(self, t, x, side):
        one = jnp.ones_like(t)
        return jnp.stack([one, jnp.where(side > 0, x[0] - 1, one)])

    def switching(self, t, x):
        return x[1]


def quadratic(rows):
    """All weights at which the blend of the rows (++, +-, -+, --) of two rates vanishes."""
    pp, pm, mp, mm = rows
    a, b = pp + pm + mp + mm, pp + pm - mp - mm
    c, d = pp - pm + mp - mm, pp - pm - mp + mm
    cross = lambda u, v: u[1] * v[0] - u[0] * v[1]  # noqa: E731
    roots = np.roots([cross(b, d), cross(a, d) + cross(b, c), cross(a, c)])
    real = [r.real for r in roots if r.imag == 0]
    return [np.array([w, -np.dot(a + b * w, c + d * w) / np.sum((c + d * w) ** 2)]) for w in real]


def inside(rows):
    """Those within [-1, 1]²."""
    return [w for w in quadratic(rows) if np.abs(w).max() <= 1]


TABLES = (
    [[-1.049, -0.552], [-0.499, 1.619], [1.948, -2.383], [0.941, -2.554]],
    [[-1.132, -0.664], [-0.543, 1.752], [2.138, -2.442], [0.910, -2.660]],
)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.1, 0.02])
def test_slide_on_an_intersection_whose_blend_has_a_root_outside_too(dt):
    first, second = np.asarray(TABLES)

    def weight(t, i):
        (w,) = inside(first + (second - first) * min(t, 1))
        return w[i]

    accuracy = {"points": [1.0], "epsabs": 1e-13, "epsrel": 1e-13}
    want = [scipy.integrate.quad(weight, 0, 3, args=(i,), **accuracy)[0] for i in (0, 1)]
    sol = run(Shown(jnp.asarray(first), jnp.asarray(second)), np.zeros(4), 3.0, dt)
    assert sol.result == RESULTS.successful
    assert_array_equal(sol.mode_final, [0, 0])
    assert_array_equal(sol.x_final[:2], [0, 0])
    assert_allclose(sol.x_final[2:], want, rtol=1e-12)


def others(rows):
    """Whether a mode other than a slide on both surfaces goes on from their intersection."""
    rates = {(s, u): rows[(1 - s) + (1 - u) // 2] for s in (1, -1) for u in (1, -1)}
    found = [s * r[0] > 0 and u * r[1] > 0 for (s, u), r in rates.items()]
    for j, side in ((0, 1), (0, -1), (1, 1), (1, -1)):
        above, below = (rates[(side, u) if j == 0 else (u, side)] for u in (1, -1))
        w = (below[1 - j] + above[1 - j]) / (below[1 - j] - above[1 - j])
        leaves = side * (above[j] * (1 + w) + below[j] * (1 - w)) > 0
        found.append(abs(w) < 1 and leaves)
    return any(found)


def test_weights_of_random_intersections_are_those_inside():
    draw = np.random.default_rng(0)
    tables = [rows for rows in draw.normal(size=(20_000, 4, 2)) if not others(rows)]
    tables = np.asarray(tables)
    roots = [inside(rows) for rows in tables]
    # What is left has one root inside: the indices of all modes that go on add up to 1.
    assert {len(found) for found in roots} == {1} and len(tables) > 1000
    slides, on = Components([jnp.zeros(())] * 2), Components([jnp.ones((), bool)] * 2)

    @jax.jit
    @jax.vmap
    def found(rows):
        rates = Corners(map(Components, rows))
        modes = [
            filippov.choose(None, rates, None, slides, on, d, on)[1] for d in jnp.array([1, -1.0])
        ]
        return jnp.stack(sliding_weights.weights(slides, rates).parts), *modes

    weights, forward, _ = found(jnp.asarray(tables))
    assert_allclose(weights, np.asarray(roots)[:, 0], rtol=0, atol=1e-11)
    assert_array_equal(forward, 1)


def test_weights_of_three_surfaces_are_those_inside():
    """Rates multiplied out from a root inside, of which Newton's method from 0 misses some."""
    draw = np.random.default_rng(0)
    sides = np.array(np.meshgrid(*[[1, -1]] * 3, indexing="ij")).reshape(3, 8).T
    roots = draw.uniform(-0.95, 0.95, size=(4000, 3))
    noise = draw.normal(size=(4000, 8, 3))
    shares = np.prod((1 + sides * roots[:, None]) / 2, axis=2)
    rates = noise - np.einsum("ks,ksj->kj", shares, noise)[:, None] - sides + roots[:, None]
    slides = Components([jnp.zeros(())] * 3)

    @jax.jit
    @jax.vmap
    def found(rows):
        return jnp.stack(sliding_weights.weights(slides, Corners(map(Components, rows))).parts)

    weights = np.asarray(found(jnp.asarray(rates)))
    assert np.abs(weights).max() <= 1
    shares = np.prod((1 + sides * weights[:, None]) / 2, axis=2)
    assert_allclose(np.einsum("ks,ksj->kj", shares, rates), 0, rtol=0, atol=1e-12)


def test_derivative_of_the_weights_inside_is_the_implicit_one():
    slides = Components([jnp.zeros(())] * 2)
    rows = jnp.asarray(TABLES[0])

    def weights(rows):
        return jnp.stack(sliding_weights.weights(slides, Corners(map(Components, rows))).parts)

    (w,) = inside(np.asarray(rows))
    shares = np.outer((1 + w[0] * np.array([1, -1])) / 2, (1 + w[1] * np.array([1, -1])) / 2)
    by_w = np.stack([(rows[0] - rows[2]), (rows[1] - rows[3])]).T @ [(1 + w[1]) / 4, (1 - w[1]) / 4]
    by_v = np.stack([(rows[0] - rows[1]), (rows[2] - rows[3])]).T @ [(1 + w[0]) / 4, (1 - w[0]) / 4]
    inverse = np.linalg.inv(np.stack([by_w, by_v], axis=1))
    want = -np.einsum("ij,s->isj", inverse, shares.ravel())
    assert_allclose(jax.jacfwd(weights)(rows), want, rtol=1e-12)
    assert_allclose(jax.jacrev(weights)(rows), want, rtol=1e-12)


@pytest.mark.parametrize("dt", [0.1, 0.7])
def test_corner_that_attracts_by_a_slide_on_one_of_its_surfaces(dt):
    # On x = 0 the other surface is met at the rate 0.3: at t = 0.2 from 0.84, at t = 3 at the
    # corner, from which every other mode leads back.
    sol = run(Relays(jnp.array([[-1.0, 0.5], [-1.0, 0.2]])), (0.1, 1), 8.0, dt)
    assert sol.result == RESULTS.successful
    ts, kinds = table(sol)
    assert kinds == [EventKind.stick] * 2
    assert_allclose(ts, [0.2, 3.0], rtol=1e-13)
    assert_array_equal(sol.mode_final, [0, 0])
    assert_allclose(sol.x_final, [0, 0], rtol=0, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.05, 0.3, 0.7])
def test_corner_that_turns_repelling(dt):
    # For t > 1 the quadrants (+, +) and (-, -) push away.
    sol = run(Turning(jnp.zeros((2, 2))), (0.2, 0.1), 5.0, dt)
    assert sol.result == RESULTS.nonunique
    assert_allclose(sol.t_final, 1.0, rtol=1e-12)
    assert_array_equal(sol.x_final, [0, 0])
    assert_array_equal(sol.mode_final, [0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.05, 0.3, 0.7])
def test_corner_that_turns_repelling_by_slides(dt):
    # M = [[-1, t], [t/2, -1]] has the determinant 1 - t²/2: beyond its zero a slide on the first
    # surface leads away from the second.
    class Leaning(Relays):
        def vector_field(self, t, x, side):
            return jnp.stack([t * side[1] - side[0], t / 2 * side[0] - side[1]])

    sol = run(Leaning(jnp.zeros((2, 2))), (0.2, 0.1), 5.0, dt)
    assert sol.result == RESULTS.nonunique
    assert_allclose(sol.t_final, np.sqrt(2), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.1, 0.03, 0.01, 0.001])
@pytest.mark.parametrize("x0", [(0, 1, 1), (0, 1, 0.7), (0, 1, 0.3), (0.1, 1, 0.5), (0, 0.4, 1.1)])
def test_slide_into_a_two_fold(x0, dt):
    # On the slide (x2 + x3)' = -1 and the weight vanishes as (x2 + x3)²: all slides end there. The
    # start off the surface falls by (1 + t/2) t until it slides.
    sol = run(TwoFold(jnp.asarray(-2.0)), x0, 4.0, dt)
    assert sol.result == RESULTS.nonunique
    assert_allclose(sol.t_final, x0[1] + x0[2], rtol=1e-12)
    assert_allclose(sol.x_final, np.zeros(3), rtol=0, atol=1e-12)


@pytest.mark.parametrize("t1", [1.5, 3.0])
@pytest.mark.parametrize("dt", [0.07, 0.2])
def test_backward_in_time_the_end_of_a_slide_is_not_unique(dt, t1):
    # Slides from 1 - sqrt(0.4) to 1: backward every motion from there may have slid to it.
    there = run(Fold(), (0, 0.3), t1, dt)
    assert_allclose(table(there)[0], [1 - np.sqrt(0.4), 1], rtol=1e-12)
    back = jf.solve(Fold(), there.x_final, t1, 0.0, dt, throw=False)
    assert back.result == RESULTS.nonunique
    assert_allclose(back.t_final, 1.0, rtol=1e-7)  # a double root
    assert_allclose(back.x_final, [1, 0], rtol=0, atol=1e-7)


@pytest.mark.parametrize("dt", [0.02, 0.05, 0.1, 0.2])
def test_backward_in_time_past_a_stick_of_the_moving_belt_is_not_unique(dt):
    there = jf.solve(jf.systems.MovingBelt(), jnp.array([3.0, 0.0]), 0.0, 12.0, dt)
    ts, kinds = table(there)
    assert kinds[2] == EventKind.slip
    back = jf.solve(jf.systems.MovingBelt(), there.x_final, 12.0, 0.0, dt, throw=False)
    assert back.result == RESULTS.nonunique
    # A slide ends at a double root: its time is known to the root of the error of the way there.
    assert_allclose(back.t_final, ts[2], rtol=0, atol=2e-6)


def test_backward_in_time_a_graze_where_nothing_slides_is_passed():
    # y' = x on both sides: the parabola touches at x = 0 and no slide ends there.
    system = jf.piecewise(
        lambda t, x: jnp.stack([jnp.ones_like(t), x[0]]),
        lambda t, x: jnp.stack([jnp.ones_like(t), x[0]]),
        lambda t, x: x[1],
    )
    sol = jf.solve(system, jnp.array([1.0, 0.5]), 2.0, 0.0, 0.3)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.x_final, [-1, 0.5], rtol=0, atol=1e-14)


class Slow(jf.System):
    """x' = 1 above and 2 below a surface, in units of 1e-25, beside a relay of its own."""

    def vector_field(self, t, x, side):
        rate = jnp.where(side[0] > 0, 1e-25, 2e-25).astype(x.dtype)
        return jnp.stack([rate, jnp.where(side[1] > 0, 1, -1).astype(x.dtype)])

    def switching(self, t, x):
        return x


def test_rates_whose_product_is_too_small_for_a_float_cross():
    x0 = jnp.array([-1e-25, 1.0], jnp.float32)
    sol = jf.solve(Slow(), x0, 0.0, 2.0, 0.1, throw=False)
    assert jf.RESULTS.names(sol.result) == "successful"
    assert_allclose(sol.x_final, [1.5e-25, 3.0], rtol=1e-5)
