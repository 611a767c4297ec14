"""Derivatives through crossings, slides, intersections and resets.

By x0, t0, t1 and every parameter: against closed forms, against central differences of values,
and reverse mode against forward mode. The ends of the bank's motions are differentiated with their
second derivatives, in `test_second_derivatives`.
"""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

import jaxfil as jf
from tests.problems import PROBLEMS, closed_forms
from tests.problems.systems import Box

FORWARD, REVERSE = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()
# Exact where fields are linear in time, and of two stages, which compile soonest.
PARABOLAS = diffrax.Midpoint()
S = jf.systems


def solve(system, x0, t0, t1, dt, adjoint=FORWARD, **kwargs):
    """A run within a budget, as reverse mode under traced times needs one.

    Two surfaces take long to compile, and so do reverse mode and a table of events.
    """
    kwargs.setdefault("max_events", None)
    if isinstance(system, Box | S.BouncingBall):
        kwargs["stepper"] = PARABOLAS
    return jf.solve(system, x0, t0, t1, dt, adjoint=adjoint, max_steps=1024, **kwargs)


BALL = S.BouncingBall(g=9.8, restitution=0.8)


def inputs(system, x0, t0, t1):
    return system, jnp.asarray(x0, float), jnp.asarray(float(t0)), jnp.asarray(float(t1))


def flat(tree):
    """A pytree of Jacobians as one matrix."""
    leaves = [leaf.reshape(leaf.shape[0], -1) for leaf in jax.tree.leaves(tree)]
    return np.concatenate(leaves, axis=1)


def with_values(function, argnums=0):
    """Its Jacobian and its value, from one run."""
    return jax.jacfwd(lambda *args: (function(*args),) * 2, argnums, has_aux=True)


def by_columns(function):
    """Its Jacobian, of one direction after the other, and its values, flat, from one program."""

    @jax.jit
    def along(args, direction):
        return jax.jvp(lambda args: ravel_pytree(function(*args))[0], (args,), (direction,))

    def evaluate(*args):
        numbers, back = ravel_pytree(args)
        values, columns = zip(*(along(args, back(e)) for e in np.eye(numbers.size)), strict=True)
        return np.stack(columns, axis=1), values[0]

    return evaluate


def by_rows(function):
    """The same in reverse mode, whose program for all rows at once compiles for longer."""

    @jax.jit
    def back(weights, args):
        def weighed(*args):
            values = ravel_pytree(function(*args))[0]
            return weights @ values, values

        found = jax.grad(weighed, range(len(args)), has_aux=True)(*args)
        return ravel_pytree(found[0])[0], found[1]

    def evaluate(*args):
        size = sum(np.size(leaf) for leaf in jax.tree.leaves(jax.eval_shape(function, *args)))
        rows, values = zip(*(back(e, args) for e in np.eye(size)), strict=True)
        return np.stack(rows), values[0]

    return evaluate


def arguments(name):
    """The system, start and times of a problem of the bank."""
    p = PROBLEMS[name]
    return inputs(p.system, p.x0, p.t0, p.t1)


# Scenes with kinks of every kind, over spans that are no whole number of steps.
SCENES = {
    "sd": (S.SDOscillator(omega=0.7), (0.3, 0.1), 0.05, 20.0),
    "belt": (S.BeltFriction(omega=4.56), (0.1, 0.9), 0.02, 1.5),
    "moving belt": (S.MovingBelt(), (3.0, 0.0), 0.1, 17.0),
    "slip-stick": (S.SlipStick(), (1.2, 0.6), 0.0, 11.0),
    "den hartog": (S.DenHartog(friction=0.9), (0.5, 0.4), 0.0, 12.0),
    "impacts": (S.ImpactOscillator(amplitude=0.9, omega=1.2), (0.0, 0.3), 0.0, 15.0),
    "fold": (S.VisibleFold(), (-1.0, 0.1), 0.0, 2.2),
}


