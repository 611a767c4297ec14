"""Stiff fields with the linearly implicit stepper: its coefficients; scenes with exact answers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil import EventKind
from jaxfil.integrate.steppers.rosenbrock import RODAS5P
from tests.integrate.steppers.test_order import PROBLEMS, fitted


@pytest.fixture(scope="module")
def method():
    """α, Γ and b."""

    def square(rows):
        return np.asarray([[*row, *[0.0] * (RODAS5P.stages - len(row))] for row in rows])

    gamma = RODAS5P.gamma * (square(RODAS5P.coupling) + np.eye(RODAS5P.stages))
    return square(RODAS5P.alpha), gamma, np.asarray(RODAS5P.b)


def trees(order):
    """All rooted trees of an order, each the tuple of its branches."""

    def forests(size, largest):
        if size == 0:
            yield ()
        for k in range(min(size, largest[0]), 0, -1):
            for i, tree in enumerate(trees(k)):
                if (k, i) <= largest:
                    yield from ((tree, *rest) for rest in forests(size - k, (k, i)))

    return list(forests(order - 1, (order - 1, np.inf)))


def order_of(tree):
    return 1 + sum(map(order_of, tree))


def density(tree):
    return order_of(tree) * np.prod([density(branch) for branch in tree])


def weight(tree, alpha, beta):
    """Hairer and Wanner II, section IV.7: β below a single branch, α where there are several."""
    if len(tree) == 1:
        return beta @ weight(tree[0], alpha, beta)
    return np.prod([alpha @ weight(t, alpha, beta) for t in tree], axis=0) * np.ones(len(alpha))


@pytest.mark.parametrize(("order", "number"), [(1, 1), (2, 1), (3, 2), (4, 4), (5, 9)])
def test_order_conditions(method, order, number):
    alpha, gamma, b = method
    conditions = [b @ weight(t, alpha, alpha + gamma) - 1 / density(t) for t in trees(order)]
    assert len(conditions) == number
    assert_allclose(conditions, 0, rtol=0, atol=1e-13)


def test_stage_times_are_sums_of_rows(method):
    """The published ones, Steinebach (2023)."""
    alpha, gamma, _ = method
    times = [0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664]
    sums = [0.21193756319429014, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734]
    assert_allclose(alpha.sum(axis=1), [*times, 1, 1, 1], rtol=0, atol=1e-13)
    assert_allclose(gamma.sum(axis=1), [*sums, 2.325825639765069, 0, 0, 0], rtol=0, atol=1e-13)
    assert_allclose(RODAS5P.c, alpha.sum(axis=1), rtol=0, atol=1e-15)
    assert_allclose(RODAS5P.drift, gamma.sum(axis=1), rtol=0, atol=1e-15)


def test_l_stable(method):
    alpha, gamma, b = method
    one = np.ones(len(b))

    def growth(z):
        return abs(1 + z * b @ np.linalg.solve(np.eye(len(b)) - z * (alpha + gamma), one))

    assert max(growth(1j * y) for y in np.geomspace(1e-3, 1e6, 2000)) <= 1 + 1e-12
    assert_allclose([growth(-(10.0**k)) * 10.0**k for k in (6, 7, 8)], 12.52, rtol=1e-2)


@pytest.mark.slow
def test_order_across_a_contact():
    """At least five, in values and derivatives; on this linear scene it is nearly six."""
    end, inputs, span, value, derivative = PROBLEMS["rotating"]
    steps, at = np.geomspace(60, 400, 100), jnp.asarray(inputs)

    @jax.jit
    @jax.vmap
    def run(dt):
        stepper = jf.Rodas5P()
        return end(at, dt, stepper), jax.jacfwd(end)(at, dt, stepper)

    values, derivatives = run(jnp.asarray(span / steps))
    for errors in (values - value, derivatives - derivative):
        assert fitted(steps, abs(np.asarray(errors)).reshape(len(steps), -1).max(axis=1)) > 4.7


class Driven(jf.System):
    """x' = -k (x - φ(t)) + φ'(t), φ = cos t + side sin 2t, on the two sides of t = 0.53."""

    k: jax.Array

    def vector_field(self, t, x, side):
        phi = jnp.cos(t) + side * jnp.sin(2 * t)
        return -self.k * (x - phi) - jnp.sin(t) + 2 * side * jnp.cos(2 * t)

    def switching(self, t, x):
        return t - 0.53


def test_stiff_linear_fields_with_a_switch():
    """x = φ + (x0 - φ(0)) e^{-kt} on each side; where kt > 100 nothing is left of the start."""
    ks = jnp.asarray([1e4, 1e6, 1e8, 1e10, 1e12])

    def end(k):
        sol = jf.solve(Driven(k), jnp.zeros(1), 0.0, 2.0, 0.05, stepper=jf.Rodas5P())
        return sol.xs[-1, 0], sol.events.ts[0]

    xs, ts = jax.vmap(end)(ks)
    assert_allclose(ts, 0.53, rtol=1e-14)
    assert_allclose(xs, np.cos(2) + np.sin(4), rtol=0, atol=2e-9)


class DampedRelay(jf.System):
    """x'' = 2 cos 1.3t - x - F sgn w - d max(w, 0), w = x' - v: one side damped."""

    friction: jax.Array
    damping: jax.Array
    v: jax.Array

    def vector_field(self, t, x, side):
        w = x[1] - self.v
        damper = 0.5 * (1 + side) * self.damping * w
        return jnp.stack([x[1], 2 * jnp.cos(1.3 * t) - x[0] - self.friction * side - damper])

    def switching(self, t, x):
        return x[1] - self.v


