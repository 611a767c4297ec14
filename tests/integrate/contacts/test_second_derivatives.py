"""Second derivatives through every kind of contact, by x0, t0, t1 and every parameter.

Against closed forms, with the first ones and the values that the same run gives, and against
central differences of first derivatives, which are exact.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil.integrate.surfaces import weights as sliding_weights
from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.system.components import Components
from tests.problems import PROBLEMS, tagged

REVERSE = diffrax.RecursiveCheckpointAdjoint()
# Exact where fields are linear in time, and of two stages, which compile soonest.
PARABOLAS = diffrax.Midpoint()
S = jf.systems


def forward_twice(function):
    return jax.jit(jax.jacfwd(jax.jacfwd(function)))


def twice(function):
    """Of a point and two directions: the value and its slopes along both and along the pair."""

    @jax.jit
    def second(x, u, v):
        return jax.jvp(lambda x: jax.jvp(function, (x,), (u,)), (x,), (v,))

    return second


def by_pairs(function, x):
    """Value, first and second derivatives, of one pair of directions after the other, which
    compiles in half the time."""
    second, eye = twice(function), jnp.eye(x.size)
    (values, slopes), (_, curvatures) = jax.tree.map(
        lambda *leaves: np.reshape(leaves, (x.size, x.size, *np.shape(leaves[0]))),
        *[second(x, u, v) for u in eye for v in eye],
    )
    return values[0, 0], np.moveaxis(slopes[:, 0], 0, -1), np.moveaxis(curvatures, (0, 1), (-2, -1))


def exactly(function):
    """Value, first and second derivatives of a formula."""
    return jax.jit(lambda x: (function(x), jax.jacfwd(function)(x), jax.hessian(function)(x)))


def compare(got, want, rtol):
    """Within `rtol` of the largest entry."""
    assert np.isfinite(want).all()
    assert_allclose(got, want, rtol=0, atol=rtol * np.max(abs(want), initial=1))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.release) if name == "box by everything" else name
        for name in tagged("flow")
    ],
)
@pytest.mark.slow
def test_closed_forms(name):
    p = PROBLEMS[name]
    exact = name.split()[0] in ("ball", "relays", "box", "leave")
    stepper = PARABOLAS if exact else diffrax.Dopri8()
    inputs = p.system, jnp.asarray(p.x0, float), jnp.asarray(float(p.t0)), jnp.asarray(float(p.t1))
    vector, back = ravel_pytree(inputs)

    def end(vector):
        return jf.solve(*back(vector), p.dt, stepper=stepper, max_events=None).xs[-1]

    end, slopes, curvatures = by_pairs(end, vector)
    want, slope, curvature = exactly(lambda vector: p.flow(*back(vector)))(vector)
    assert_allclose(end, want, rtol=0, atol=p.atol)
    assert_allclose(slopes, slope, rtol=0, atol=1e-9)
    compare(curvatures, curvature, 1e-13 if exact else 1e-11)


class Decay(jf.System):
    """x' = -x above c and -2x² below it."""

    c: jax.Array

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, -x, -2 * x * x)

    def switching(self, t, x):
        return x[0] - self.c


def decay(p):
    """Its end at p[2] from p[0], with c = p[1]."""
    return 1 / (1 / p[1] + 2 * (p[2] - jnp.log(p[0] / p[1])))


def decayed(p):
    return jf.solve(Decay(p[1]), p[:1], 0.0, p[2], 0.05).xs[-1, 0]


DECAY = jnp.asarray([1.5, 0.7, 2.0])
curvature_of_decay = jax.jit(jax.vmap(jax.hessian(decay)))


@pytest.mark.slow
def test_forward_over_forward():
    compare(forward_twice(decayed)(DECAY), curvature_of_decay(DECAY[None])[0], 1e-10)


def rows_by_turns(gradient):
    """A Jacobian in forward mode of one direction after the other, for what compiles for long."""

    def jacobian(x):
        row = jax.jit(lambda v: jax.jvp(gradient, (x,), (v,))[1])
        return np.stack([row(v) for v in jnp.eye(x.size)], axis=-1)

    return jacobian