def scene(name):
    """The end of a scene's run as a function of all its inputs in one vector.

    The SD oscillator's alpha is left out: values near 0 need steps of that size.
    """
    args = inputs(*SCENES[name])
    vector, back = ravel_pytree(args)
    keep = np.ones(vector.size, bool)
    if name == "sd":
        keep[[k for k in range(4) if vector[k] == 0.0]] = False
    keep = np.flatnonzero(keep)

    def end(part, adjoint=FORWARD, compact=None):
        args = back(vector.at[keep].set(part))
        dt = (SCENES[name][3] - SCENES[name][2]) / 401.3
        return solve(*args, dt, adjoint, stepper=diffrax.Tsit5(), compact=compact).xs[-1]

    return end, vector[keep]


@functools.cache
def forward(name):
    """The forward Jacobian of a scene's end and the end, compiled once for all points."""
    return jax.jit(with_values(scene(name)[0]))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SCENES))
def test_central_differences(name):
    _, vector = scene(name)
    steps = 1e-4 * np.maximum(abs(np.asarray(vector)), 0.1)
    offsets = np.asarray([-2, -1, 1, 2])[:, None, None] * np.diag(steps)
    points = np.asarray(vector) + offsets
    values = np.asarray([[forward(name)(jnp.asarray(p))[1] for p in row] for row in points])
    weights = np.asarray([1, -8, 8, -1]) / 12
    differences = np.einsum("k,kij->ji", weights, values) / steps
    got, _ = forward(name)(vector)
    scale = np.maximum(abs(differences), 1)
    assert_allclose(got / scale, differences / scale, rtol=0, atol=1e-7)


def rows_at_once(function):
    """The same as most write it."""
    return jax.jit(jax.jacrev(lambda *args: (function(*args),) * 2, has_aux=True))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "compact", "jacobian"),
    [
        ("sd", True, by_rows),
        ("sd", False, by_rows),
        ("moving belt", True, rows_at_once),
        pytest.param("impacts", True, by_rows, marks=pytest.mark.release),
    ],
)
def test_reverse_is_forward(name, compact, jacobian):
    end, vector = scene(name)
    want, there = forward(name)(vector)
    reverse, at = jacobian(lambda part: end(part, REVERSE, compact))(vector)
    scale = np.maximum(abs(np.asarray(want)), 1)
    assert_allclose(reverse / scale, want / scale, rtol=0, atol=1e-12)
    assert_allclose(at, there, rtol=1e-12)


@pytest.mark.release
def test_reverse_on_an_intersection():
    system, x0, t0, t1 = arguments("box by everything")

    def end(system, x0):
        return solve(system, x0, t0, t1, 0.1, REVERSE).xs[-1, 2]

    def exact(system, x0):
        return closed_forms.box(system, x0, t0, t1)[2]

    got, want = (jax.jit(jax.grad(f, (0, 1)))(system, x0) for f in (end, exact))
    for left, right in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert_allclose(left, right, rtol=0, atol=1e-12)


class Roots(jf.System):
    """A force on each side of x' = 0 that is a real number up to 0.4 beyond it."""

    pull: jax.Array

    def vector_field(self, t, x, side):
        above = -1.2 - jnp.sqrt(x[1] + 0.4) * self.pull
        below = 1.1 + jnp.log(0.4 - x[1]) ** 2
        force = jnp.where(side > 0, above, below) - x[0] + 0.5 * jnp.cos(t)
        return jnp.stack([x[1] + 0.1, force])

    def switching(self, t, x):
        return x[1]


