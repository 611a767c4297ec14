"""Random relay systems with one and two surfaces against their exact motions (`relay_motion`).

Every system is compared in all that a solution tells: outcome, kinds, surfaces and times of the
contacts, states before them, the state and mode at the end, and the derivative of states and times
with respect to everything at once, against finite differences of the exact motion. Excepted are
motions whose exact margin is below `DECIDED`: there float64 cannot tell on which side of a graze, a
corner or a tangency they are. Those must end with finite numbers, and no more is asked of them.
"""

import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis.extra import numpy as arrays
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from tests.oracles import relay_motion as exact
from tests.oracles.random_problems import RelaySystem, random_direction, random_system
from tests.oracles.relay_modes import Relays

T1, MOST, LANES = 4.0, 24, 32
DECIDED = 1e-7
# Steps resolve the fastest field on the way, sliding fields among them: this much of its norm.
RESOLVED, LONGEST, SHORTEST = 0.3, 0.025, 2e-4

OUTCOMES = {
    "successful": (RESULTS.successful,),
    "nonunique": (RESULTS.nonunique,),
    "undecided": (RESULTS.mode_undecided,),
    "many": (RESULTS.max_events_reached, RESULTS.zeno),
}


# Where the motion ends before its time, at a contact that is known.
ENDED = ("nonunique", "undecided")


@eqx.filter_jit
def run(inputs, tangents, dts):
    """Solutions of a batch, and their derivatives in the directions `tangents`."""
    # Written out with one surface; with two that takes five times as long to compile.
    compact = inputs[0].n.shape[1] > 1
    options = {"max_events": MOST, "throw": False, "compact": compact}

    def solved(dt, system, x0):
        sol = jf.solve(RelaySystem(*system), x0, 0.0, T1, dt, **options)
        return (sol.x_final, sol.events.ts, sol.events.xs), sol

    def one(inputs, tangents, dt):
        return jax.jvp(lambda s, x0: solved(dt, s, x0), inputs, tangents, has_aux=True)

    return jax.vmap(one)(inputs, tangents, dts)


def moved(system, x0, direction, step):
    """The exact motion of everything moved a step along a direction."""
    bent = Relays(*(u + np.longdouble(step) * v for u, v in zip(system, direction[0], strict=True)))
    return exact.propagate(bent, x0 + np.longdouble(step) * direction[1], T1, MOST)


def difference(system, x0, direction, h=1e-7):
    """d/dstep of the end, the times of contacts and the states before them; None if the steps
    change the order of contacts. Of extended numbers h² and eps/h are far below what is asked."""
    sides = [moved(system, x0, direction, k * h) for k in (1, -1)]
    if len({(m.outcome, *m.kinds, *m.surfaces, *m.mode) for m in sides}) > 1:
        return None
    weights = np.asarray([1, -1]) / np.longdouble(2 * h)
    columns = zip(*((m.x, np.asarray(m.ts), np.asarray(m.before)) for m in sides), strict=True)
    return [np.tensordot(weights, np.asarray(c), axes=1).astype(float) for c in columns]


def compare(system, x0, direction, motion, values, slopes, sol):
    """Assert that one solution is the exact motion; whether its derivatives were compared too."""
    count = int(sol.num_events)
    assert [EventKind(k).name for k in np.asarray(sol.events.kinds[:count])] == motion.kinds
    assert sol.events.surfaces[:count].tolist() == motion.surfaces
    assert any(bool(sol.result == r) for r in OUTCOMES[motion.outcome]), motion.outcome
    if motion.outcome in ENDED:
        assert_allclose(sol.t_final, motion.t.astype(float), rtol=0, atol=1e-9)
        assert_allclose(values[0], motion.x.astype(float), rtol=0, atol=1e-8)
    if motion.outcome != "successful":
        return False
    exact_slopes = difference(system, x0, direction)
    if exact_slopes is None:
        return False
    assert tuple(sol.mode_final.tolist()) == motion.mode
    # Errors grow as small changes of the system do.
    growth = 1 + max(np.abs(s).max(initial=0) for s in exact_slopes)
    size = 1 + np.abs(np.asarray(motion.x, float)).max()
    exact_values = [np.asarray(v, float) for v in (motion.x, motion.ts, motion.before)]
    for one, other, atol in (
        (values, exact_values, 1e-12 * size * growth),
        (slopes, exact_slopes, 1e-8 * size * growth),
    ):
        assert_allclose(one[0], other[0], rtol=0, atol=atol)
        if count:
            assert_allclose(one[1][:count], other[1], rtol=0, atol=atol)
            assert_allclose(one[2][:count], other[2], rtol=0, atol=atol)
    return True


