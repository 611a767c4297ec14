"""What a scene does not declare is not in its compiled program.

XLA keeps, for every instruction of an optimised program, the lines of Python that asked for it.
Each thing that can be left out is looked for by the function that writes it, or by a number or an
operation found nowhere else: it must be in the program of a scene that declares it, which shows
that it would be seen, and must not be in that of the same scene without it.
"""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from tests.oracles import hlo
from tests.oracles.compilations import Counter


class Smooth(jf.System):
    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0]])


class Crossing(Smooth):
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - 0.3 * jnp.cbrt(x[1] + side)])

    def switching(self, t, x):
        return x[1]


class Sliding(Crossing):
    slides: ClassVar[bool] = True


class Impact(Crossing):
    def reset(self, t, x, surface):
        return jnp.stack([x[0], -0.9876 * x[1]])


class Ticking(Crossing):
    @property
    def clocks(self):
        return (jf.Clock(0.25),)


# Frequencies and belt speeds of two runs.
NEW = ((4.3, 1.0), (4.4, 1.1))
TS = diffrax.SaveAt(ts=jnp.array([0.3, 0.7]))
PROGRAMS = {
    "smooth": (Smooth, {}),
    "crossing": (Crossing, {}),
    "sliding": (Sliding, {}),
    "impact": (Impact, {}),
    "events": (Crossing, {"max_events": 3}),
    "ts": (Crossing, {"saveat": TS}),
    "section": (Crossing, {"sections": jf.Section(lambda t, x: x[0])}),
    "clock": (Ticking, {}),
}


@pytest.fixture(scope="module", autouse=True)
def nothing_is_compiled_yet():
    """What other files have compiled is not compiled again, and is not seen to be; and lines keep
    more of their callers than ten."""
    jax.clear_caches()
    eqx.clear_caches()
    before = jax.config.jax_traceback_in_locations_limit
    jax.config.update("jax_traceback_in_locations_limit", 40)
    yield
    jax.config.update("jax_traceback_in_locations_limit", before)


@pytest.fixture(scope="module")
def program():
    """The text of the optimised program of a solve by its name in `PROGRAMS`."""
    kept = {}

    def compiled(name):
        if name not in kept:
            scene, options = PROGRAMS[name]
            kept[name] = text(scene(), **{"max_events": None} | options)
        return kept[name]

    return compiled


def text(system, **options):
    # JAX remembers a function inside a function with the lines that first asked for it.
    jax.clear_caches()

    def run(x0):
        grade = dict(stepper=diffrax.Midpoint(), compact=False)
        sol = jf.solve(system, x0, 0.0, 1.0, 0.1, throw=False, **grade, **options)
        return sol.xs, sol.result, sol.events

    program = jax.jit(run).lower(jnp.array([1.0, 0.1]))
    # The text is that of XLA's own optimisation; machine code need not be good.
    return program.compile(compiler_options={"xla_backend_optimization_level": 0}).as_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    "source, declared, other",
    [
        # The search for contacts, and what a contact leads to.
        ("locate.find_contact", "crossing", "smooth"),
        ("locate.land", "crossing", "smooth"),
        ("decide.decided", "crossing", "smooth"),
        ("filippov._choose_on_one", "crossing", "smooth"),
        # Sliding: the blend's weights, the return to the surface, whether it draws the state back.
        ("weights.determinant", "sliding", "crossing"),
        ("normals.project", "sliding", "crossing"),
        ("locate._to_singular_point", "sliding", "crossing"),
        # Impacts, events, and saved states.
        ("test_pay_for_use.Impact.reset", "impact", "crossing"),
        ("recording.record_event", "events", "crossing"),
        ("recording._kind", "events", "crossing"),
        ("recorders.SaveTimes.record", "ts", "crossing"),
        # Sections and clocks.
        ("section_search._look", "section", "crossing"),
        ("section_search._follow", "section", "crossing"),
        ("clocks._next_tick", "clock", "crossing"),
        ("step_length._up_to_tick", "clock", "crossing"),
    ],
)
def test_what_is_not_declared_is_not_in_the_program(program, source, declared, other):
    assert source in hlo.sources(program(declared)), "it is called by another name now"
    assert source not in hlo.sources(program(other))