@pytest.mark.release
@pytest.mark.parametrize(
    ("name", "outer"),
    [
        ("leave by everything", lambda gradient: jax.jit(jax.jacfwd(gradient))),
        pytest.param("ball by everything", rows_by_turns, marks=pytest.mark.release),
    ],
)
def test_forward_over_reverse(name, outer):
    p = PROBLEMS[name]
    vector, back = ravel_pytree((p.system, jnp.asarray(p.x0, float)))

    def end(vector):
        options = {"stepper": PARABOLAS, "adjoint": REVERSE, "max_events": None}
        return jf.solve(*back(vector), p.t0, p.t1, p.dt, **options).xs[-1, 0]

    _, _, want = exactly(lambda vector: p.flow(*back(vector), p.t0, p.t1)[0])(vector)
    compare(outer(jax.grad(end))(vector), want, 1e-13)


@pytest.mark.slow
def test_a_batch():
    batch = jnp.stack([DECAY, 1.1 * DECAY])
    got = jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(decayed))))(batch)
    compare(got, curvature_of_decay(batch), 1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
def test_hessians_need_no_adjoint(outer):
    got = jax.jit(outer(jax.jacrev(decayed)))(DECAY)
    compare(got, curvature_of_decay(DECAY[None])[0], 1e-10)


def test_third_derivatives_are_refused_by_name():
    with pytest.raises(NotImplementedError, match="Third derivatives through contacts"):
        jax.jacfwd(jax.jacfwd(jax.jacfwd(decayed)))(DECAY)


class Lift(jf.System):
    """x' = a above the curve x = c + k t², and b below it."""

    p: jax.Array

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, self.p[0], self.p[1])[None]

    def switching(self, t, x):
        return x[0] - self.p[2] - self.p[3] * t**2


@pytest.mark.slow
def test_a_curve_that_moves():
    def end(p):
        return jf.solve(Lift(p[:4]), p[4:5], 0.0, p[5], 0.3, stepper=PARABOLAS).xs[-1, 0]

    def exact(p):
        a, b, c, k, x0, t1 = p
        meet = (a + jnp.sqrt(a**2 + 4 * k * (x0 - c))) / (2 * k)
        return x0 + a * meet + b * (t1 - meet)

    p = jnp.asarray([0.5, -0.7, 0.1, 0.8, 0.9, 2.9])
    compare(by_pairs(end, p)[2], exactly(exact)(p)[2], 1e-12)


@pytest.mark.slow
def test_a_start_on_a_wall_has_the_time_of_its_impact():
    """Beside the floor, at h, the impact comes at the root of h − v δ − g δ²/2."""

    def end(p):
        h, v = p
        ball = S.BouncingBall(g=9.8, restitution=0.8)
        sol = jf.solve(ball, jnp.stack([h, -v]), 0.0, 0.1, 0.05, stepper=PARABOLAS, max_events=2)
        return jnp.append(sol.x_final, sol.events.ts[0])

    def exact(p):
        h, v = p
        fast = jnp.sqrt(v**2 + 2 * 9.8 * h)
        d = 2 * h / (v + fast)
        up, left = 0.8 * fast, 0.1 - d
        return jnp.stack([up * left - 4.9 * left**2, up - 9.8 * left, d])

    p, u, v = jnp.array([[0.0, 1.0], [1.0, 0.3], [0.7, -1.0]])
    got, want = twice(end)(p, u, v), twice(exact)(p, u, v)
    for one, other in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        compare(one, other, 1e-13)


@pytest.mark.slow
def test_numbers_in_closures_have_the_derivatives_of_parameters():
    """From a start on the slide x = a, which moves with it, y = a t, which is a³ at a²."""

    def slide(a):
        relay = jf.piecewise(
            lambda t, x: jnp.stack([-1.0 + 0 * x[0], a]),
            lambda t, x: jnp.stack([1.0 + 0 * x[0], a]),
            lambda t, x: x[0] - a,
        )
        sol = jf.solve(
            relay,
            jnp.stack([a, 0 * a]),
            0.0,
            1.0,
            0.25,
            stepper=PARABOLAS,
            saveat=diffrax.SaveAt(ts=jnp.array([0.33, 1.0])),
            sections=jf.Section(lambda t, x: x[1] - a**3),
            max_events=2,
        )
        return jnp.append(sol.xs.ravel(), sol.crossings.ts[0])

    def exact(a):
        return jnp.stack([a, 0.33 * a, a, a, a**2])

    one = jnp.ones(())
    got, want = twice(slide)(0.7 * one, one, one), twice(exact)(0.7 * one, one, one)
    for left, right in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        compare(left, right, 1e-13)