class Through(Roots):
    """The same, never held: its force below points down too."""

    slides = False

    def vector_field(self, t, x, side):
        above = -1.2 - jnp.sqrt(x[1] + 0.4) * self.pull
        below = -0.1 / jnp.sqrt(0.4 - x[1]) - (0.4 - x[1]) ** 1.5 * self.pull
        return jnp.stack([x[1] + 0.1, jnp.where(side > 0, above, below)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stepper", "kind"),
    [
        pytest.param(PARABOLAS, Roots, marks=pytest.mark.release),
        (PARABOLAS, Through),
        pytest.param(jf.Rodas5P(), Through, marks=pytest.mark.release),
        # Of two kinds of contact that are there already, and the one that compiles for longest.
        pytest.param(jf.Rodas5P(), Roots, marks=pytest.mark.release),
    ],
)
def test_a_side_not_taken_leaves_no_nan_in_reverse_mode(stepper, kind):
    # At the start, where x' = 1, the force of the other side is not a number.
    def end(p, adjoint=FORWARD):
        return jnp.sum(solve(kind(p[0]), p[1:], 0.0, 1.5, 0.05, adjoint, stepper=stepper).xs[-1])

    p = jnp.asarray([0.8, 0.0, 1.0])
    want = jax.jit(jax.jacfwd(end))(p)
    assert np.isfinite(want).all() and (abs(want) > 1e-3).all()
    assert_allclose(jax.jit(jax.grad(end))(p, REVERSE), want, rtol=1e-12)


class Draining(jf.System):
    """v' = −p √(v + 0.4) above 0, and below it a rate that is not a number above 0.4."""

    pull: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        above, below = -self.pull * jnp.sqrt(x + 0.4), -0.1 / jnp.sqrt(0.4 - x)
        return jnp.where(side > 0, above, below)

    def switching(self, t, x):
        return x[0]


def test_dense_output_beside_a_side_not_taken_has_reverse_mode():
    """v = (√1.4 − p t/2)² − 0.4 from 1."""

    def at(p):
        dense = diffrax.SaveAt(dense=True)
        sol = jf.solve(Draining(p), jnp.ones(1), 0.0, 1.0, 0.05, saveat=dense, max_events=4)
        return sol.evaluate(0.43)[0]

    def exact(p):
        return (jnp.sqrt(1.4) - 0.215 * p) ** 2 - 0.4

    p = jnp.asarray(0.8)
    assert_allclose(jax.grad(at)(p), jax.grad(exact)(p), rtol=1e-13)


@jax.jit
@with_values
def end_by_alpha(alpha):
    system = S.SDOscillator(omega=0.7, alpha=alpha)
    return solve(system, jnp.asarray([0.3, 0.1]), 0.0, 10.0, 0.025).xs[-1]


def test_alpha_of_the_sd_oscillator_leaves_no_nan():
    assert np.isfinite(end_by_alpha(0.0)[0]).all()


def test_smooth_sd_oscillator():
    # alpha > 0 is smooth: variational equation by central differences.
    values = [end_by_alpha(0.3 + 1e-4 * k)[1] for k in (-2, -1, 1, 2)]
    difference = np.asarray([1, -8, 8, -1]) @ np.asarray(values) / 12e-4
    assert_allclose(end_by_alpha(0.3)[0], difference, rtol=1e-7)


def test_event_times_and_states():
    # Rotating: met at t0 - ln r0, at the angle θ0 - ω (t* - t0), turning with -ω until then.
    def event(system, x0, t0, t1):
        sol = solve(system, x0, t0, t1, 0.01, max_events=4)
        return jnp.append(sol.events.xs[0], sol.events.ts[0])

    def exact(system, x0, t0, t1):
        wait = -jnp.log(jnp.hypot(x0[0], x0[1]))
        angle = jnp.arctan2(x0[1], x0[0]) - system.omega * wait
        return jnp.stack([jnp.cos(angle), jnp.sin(angle), t0 + wait + 0 * t1])

    args = arguments("rotating by everything")
    (got, at), (want, there) = (
        jax.jit(with_values(f, (0, 1, 2, 3)))(*args) for f in (event, exact)
    )
    assert_allclose(at, there, rtol=0, atol=1e-11)
    assert_allclose(flat(got), flat(want), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_saved_states_between_contacts():
    # Every saved state has its own derivative, before and after the two impacts.
    ts = [0.5, 2.0, 3.9]

    def saved(system, x0):
        saveat = diffrax.SaveAt(ts=jnp.asarray(ts))
        return solve(system, x0, 0.0, 4.0, 0.02, saveat=saveat).xs

    system, x0 = BALL, jnp.asarray([10.0, 1.0])

    def last(system, x0):
        return closed_forms.ball(system, x0, 0.0, 3.9)

    def free(system, x0):
        return jnp.stack([x0[0] + x0[1] * 0.5 - system.g * 0.125, x0[1] - system.g * 0.5])

    got, last, free = (
        jax.jit(jax.jacfwd(function, (0, 1)))(system, x0) for function in (saved, last, free)
    )
    for row, want in ((0, free), (2, last)):
        picked = jax.tree.map(lambda leaf, row=row: leaf[row], got)
        assert_allclose(flat(picked), flat(want), rtol=0, atol=1e-10)


class Throw(jf.System):
    """y'' = -1 above the moving line y' = t/2 and -3 below it."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -2 + side])

    def switching(self, t, x):
        return x[1] - t / 2


@jax.jit
@jax.jacfwd
def end_of_a_throw(x0, t1):
    return solve(Throw(), x0, 0.0, t1, 0.07).xs[-1]


@pytest.mark.parametrize("tail", [0.05, 1.0])
def test_saltation_matrix(tail):
    # One crossing of a surface that moves: X = E2 (I + (f+ - f-) n^T / (n·f- + H_t)) E1, where
    # here E is the flow of y'' = -side on each side of y' = t/2.
    # v = 3 - t meets t/2 at t = 2; H' = -3/2 there; the field jumps by (0, -2).
    saltation = np.asarray([[1, 0], [0, 1 + (-2) / (-1.5)]])
    want = np.asarray([[1, tail], [0, 1]]) @ saltation @ np.asarray([[1, 2], [0, 1]])
    assert_allclose(end_of_a_throw(np.asarray([0.0, 3.0]), 2.0 + tail), want, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_batched_and_jitted():
    def end(x0, friction):
        system = S.CoulombOscillator(friction=friction)
        return jf.solve(system, x0, 0.0, 20.0, 0.1).xs[-1]

    x0 = jnp.asarray([[3.0, 0.1], [2.0, -0.5], [-2.5, 0.3]])
    friction = jnp.asarray([0.4, 0.3, 0.5])
    batched = jax.jit(jax.vmap(jax.jacfwd(end, (0, 1))))(x0, friction)
    single = jax.jit(jax.jacfwd(end, (0, 1)))
    for k in range(3):
        alone = single(x0[k], friction[k])
        for got, want in zip(batched, alone, strict=True):
            assert_allclose(got[k], want, rtol=0, atol=1e-13)


class Spring(jf.System):
    """x'' = -4 x: smooth."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -4 * x[0]])


@pytest.mark.parametrize(
    ("adjoint", "jacobian"),
    [(FORWARD, by_columns), pytest.param(REVERSE, by_rows, marks=pytest.mark.release)],
)
def test_saved_states_by_their_saving_times(adjoint, jacobian):
    """The field, at times that are grid points (the first, others, one after an impact, the end)
    and others: a fall from 10, with one impact at 10/7 and v → -0.8 v."""

    def saved(ts, t0, t1):
        saveat = diffrax.SaveAt(ts=ts)
        sol = solve(BALL, jnp.asarray([10.0, 0.0]), t0, t1, 0.125, adjoint, saveat=saveat)
        return sol.xs, sol.ts

    ts = np.asarray([0.0, 0.5, 0.6, 1.25, 2.0, 2.1, 2.5])
    n = len(ts)
    slopes, values = jacobian(saved)(ts, np.asarray(0.0), np.asarray(2.5))
    xs, (by_states, by_times) = values[: 2 * n].reshape(n, 2), np.split(slopes, [2 * n])
    by_ts, by_t0, by_t1 = np.split(by_states.reshape(n, 2, n + 2), [n, n + 1], axis=-1)
    fields = np.stack([xs[:, 1], np.full(n, -9.8)], axis=1)
    assert_allclose(by_ts, np.eye(n)[:, None] * fields[:, :, None], rtol=0, atol=1e-12)
    # Later begun is the same motion later; nothing depends on the end.
    assert_allclose(by_t0[..., 0], -fields, rtol=0, atol=1e-12)
    assert_allclose(by_t1, 0, rtol=0, atol=1e-12)
    assert_allclose(by_times[:, :n], np.eye(n), rtol=0, atol=1e-14)
    assert_allclose(by_times[:, n], 0, rtol=0, atol=1e-14)


@jax.jit
def curvatures_of_what_is_saved(t, x):
    def saved(t, x):
        saveat = diffrax.SaveAt(ts=t[None])
        return jf.solve(Spring(), jnp.stack([x, 0 * x]), 0.0, 1.0, 0.05, saveat=saveat).xs[0, 0]

    return jax.jacfwd(jax.jacfwd(saved, (0, 1)), (0, 1))(t, x)


@pytest.mark.parametrize("time", [0.5, 0.57, 1.0])
def test_second_derivatives_by_a_saving_time(time):
    """cos 2t, by time twice and by time and the initial state, at grid points and between them."""
    by = curvatures_of_what_is_saved(np.asarray(time), np.asarray(1.0))
    cos, sin = np.cos(2 * time), np.sin(2 * time)
    assert_allclose(jax.tree.leaves(by), [-4 * cos, -2 * sin, -2 * sin, 0], rtol=0, atol=1e-9)


class Costed(jf.System):
    """x' = −k x, faster by a half below 1, and the cost ∫ x² dt that nothing depends on."""

    k: jax.Array

    def vector_field(self, t, x, side):
        rate = self.k * (1.25 - 0.25 * side)
        return jnp.stack([-rate * x[0], x[0] ** 2])

    def switching(self, t, x):
        return x[0] - 1.0


@pytest.mark.release
@pytest.mark.parametrize(
    "wrapped",
    [
        jax.jit,
        # Operation by operation: two hundred programs.
        pytest.param(lambda f: f, marks=pytest.mark.release),
    ],
)
def test_reverse_mode_of_a_batch(wrapped):
    starts, t1 = jnp.array([1.5, 2.0]), 2.0

    def end(k, x0):
        return jf.solve(Costed(k), jnp.stack([x0, 0.0]), 0.0, t1, 0.05, adjoint=REVERSE).x_final

    def exact(k, x0):
        # Until t = log(x0)/k, and from there on.
        meets = jnp.log(x0) / k
        x = jnp.exp(-1.5 * k * (t1 - meets))
        return jnp.stack([x, (x0**2 - 1) / (2 * k) + (1 - x**2) / (3 * k)])

    def total(f, number):
        return lambda k: jax.vmap(lambda x0: f(k, x0)[number])(starts).sum()

    k = jnp.array(0.6)
    for number in range(2):
        slope = wrapped(jax.grad(total(end, number)))(k)
        right = jax.jit(jax.grad(total(exact, number)))(k)
        assert_allclose(slope, right, rtol=1e-10, atol=0)


@pytest.mark.parametrize("adjoint", [FORWARD, pytest.param(REVERSE, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_lanes_that_fail_take_nothing_from_the_gradient_of_others(adjoint):
    """One lane starts at NaN, and one has more impacts than the table has rows."""
    heights = jnp.asarray([1.0, np.nan, 1.5, 1e-4])

    def total(p):
        def end(h):
            ball = S.BouncingBall(g=p[0], restitution=p[1])
            run = dict(max_events=4, compact=True, throw=False)
            sol = solve(ball, jnp.stack([h, 0 * h]), 0.0, 1.0, 0.1, adjoint, **run)
            return sol.x_final[0], sol.result

        ends, results = jax.vmap(end)(heights)
        return jnp.where(results == jf.RESULTS.successful, ends, 0.0).sum(), results

    def exact(p):
        tau = 1 - jnp.sqrt(2 * heights[::2] / p[0])
        ends = p[1] * jnp.sqrt(2 * p[0] * heights[::2]) * tau - p[0] * tau**2 / 2
        return ends.sum()

    p = jnp.asarray([9.8, 0.8])
    slope, results = jax.jit(jax.grad(total, has_aux=True))(p)
    names = ["successful", "nonfinite", "successful", "max_events_reached"]
    assert list(jf.RESULTS.names(results)) == names
    assert_allclose(slope, jax.grad(exact)(p), rtol=1e-12)