@pytest.mark.parametrize(
    "mark, declared, other",
    [
        (" sqrt(", "crossing", "smooth"),  # of the cubic's discriminant
        ("0.9876", "impact", "crossing"),
        ("[3,2]", "events", "crossing"),  # the event table's states
        ("[2,2]", "ts", "crossing"),  # saved states
    ],
)
@pytest.mark.slow
def test_marks_of_what_is_not_declared_are_not_in_the_program(program, mark, declared, other):
    assert mark in program(declared), "not a mark any more"
    assert mark not in program(other)


AVERAGES = {
    "mean": lambda t, x, side: x[0],
    "extreme": jf.Maximum(lambda t, x, side: x[0]),
    "sum": jf.EventSum(lambda t, before, after, surfaces: surfaces),
}


class Forced(Crossing):
    period = 1.0


@pytest.mark.slow
def test_what_is_not_averaged_is_not_in_the_program():
    """Each follows lanes by itself, and a mean costs a component of the state and no more."""

    def averaged(name):
        jax.clear_caches()
        grade = dict(samples=2, steps=4, stepper=diffrax.Midpoint(), compact=False)

        def run(x0):
            return jf.settled_average(Forced(), {name: AVERAGES[name]}, x0, **grade).averages

        program = jax.jit(run).lower(jnp.array([1.0, 0.1]))
        return program.compile(compiler_options={"xla_backend_optimization_level": 0}).as_text()

    sources = {name: hlo.sources(averaged(name)) for name in AVERAGES}
    marks = {
        # An extreme is the rate of a component too, of which its own field alone knows.
        "observed._WithRate.vector_field": {"mean", "extreme"},
        "extremes.Extremes._further": {"extreme"},
        "event_sums.EventSums.after_step": {"sum"},
    }
    for mark, names in marks.items():
        assert {name for name in AVERAGES if mark in sources[name]} == names


def test_each_declaration_adds_operations_to_the_loop(program):
    counts = {name: hlo.per_turn(program(name), 1) for name in PROGRAMS}
    assert 3 * counts["smooth"] < counts["crossing"] < counts["sliding"]
    assert counts["crossing"] <= counts["impact"]
    assert counts["crossing"] < min(counts["events"], counts["ts"])


def test_only_a_scene_that_slides_evaluates_both_fields_at_every_stage(program):
    """A switch needs both, at the end of a step; the stages before it one, of a mode that is ±1."""

    def fields(name):
        return hlo.per_turn(program(name), 1, {"cbrt"})

    assert fields("smooth") == 0
    assert fields("crossing") < fields("sliding")


@pytest.mark.slow
def test_a_forcing_is_computed_once_for_each_time_of_a_step():
    def sines(stepper):
        def end(x, system):
            grade = dict(stepper=stepper, compact=False)
            return jf.solve(system, x, 0.0, 1.0, 0.1, throw=False, **grade).xs[-1]

        text = jax.jit(end).lower(jnp.array([0.3, 0.1]), jf.systems.DenHartog()).compile().as_text()
        return text.count("round-nearest-even(")  # each range reduction has one

    # 12 stages of Dopri8 at 11 times, 5 of Tsit5 at as many, 3 of RK4 at two; all three with a look
    # at their errors, as Heun's method, with 1 stage, has none.
    apart = [sines(s) for s in (diffrax.Dopri8(), diffrax.Tsit5(), jf.RK4(), diffrax.Heun())]
    assert apart[0] - apart[1] == 11 - 5 and apart[1] - apart[2] == 5 - 2
    assert apart[2] > apart[3] + 2 - 1