@pytest.mark.slow
def test_event_times_and_saved_states():
    # A ball's first impact and the states before and after it.
    def kept(p):
        system = S.BouncingBall(g=p[0], restitution=p[1])
        saveat = diffrax.SaveAt(ts=jnp.asarray([0.4, 2.0]))
        options = {"stepper": PARABOLAS, "saveat": saveat, "max_events": 3}
        sol = jf.solve(system, p[2:], 0.0, 2.5, 0.07, **options)
        return jnp.concatenate([sol.events.ts[:1], sol.events.xs[0], sol.xs.ravel()])

    def exact(p):
        g, e, x, v = p
        speed = jnp.sqrt(v**2 + 2 * g * x)
        time = (v + speed) / g
        free = [x + 0.4 * v - 0.08 * g, v - 0.4 * g]
        rest = 2.0 - time
        after = [e * speed * rest - g * rest**2 / 2, e * speed - g * rest]
        return jnp.stack([time, 0 * g, -speed, *free, *after])

    p = jnp.asarray([9.8, 0.8, 10.0, 1.0])
    compare(by_pairs(kept, p)[2], exactly(exact)(p)[2], 1e-13)


@pytest.mark.release
def test_weights_on_an_intersection_to_every_order():
    # p - 2 s1 + a s1 s2 = 0 and q - 2 s2 + b s1 s2 = 0: a quadratic equation for s1.
    def weights(p):
        zero, corners = jnp.zeros(()), [(1, 1), (1, -1), (-1, 1), (-1, -1)]
        rates = Corners(
            Components([p[0] - 2 * s1 + p[2] * s1 * s2, p[1] - 2 * s2 + p[3] * s1 * s2])
            for s1, s2 in corners
        )
        return jnp.stack(sliding_weights.weights(Components([zero, zero]), rates).parts)

    def exact(p):
        p, q, a, b = p
        half = (4 + b * p - a * q) / (4 * b)
        s1 = half - jnp.sqrt(half**2 - p / b)
        return jnp.stack([s1, q / (2 - b * s1)])

    p = jnp.asarray([0.7, 0.9, 0.5, 0.3])
    orders = jax.jacfwd, jax.jacrev, jax.hessian, lambda f: jax.jacfwd(jax.hessian(f))
    got, want = (
        jax.jit(lambda p, f=f: [f(p), *(d(f)(p) for d in orders)])(p) for f in (weights, exact)
    )
    compare(got[0], want[0], 1e-14)
    for i in range(1, 5):
        compare(got[i], want[i], 1e-12)


# Scenes that stick, slip, turn at a fold, and meet a wall, over no whole number of steps.
SCENES = {
    "belt": (S.BeltFriction(omega=4.56), (0.1, 0.9), 1.5),
    "moving belt": (S.MovingBelt(), (3.0, 0.0), 17.0),
    "impacts": (S.ImpactOscillator(amplitude=0.9, omega=1.2), (0.0, 0.3), 15.0),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "belt",
        *(pytest.param(name, marks=pytest.mark.release) for name in ("moving belt", "impacts")),
    ],
)
def test_central_differences_of_first_derivatives(name):
    system, x0, t1 = SCENES[name]
    vector, back = ravel_pytree((system, jnp.asarray(x0), jnp.asarray(t1)))
    along = jnp.cos(jnp.arange(vector.size)) * jnp.maximum(abs(vector), 0.1)

    def end(vector):
        system, x0, t1 = back(vector)
        options = {"stepper": diffrax.Tsit5(), "compact": True, "max_events": None}
        return jf.solve(system, x0, 0.0, t1, t1 / 801.3, **options).xs[-1]

    second = twice(end)
    eye = np.diag(np.maximum(abs(vector), 0.1))
    offsets = 1e-4 * np.asarray([-2, -1, 1, 2])[:, None, None] * eye
    # Of one program, whose slopes along the first direction are those that are differenced.
    slopes = [[second(x, along, along)[0][1] for x in row] for row in vector + offsets]
    want = np.einsum("k,kij->ij", np.asarray([1, -8, 8, -1]), slopes) / 12e-4
    compare(np.stack([second(vector, along, v)[1][1] for v in eye]), want, 1e-7)