STICK, SLIP, CROSS = EventKind.stick.value, EventKind.slip.value, EventKind.crossing.value
RELAY = [STICK, SLIP, CROSS, STICK, SLIP, STICK]
BELT = [STICK, SLIP, CROSS, STICK, SLIP, CROSS, STICK, SLIP]
# From (0.5, 2) with F = 0.4 to t = 12: (v, d), the contacts' times and ∂/∂F of these, (x, w) at 12
# and ∂/∂F of that. Sums of exponentials per piece in 60 digits (mpmath), bisected.
# fmt: off
DAMPED = [
    (
        (0.0, 1e3),
        [0.8491308315484368, 1.168823095593246, 3.951080027870597,
         7.067209052120842, 7.433452020577885, 11.88573743950701],
        [-0.430639263556, 0.385449050798, -0.0984762853327,
         -4.76294804103, 4.76287605293, -4.39749055345],
        [-2.333902454162461, 0.0],
        [1.91505721221, 0.0],
    ),
    (
        (0.0, 1e5),
        [0.8492533669448724, 1.169817235339327, 3.950825502542495,
         7.075104259278048, 7.424564142186823, 11.90816275303781],
        [-0.430686060288, 0.385100579464, -0.0988041636216,
         -5.01352532238, 5.01352531403, -5.00876600131],
        [-2.348527609829579, 0.0],
        [1.9354781482, 0.0],
    ),
    (
        (0.0, 1e8),
        [0.8492546047206646, 1.169827274557678, 3.950822926753784,
         7.075186343202777, 7.424472067980885, 11.90840564912672],
        [-0.430686546402, 0.385097060693, -0.0988074747393,
         -5.01625362815, 5.01625362815, -5.01624885469],
        [-2.34867571317372, 0.0],
        [1.93568613603, 0.0],
    ),
    (
        (1.0, 1e3),
        [0.572532188621443, 0.8339629003965425, 4.389456529987262, 6.363546450394793,
         6.615508659665874, 9.148003058096562, 10.28520014571747, 10.53950876785965],
        [-0.362258350202, 0.30337275277, 0.0764195424307, -0.861747189236,
         -0.312804098475, 0.246621084986, -0.436097186963, 0.222846394702],
        [1.108080833739243, -2.915229640044777],
        [0.917649028913, 0.743544132307],
    ),
    (
        (1.0, 1e5),
        [0.5720313957209905, 0.8343717919820248, 4.389559515577991, 6.363890035302173,
         6.617057409921358, 9.146779023599722, 10.28331641235164, 10.53874429964396],
        [-0.362303314498, 0.303141871805, 0.0763404284484, -0.863883028427,
         -0.315125671864, 0.24965973317, -0.435915733156, 0.223346593976],
        [1.108362315689944, -2.917780040052009],
        [0.918060561704, 0.745033545775],
    ),
    (
        (1.0, 1e8),
        [0.5720263392209864, 0.8343759197982507, 4.389560555087381, 6.363893518806822,
         6.617073060313612, 9.14676662420254, 10.28329739240908, 10.53873658082377],
        [-0.362303773824, 0.303139540532, 0.0763396295595, -0.863904636895,
         -0.315149165149, 0.24969056547, -0.435913944048, 0.223351614528],
        [1.108365147398924, -2.917805788252842],
        [0.918064740195, 0.745048475282],
    ),
]
# fmt: on
OPTIONS = dict(max_events=16, max_steps=10_000, throw=False)
TIMES = (1e-10, 1e-10, 2e-8, 1e-10, 1e-10, 1e-6)