def test_operations_are_counted_in_the_loop_alone_with_the_dearest_branch():
    def run(x):
        def body(carry):
            i, x = carry
            x = jax.lax.cond(i > 2, lambda x: jnp.sqrt(x) / (1 + x), lambda x: x, x)
            return i + 1, x

        return jax.lax.while_loop(lambda c: c[0] < 5, body, (jnp.int32(0), jnp.cbrt(x)))[1]

    program = jax.jit(run).lower(jnp.ones(7)).compile().as_text()
    assert hlo.per_turn(program, 7, {"sqrt"}) == hlo.per_turn(program, 7, {"divide"}) == 1
    assert hlo.per_turn(program, 7, {"cbrt"}) == 0


def test_new_numbers_neither_trace_nor_compile_again():
    counter = Counter()
    counter.watch()
    # Made before any is used: to make an array is to compile something too.
    systems = [jf.systems.BeltFriction(omega=np.float64(w), v=np.float64(v)) for w, v in NEW]
    starts = [jnp.array([0.0, 0.1]), jnp.array([0.2, 0.3])]
    run = jax.jit(lambda s, x0, t1, dt: jf.solve(s, x0, 0.0, t1, dt, stepper=jf.RK4()).xs)
    for i, (system, x0) in enumerate(zip(systems, starts, strict=True)):
        before = dict(counter.counts)
        jax.block_until_ready(run(system, x0, 0.1 + 0.1 * i, 0.01 + 0.003 * i))
        found = counter.since(before)
        made = found["traces"] + found["compilations"]
        assert (made == 0) == (i == 1)


@pytest.mark.slow
def test_a_derivative_outside_of_jit_compiles_nothing_again():
    """As a search by gradient asks for it, step by step."""
    orbit = jf.periodic_orbit(
        jf.systems.SDOscillator(omega=0.84), jnp.array([1.9, 0.0]), steps=60, stepper=jf.RK4()
    )
    counter = Counter()
    counter.watch()
    slope = jax.grad(lambda s: jf.grazing_margin(s, orbit))
    systems = [jf.systems.SDOscillator(omega=np.float64(w)) for w in (0.83, 0.84, 0.85)]
    found = []
    for system in systems:
        before = dict(counter.counts)
        jax.block_until_ready(slope(system).f0)
        found.append(counter.since(before)["compilations"])
    assert found[0] > 0 and found[1:] == [0, 0]


STEPS, KEPT = diffrax.SaveAt(steps=True), diffrax.SaveAt(dense=True)
REVERSE = diffrax.RecursiveCheckpointAdjoint()


@pytest.mark.parametrize("options", [{"saveat": STEPS}, {"saveat": KEPT}, {"adjoint": REVERSE}])
def test_new_times_compile_nothing_where_every_step_is_kept(options):
    counter, x0 = Counter(), jnp.array([1.0, 0.1])
    counter.watch()
    found = []
    for t1, dt in ((1.0, 0.1), (2.0, 0.1), (1.5, 0.07)):
        before = dict(counter.counts)
        sol = jf.solve(Smooth(), x0, 0.0, t1, dt, stepper=jf.RK4(), **options)
        jax.block_until_ready(sol.x_final)
        found.append(counter.since(before)["compilations"])
    assert found[0] > 0 and found[1:] == [0, 0]


def test_a_dense_solution_is_evaluated_by_one_program():
    sol = jf.solve(Smooth(), jnp.array([1.0, 0.1]), 0.0, 1.0, 0.1, stepper=jf.RK4(), saveat=KEPT)
    counter, found = Counter(), []
    counter.watch()
    for t in (0.3, 0.35, 0.9):
        before = dict(counter.counts)
        jax.block_until_ready(sol.evaluate(t))
        found.append(counter.since(before)["compilations"])
    assert found[0] > 0 and found[1:] == [0, 0]