def check(problems, seed=0):
    """Compare up to `LANES` pairs of a system and an initial state; how many were decided, and of
    how many of these the derivatives were compared too."""
    motions = [exact.propagate(*problem, T1, MOST) for problem in problems]
    directions = [random_direction(*problem, seed + i) for i, problem in enumerate(problems)]
    dts = np.clip([RESOLVED / (m.rate + 1e-3) for m in motions], SHORTEST, LONGEST)
    lanes = [min(i, len(problems) - 1) for i in range(LANES)]

    def stacked(pairs):
        return jax.tree.map(lambda *v: jnp.asarray(np.stack(v)), *[tuple(pairs[i]) for i in lanes])

    values, slopes, sols = run(stacked(problems), stacked(directions), jnp.asarray(dts[lanes]))
    values, slopes, sols = jax.tree.map(np.asarray, (values, slopes, sols))
    followed = []
    everything = zip(problems, directions, motions, strict=True)
    for i, (problem, direction, motion) in enumerate(everything):
        lane = jax.tree.map(lambda v, i=i: v[i], (values, slopes, sols))
        assert np.all(np.isfinite(lane[0][0]))
        if motion.margin >= DECIDED and RESOLVED / motion.rate >= SHORTEST:
            followed.append(compare(*problem, direction, motion, *lane))
    return len(followed), sum(followed)


@pytest.mark.slow
@pytest.mark.parametrize("m", [1, 2])
@pytest.mark.parametrize("first", [0, LANES, 2 * LANES])
def test_random_systems(m, first):
    problems = [random_system(seed, m) for seed in range(first, first + LANES)]
    # One motion of all has more contacts than the table has room for.
    crowded = int((m, first) == (2, 0))
    assert check(problems, first) == (LANES, LANES - crowded)


# Sliding fields with rates of 40 to 500, which outran steps that were not chosen by them.
@pytest.mark.slow
@pytest.mark.parametrize(("m", "seeds"), [(1, (730, 809)), (2, (388, 596, 956))])
def test_random_systems_with_a_fast_slide(m, seeds):
    assert check([random_system(seed, m) for seed in seeds]) == (len(seeds), len(seeds))


@pytest.mark.slow
def test_random_systems_that_end_before_their_time():
    # Several motions go on from a contact.
    assert check([random_system(seed, 2) for seed in (588, 1019)]) == (2, 0)


def test_random_systems_on_intersections_that_one_surface_alone_does_not_attract_to():
    seeds = (400, 583, 603, 802, 1002)
    assert check([random_system(seed, 2) for seed in seeds]) == (len(seeds), len(seeds))


def quarters(*shape):
    """Arrays of quarters: exact zeros, equal rates and simultaneous contacts among them."""
    return arrays.arrays(np.float64, shape, elements=st.integers(-8, 8).map(lambda k: k / 4))


def problems(m, n=3):
    normals = quarters(m, n).filter(lambda v: bool(np.all(np.abs(v).max(axis=1) > 0)))
    relays = st.builds(
        Relays, quarters(n, n), quarters(n), quarters(m, n), quarters(m, n), normals, quarters(m)
    )
    return st.lists(st.tuples(relays, quarters(n)), min_size=1, max_size=LANES)


@pytest.mark.slow
@pytest.mark.parametrize("m", [1, 2])
def test_systems_of_quarters(m):
    seen = []

    @hypothesis.settings(max_examples=8, derandomize=True, deadline=None, database=None)
    @hypothesis.given(problems(m))
    def compare_all(batch):
        seen.append(check(batch))

    compare_all()
    decided, followed = np.sum(seen, axis=0)
    assert decided >= 20 and followed >= 20, "hardly a motion that tells anything"