@pytest.fixture(scope="module")
def damped():
    """Contacts' times and the end with their ∂/∂F, and solutions, of all of DAMPED."""

    @jax.jit
    @jax.vmap
    def run(v, d, dt):
        def ends(friction):
            system, x0 = DampedRelay(friction, d, v), jnp.asarray([0.5, 2.0])
            sol = jf.solve(system, x0, 0.0, 12.0, dt, stepper=jf.Rodas5P(), **OPTIONS)
            return (sol.events.ts, sol.xs[-1]), sol

        friction = jnp.asarray(0.4)
        return jax.jvp(ends, (friction,), (jnp.ones_like(friction),), has_aux=True)

    rows = [(*row[0], 0.025) for row in DAMPED]
    return run(*jnp.asarray([*rows, (0.0, 1e8, 0.1402291884862172)]).T)


@pytest.mark.release
@pytest.mark.parametrize("row", range(len(DAMPED)))
def test_relay_and_belt_with_a_damped_contact(damped, row):
    (v, _), want_ts, want_dts, want_x, want_dx = DAMPED[row]
    (ts, x), (dts, dx), sol = jax.tree.map(lambda a: np.asarray(a[row]), damped)
    # On the belt w = x' - 1 has rounding of eps, its rate near a contact is 1/d: they are met
    # eps·d too early or late. At d = 1e8 a touch within rounding may be told before, and the rate,
    # 1e-8, is rounding itself: the derivatives of those times are not asked for.
    told = sol.events.kinds[: sol.num_events]
    real = np.flatnonzero(told != EventKind.graze)
    assert told[real].tolist() == (RELAY if row < 3 else BELT)
    assert row == 5 or len(real) == len(told)
    assert_allclose(ts[real], want_ts, rtol=0, atol=TIMES[row])
    assert_allclose(x - [0, v], want_x, rtol=0, atol=1e-11)
    assert row == 5 or np.allclose(dts[real], want_dts, rtol=0, atol=1e-6)
    assert_allclose(dx, want_dx, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_a_contact_slower_than_its_rounding_is_passed(damped):
    """w falls at 1e-8 and has rounding of 1e-14: with this step the search once went on for ever, a
    little past the contact, where it was none any more and could not be landed on."""
    (_, x), _, sol = jax.tree.map(lambda a: np.asarray(a[len(DAMPED)]), damped)
    assert sol.result == jf.RESULTS.successful
    assert_allclose(x, DAMPED[2][3], rtol=0, atol=1e-8)
