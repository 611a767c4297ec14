"""Random masses with friction and walls, and with clocks, against their exact motions."""

import functools as ft

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names
from tests.oracles.linear_flow import Uncertain
from tests.oracles.mechanical_problems import T1, numbers_of, random_machine, system_of
from tests.oracles.mechanics import propagate

COUNT, SHAPE = 60, (1, 1, 1)


@eqx.filter_jit
@eqx.filter_vmap
def solve(numbers, x0):
    """The outcomes and the ends of a batch."""
    sol = jf.solve(system_of(numbers), x0, 0.0, T1, 0.02, max_events=500, throw=False)
    return sol.result, sol.x_final


@ft.cache
def answers():
    """Of each problem that is judged the outcome, and whether the end is right."""
    problems = [random_machine([0, *SHAPE, i], *SHAPE) for i in range(COUNT)]
    numbers = zip(*(numbers_of(machine) for machine, _ in problems), strict=True)
    batch = tuple(jnp.asarray(np.stack(column)) for column in numbers)
    results, ends = solve(batch, jnp.asarray(np.stack([x0 for _, x0 in problems])))
    found = []
    for problem, name, end in zip(problems, outcome_names(results), ends, strict=True):
        try:
            motion = propagate(*problem, T1)
        except Uncertain:
            continue
        found.append((str(name), bool(abs(end - motion.x).max() < 1e-7 * (1 + motion.size))))
    return found


@pytest.mark.slow
def test_no_answer_is_wrong_and_called_successful():
    assert len(answers()) > 0.9 * COUNT
    assert all(right for name, right in answers() if name == "successful")


@pytest.mark.slow
def test_all_problems_are_answered():
    assert all(name == "successful" for name, _ in answers())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "numbers"),
    [
        # Turns that end with an impact that starts a slip; a friction that relieves a wall.
        ((2, 1, 1), (47, 96)),
        # Turns of which only one is resolved when predictions agree.
        ((3, 1, 1), (110,)),
        # What rests on a wall does not rub on the ground, though it would on its neighbour. Walls
        # that take over where frictions end.
        pytest.param(*((2, 2, 1), (533, 97, 148)), marks=pytest.mark.release),
        # A phase that goes on while impacts die out; impacts on two walls at one time, for ever.
        # Frictions that bear what a wall would bear too, at the start and at events, also where a
        # mass begins to move. Of seed 1: either of two walls that bear what a friction cannot.
        (
            (2, 2, 2),
            (
                26,
                178,
                190,
                73,
                136,
                381,
                441,
                455,
                91,
                313,
                373,
                450,
                453,
                668,
                194,
                (1, 125),
                (1, 284),
            ),
        ),
        # Impacts that die out beside a mass that comes to rest, or that sticks in each flight.
        # Two frictions and two walls that bear one load, in several shares.
        pytest.param(
            *((3, 2, 2), (55, 352, 635, 669, 658, 396, 413, 576, 657)), marks=pytest.mark.release
        ),
    ],
)
def test_masses_whose_contacts_depend_on_each_other(shape, numbers):
    """By the numbers of the problems, of seed 0 unless stated."""
    seeded = [i if isinstance(i, tuple) else (0, i) for i in numbers]
    problems = [random_machine([seed, *shape, i], *shape) for seed, i in seeded]
    machines = zip(*(numbers_of(machine) for machine, _ in problems), strict=True)

    @eqx.filter_vmap
    def run(numbers, x0):
        system = system_of(numbers)
        sol = jf.solve(system, x0, 0.0, T1, 0.02, max_events=500, throw=False, compact=True)
        return sol.result, sol.x_final

    batch = tuple(jnp.asarray(np.stack(column)) for column in machines)
    results, ends = run(batch, jnp.asarray(np.stack([x0 for _, x0 in problems])))
    assert set(map(str, outcome_names(results))) == {"successful"}
    for problem, end in zip(problems, ends, strict=True):
        motion = propagate(*problem, T1)
        np.testing.assert_allclose(end, motion.x, rtol=0, atol=1e-8 * (1 + motion.size))


@pytest.mark.slow
def test_masses_at_whose_contact_impacts_die_out_rest_beside_a_friction_that_holds_one():
    # From t = 1.6157 the first mass sticks, the second rests on it, and so it sticks too. Its
    # velocity after the impacts is a limit, known less well than the first one's, which is held.
    shape = (2, 2, 2)
    machine, x0 = random_machine([0, *shape, 67], *shape)

    @eqx.filter_jit
    def run(numbers, x0):
        return jf.solve(system_of(numbers), x0, 0.0, 1.65, 0.02, max_events=500, throw=False)

    sol = run(tuple(map(jnp.asarray, numbers_of(machine))), jnp.asarray(x0))
    assert sol.result == jf.RESULTS.successful
    # The frictions share the load, so that the first one may be at its limit.
    np.testing.assert_array_equal(sol.mode_final[1:], [0, 1, 2])
    np.testing.assert_allclose(sol.x_final[2:4], 0, atol=1e-15)
