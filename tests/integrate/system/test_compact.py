"""Compact programs: the same motion by a smaller program."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil.integrate.system.grade import is_compact_run, is_compact_sweep, program_size
from jaxfil.xla.lanes import lanes_of
from tests.oracles import cost_scenes, hlo

X0 = jnp.array([0.1, 0.2])


def end(x0, **options):
    belt = jf.systems.BeltFriction()
    how = {"stepper": jf.RK4(), "max_events": None, "throw": False}
    return jf.solve(belt, x0, 0.0, 6.0, 0.05, **how, **options).x_final


def text(function, *args):
    compiled = jax.jit(function).lower(*args).compile().as_text()
    assert compiled is not None
    return compiled


@pytest.mark.slow
def test_both_grades_give_one_motion_and_its_derivatives():
    def both(compact):
        return jax.jacfwd(lambda x: (end(x, compact=compact),) * 2, has_aux=True)

    compact, written = (jax.jit(both(grade))(X0) for grade in (True, False))
    for one, other in zip(compact, written, strict=True):
        assert_allclose(one, other, rtol=1e-12, atol=1e-12)


class Relays(jf.System):
    """Each state is forced, and pushed to zero by its own relay."""

    def vector_field(self, t, x, side):
        return -x - 0.5 * side + jnp.cos(11.0 * t + jnp.arange(float(x.size)))

    def switching(self, t, x):
        return x


@pytest.mark.release
def test_a_forcing_of_arrays_is_found_once_for_all_stages():
    def end(x, grade):
        how = {"compact": grade, "max_events": None, "throw": False}
        return jf.solve(Relays(), x, 0.0, 2.0, 0.02, **how).x_final

    x0 = jnp.linspace(0.5, 1.0, 4)
    compact, written = (
        jax.jacfwd(lambda x, g=g: (end(x, g),) * 2, has_aux=True) for g in (True, False)
    )
    for one, other in zip(compact(x0), written(x0), strict=True):
        assert_allclose(one, other, rtol=1e-12, atol=1e-12)
    # By sines that vectorise. What is left is in branches: the field in the middle of a step whose
    # error is suspect, and d²H/dt² at a contact, now and a moment later. The 13 stages have none.
    sines = hlo.per_turn(text(lambda x: end(x, True), x0), 1, {"cosine", "sine"})
    assert sines <= 7 * x0.size


@pytest.mark.release
def test_grade_follows_from_the_lanes():
    def operations(function, lanes):
        return hlo.per_turn(text(function, jnp.ones((lanes, 2))), lanes)

    # A few lanes are compact, a batch of many is written out.
    batch = jax.vmap(end)
    compact, written = (jax.vmap(lambda x, g=grade: end(x, compact=g)) for grade in (True, False))
    assert operations(batch, 8) == operations(compact, 8) < operations(written, 8)
    assert operations(batch, 9) == operations(written, 9)


class LeaningBlock(jf.System):
    """A block with friction between two walls, driven by a rotating pair of numbers."""

    e: jax.Array

    def vector_field(self, t, x, side):
        q, v, u, w = x
        return jnp.stack([v, u - q - 0.1 * v - 0.2 * side[0], 2.0 * w, -2.0 * u])

    def switching(self, t, x):
        return jnp.stack([x[1], 1 - x[0], 1 + x[0]])

    def reset(self, t, x, surface):
        return jnp.where(surface > 0, x.at[1].mul(-self.e), x)


@pytest.mark.parametrize("lanes", [9, 4096])
def test_a_batch_that_would_compile_for_minutes_is_compact(lanes):
    seen = []

    def grade(e, x0):
        seen.append(is_compact_run(None, LeaningBlock(e), x0))
        seen.append(is_compact_run(None, BELT, x0[:2]))
        return e

    jax.vmap(grade)(jnp.linspace(0.5, 0.9, lanes), jnp.ones((lanes, 4)))
    assert seen == [True, False]


@pytest.mark.release
def test_orbits_of_both_grades_agree():
    # A stable orbit: after a chaotic transient rounding would decide which one is found.
    belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=12.0)
    compact, written = (
        jf.periodic_orbit(belt, X0, transient=100, compact=grade, stepper=jf.RK4())
        for grade in (True, False)
    )
    assert compact.options.compact and not written.options.compact
    assert_allclose(compact.x0, written.x0, rtol=1e-11)
    assert_allclose(compact.multipliers, written.multipliers, rtol=1e-9, atol=1e-11)


@pytest.mark.release
def test_diagrams_of_both_grades_agree():
    """More lanes than one chunk has, so that the second one is filled up."""
    omegas = jnp.linspace(1.0, 2.0, 70)
    options = {"transient": 2, "samples": 3, "steps": 80, "stepper": jf.RK4(), "progress": False}
    belt = jf.systems.BeltFriction()
    compact, written = (
        jf.bifurcation_diagram(belt, "omega", omegas, X0, compact=grade, **options)
        for grade in (True, False)
    )
    assert compact.xs.shape == (70, 3, 2)
    assert_allclose(compact.xs, written.xs, rtol=1e-12, atol=1e-12)
    assert (compact.results == written.results).all()


class Rotor(jf.System):
    """A whirling rotor that rubs on a stator: two surfaces, each in the force of the other."""

    omega: jax.Array

    def vector_field(self, t, x, side):
        q, v = jnp.split(x, 2)
        away = q / jnp.sqrt(q @ q)
        along = jnp.stack([-away[1], away[0]])
        push = jnp.where(side[0] > 0, 20 * (jnp.sqrt(q @ q) - 1), 0.0)
        whirl = jnp.stack([jnp.cos(self.omega * t), jnp.sin(self.omega * t)])
        return jnp.concatenate([v, whirl - q - 0.1 * v - push * (away + 0.2 * side[1] * along)])

    def switching(self, t, x):
        q, v = jnp.split(x, 2)
        speed = (q[0] * v[1] - q[1] * v[0]) / jnp.sqrt(q @ q)
        return jnp.stack([jnp.sqrt(q @ q) - 1, speed + 0.3 * self.omega])


BELT, ROTOR = jf.systems.BeltFriction(), Rotor(jnp.asarray(1.0))
BLOCK = LeaningBlock(jnp.asarray(0.9))
SWEEPS = {
    "a first look": (BELT, 2, {"lanes": 200, "steps": 1600}, True),
    "a figure": (BELT, 2, {"lanes": 2000, "steps": 12_000}, False),
    "a small figure": (BELT, 2, {"lanes": 256, "steps": 12_000}, False),
    "a rotor whose program is ten times as large": (ROTOR, 4, {"lanes": 300, "steps": 4700}, True),
    "a figure of it": (ROTOR, 4, {"lanes": 2000, "steps": 12_000}, False),
    "three lanes that fill a block up": (BELT, 2, {"lanes": 3, "steps": 10**8, "block": 64}, True),
    "three that follow each other": (BELT, 2, {"lanes": 3, "steps": 10**8, "block": 1}, False),
    "a block between walls": (BLOCK, 4, {"lanes": 300, "steps": 400_000}, True),
    "a large figure of it": (BLOCK, 4, {"lanes": 4096, "steps": 10**6}, False),
    "one lane": (BELT, 2, {"lanes": 1, "steps": 3 * 10**6}, True),
    "one with its tangents": (BELT, 2, {"lanes": 1, "steps": 3 * 10**6, "tangents": 2}, False),
    "relays in numbers": (Relays(), 8, {"lanes": 2000, "steps": 12_000}, False),
    "relays in an array": (Relays(), 16, {"lanes": 2000, "steps": 12_000}, True),
}


@pytest.mark.parametrize("name", SWEEPS)
def test_a_sweep_has_the_grade_that_takes_less_time(name):
    """As measured: see the table in `grade`, whose estimates are within a factor of three."""
    system, n, work, compact = SWEEPS[name]
    x0 = jnp.linspace(0.5, 1.0, n)
    assert is_compact_sweep(None, system, x0, stages=13, **work) is compact
    assert is_compact_sweep(not compact, system, x0, stages=13, **work) is not compact


def test_the_size_of_a_program_is_counted_in_stages_and_combinations_of_sides():
    def size(kind, stages=4):
        return program_size(kind(jnp.asarray(1.0), jnp.asarray(0.7)), X0, stages)

    belt, apart, coupled = map(
        size, (cost_scenes.Sliding, cost_scenes.BeltAndWall, cost_scenes.General)
    )
    assert size(cost_scenes.Sliding, 12).operations == 3 * belt.operations
    # Affine in two sides: three fields. Its force has two terms more.
    assert 3 * apart.operations < coupled.operations < 4 * apart.operations
    assert (belt.contacts, apart.contacts) == (1, 4), "resets count twice"


def test_a_program_of_other_numbers_is_not_counted_again():
    count = 0

    class Counted(Relays):
        rate: jax.Array

        def vector_field(self, t, x, side):
            nonlocal count
            count += 1
            return super().vector_field(t, self.rate * x, side)

    program_size(Counted(jnp.asarray(1.0)), X0, 13)
    before = count
    assert program_size(Counted(jnp.asarray(2.0)), 2 * X0, 13).contacts == 2 and before == count > 0


@pytest.mark.parametrize("value", [1, "yes"])
def test_compact_is_a_flag(value):
    with pytest.raises(ValueError, match=f"`compact` must be True, False or None, got {value!r}"):
        end(X0, compact=value)


def test_lanes_are_counted_through_transformations():
    seen = []

    def look(x):
        seen.append(lanes_of(x))
        return (x**2).sum()

    one, some = jnp.ones(2), jnp.ones((5, 2))
    for function, x in (
        (look, one),
        (jax.jit(look), one),
        (jax.jacfwd(jax.jacfwd(look)), one),
        (jax.grad(look), one),
        (jax.vmap(look), some),
        (jax.jit(jax.vmap(jax.jacfwd(look))), some),
        (jax.vmap(jax.vmap(look)), jnp.ones((3, 5, 2))),
        (jax.jacfwd(lambda x: jax.vmap(look)(x)), some),
    ):
        function(x)
    assert seen == [1, 1, 1, 1, 5, 5, 15, 5]
