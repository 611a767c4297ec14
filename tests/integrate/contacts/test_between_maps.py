"""Several switches at one time: the state between two of them has no mode, and nothing sees one."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxfil as jf

LIMIT = 1.0


class Pushed(jf.System):
    """A block with dry friction, at rest, under a force that is sampled eight times a second and
    held: x'' = u − sgn x'."""

    amplitude: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], x[2] - LIMIT * side, 0 * x[2]])

    def switching(self, t, x):
        return x[1]

    def tick(self, t, x, clock):
        return x.at[2].set(self.amplitude * jnp.sin(2 * jnp.pi * t))

    @property
    def clocks(self):
        return (jf.Clock(0.125),)

    @property
    def period(self):
        return 1.0


def friction(t, x, side):
    return LIMIT * side


def over(t, x, side):
    return LIMIT * side - 1.03


AMPLITUDES = jnp.array([0.8, 1.5, 2.5])


@pytest.mark.slow
def test_a_force_that_ends_a_stick_is_not_taken_for_the_friction():
    """The extremes are those of the forces that held, 0.8 at most, or the limit of friction."""

    def found(amplitude):
        quantities = {"high": jf.Maximum(friction), "low": jf.Minimum(friction)}
        run = dict(transient=0, samples=2, steps=20, compact=True)
        return jf.settled_average(Pushed(amplitude), quantities, jnp.zeros(3), **run).averages

    extremes = jax.jit(jax.vmap(found))(AMPLITUDES)
    np.testing.assert_allclose(extremes["high"], [0.8, LIMIT, LIMIT], rtol=1e-12)
    np.testing.assert_allclose(extremes["low"], [-0.8, -LIMIT, -LIMIT], rtol=1e-12)


@pytest.mark.slow
def test_no_section_and_no_saved_row_sees_a_force_beyond_the_limit_of_friction():
    def run(amplitude):
        sections = [jf.Section(over, direction=d) for d in (0, 1, -1)]
        kept = dict(saveat=diffrax.SaveAt(steps=True), observe=friction, max_events=96)
        sol = jf.solve(
            Pushed(amplitude),
            jnp.zeros(3),
            0.0,
            2.0,
            0.05,
            sections=sections,
            compact=True,
            throw=False,
            **kept,
        )
        seen = jnp.where(jnp.isfinite(sol.ts), abs(sol.observed), 0.0)
        return sol.result, jnp.max(seen), jnp.sum(sol.crossings.sections >= 0)

    result, most, count = jax.jit(jax.vmap(run))(AMPLITUDES)
    assert np.all(jf.RESULTS.names(result) == "successful")
    np.testing.assert_allclose(most, [0.8, LIMIT, LIMIT], rtol=1e-12)
    assert not count.any()


class Tanks(jf.System):
    """Two tanks, and a root of the difference of their levels between them; a dose is poured into
    the lower one, which reverses the flow. A block with friction is pushed by the level there."""

    dose: jax.Array

    def vector_field(self, t, x, side):
        d = x[0] - x[1]
        flow = 0.4 * jnp.where(side[0] > 0, jnp.sqrt(d), -jnp.sqrt(-d))
        return jnp.stack([0.5 - flow, flow - 0.3 * x[1], 0.5 * x[1] - LIMIT * side[1]])

    def switching(self, t, x):
        return jnp.stack([x[0] - x[1], x[2]])

    def tick(self, t, x, clock):
        return x.at[1].add(self.dose)

    @property
    def clocks(self):
        return (jf.Clock(10.0, 1.0),)


@pytest.mark.slow
def test_a_tick_carries_a_state_to_where_the_field_it_comes_from_is_not_defined():
    """The side, and the end of the stick, are events of their own behind that of the tick."""
    doses = np.array([0.3, 2.0, 2.4])

    def run(dose):
        kept = dict(throw=False, max_events=8, compact=True)
        return jf.solve(Tanks(dose), jnp.array([1.0, 0.2, 0.0]), 0.0, 1.3, 0.05, **kept)

    def piece(x, t0, t1):
        def field(t, x):
            flow = 0.4 * np.sign(x[0] - x[1]) * np.sqrt(abs(x[0] - x[1]))
            push = 0.5 * x[1] - LIMIT
            return [0.5 - flow, flow - 0.3 * x[1], push if push > 0 else 0.0]

        return solve_ivp(field, (t0, t1), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]

    sols = jax.jit(jax.vmap(run))(jnp.asarray(doses))
    assert np.all(jf.RESULTS.names(sols.result) == "successful")
    before = piece([1.0, 0.2, 0.0], 0.0, 1.0)
    ends = [piece(before + np.array([0.0, dose, 0.0]), 1.0, 1.3) for dose in doses]
    np.testing.assert_allclose(sols.x_final, ends, rtol=1e-10)
    tick, carry, slip = (jf.EventKind[name].value for name in ("tick", "carry", "slip"))
    rows = np.array([[tick, 0, 0], [tick, carry, slip], [tick, carry, slip]])
    np.testing.assert_array_equal(sols.events.kinds[:, :3], rows)


HALF = 0.4


def square(t):
    return jnp.where(jnp.mod(jnp.floor(t / HALF), 2.0) < 0.5, 1.0, -1.0)


class Bridge(jf.System):
    """A current i that a relay holds at `ref`. Source and modulator reverse at one tick, so that
    their product stays; a reset of the source's surface counts half cycles."""

    ref: jax.Array

    def vector_field(self, t, x, side):
        drive = -side[1] * x[1] * side[0] * 2.0
        return jnp.stack([drive - 0.5 * x[0], 0 * x[1], 0 * x[2]])

    def switching(self, t, x):
        return jnp.stack([square(t) + 0 * x[0], x[0] - self.ref])

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, x.at[2].add(1.0), x)

    def tick(self, t, x, clock):
        return x.at[1].multiply(-1.0)

    @property
    def clocks(self):
        return (jf.Clock(HALF),)


@pytest.mark.release
def test_a_slide_goes_on_through_a_map_and_a_carry_that_cancel():
    """Between the two the field repels from the surface on both sides. i = 4 (1 − e^(−t/2)) up to
    ref."""
    refs = np.array([1.0, 0.6])

    def run(ref):
        kept = dict(max_events=32, compact=True, throw=False)
        return jf.solve(Bridge(ref), jnp.array([0.0, 1.0, 0.0]), 0.0, 1.9, 0.05, **kept)

    sols = jax.jit(jax.vmap(run))(jnp.asarray(refs))
    assert np.all(jf.RESULTS.names(sols.result) == "successful")
    np.testing.assert_allclose(sols.x_final, [[ref, 1.0, 4.0] for ref in refs], rtol=1e-12)
    assert not np.any(np.asarray(sols.events.kinds) == jf.EventKind.slip.value)


class Contactor(jf.System):
    """An armature held on its stop by a pull F − S. The rectifier follows a source that reverses
    at each tick, so that the pull stays."""

    pull: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], 1.0 - self.pull * square(t) * side[0]])

    def switching(self, t, x):
        return jnp.stack([square(t) + 0 * x[0], x[0]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 1, x.at[1].multiply(-0.3), x)

    @property
    def clocks(self):
        return (jf.Clock(HALF),)

    @property
    def period(self):
        return 2 * HALF


def holding(t, x, reaction):
    return reaction[1]


@pytest.mark.release
def test_a_rest_goes_on_through_a_jump_of_two_signs_that_cancel():
    def found(pull):
        flags = jf.EventSum(lambda t, before, after, surfaces: surfaces)
        quantities = {"events": flags, "least": jf.Minimum(holding)}
        run = dict(transient=0, samples=2, steps=20, compact=True)
        return jf.settled_average(Contactor(pull), quantities, jnp.zeros(2), **run).averages

    averages = jax.jit(jax.vmap(found))(jnp.array([2.0, 5.0]))
    np.testing.assert_array_equal(averages["events"][:, 1], 0.0)
    np.testing.assert_allclose(averages["least"], [1.0, 4.0], rtol=1e-12)


KICK, SIZE = 0.2, 2


class Neurons(jf.System):
    """Two neurons, each of which fires at 1, is set to 0 and kicks the other."""

    rates: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return self.rates + 0 * x

    def switching(self, t, x):
        return 1.0 - x

    def reset(self, t, x, surface):
        return jnp.where(jnp.arange(SIZE, dtype=surface.dtype) == surface, 0.0, x + KICK)


class Above(eqx.Module):
    level: jax.Array

    def __call__(self, t, x):
        return x[0] - self.level


def counted(x, rates, level, t1):
    """The crossings of a level by the first neuron, up and down, through flights and spikes."""
    x, t, counts = np.array(x), 0.0, np.zeros(2, int)

    def passed(a, b):
        counts[:] += a < level < b, a > level > b

    while True:
        waits = (1 - x) / rates
        wait = min(waits.min(), t1 - t)
        passed(x[0], x[0] + rates[0] * wait)
        x, t = x + rates * wait, t + wait
        if wait < waits.min():
            return counts
        due, fired = [int(waits.argmin())], []
        while due:
            after = np.where(np.arange(SIZE) == due[0], 0.0, x + KICK)
            passed(x[0], after[0])
            fired.append(due[0])
            x = after
            due = [i for i in range(SIZE) if x[i] > 1 and i not in fired]


@pytest.mark.slow
def test_each_spike_of_an_avalanche_crosses_the_levels_that_it_jumps_across():
    """Of a spike that is kicked back at once both crossings of 0.1 count; a neuron that is kicked
    beyond its threshold crosses 0.9 upward and downward."""
    draw = np.random.default_rng(5)
    starts, rates = draw.uniform(0.15, 0.85, (6, SIZE)), draw.uniform(0.8, 1.2, (6, SIZE))
    levels = np.resize([0.1, 0.9], 12)
    starts, rates = np.repeat(starts, 2, axis=0), np.repeat(rates, 2, axis=0)

    def run(x, rates, level):
        sections = [jf.Section(Above(level), direction=d) for d in (1, -1, 0)]
        kept = dict(sections=sections, max_events=128, compact=True)
        sol = jf.solve(Neurons(rates), x, 0.0, 6.05, 0.1, stepper=jf.RK4(), **kept)
        return jnp.stack([jnp.sum(sol.crossings.sections == k) for k in range(3)])

    found = jax.jit(jax.vmap(run))(*map(jnp.asarray, (starts, rates, levels)))
    right = [counted(*lane, 6.05) for lane in zip(starts, rates, levels, strict=True)]
    np.testing.assert_array_equal(found[:, :2], right)
    np.testing.assert_array_equal(found[:, 2], np.sum(right, axis=-1))


class Store(jf.System):
    """A store that is used up at the rate of 1, with a delivery of 10 every 2 and a loss of 30 %
    every 1: at t = 2 it has 0.4, then 10.4, then 7.28."""

    clocks = (jf.Clock(2.0), jf.Clock(1.0))

    def vector_field(self, t, x, side):
        return -1.0 + 0 * x

    def tick(self, t, x, clock):
        return jnp.where(clock == 0, x + 10.0, 0.7 * x)


class StoreAboveItsFloor(Store):
    """The same with a surface that is never reached."""

    def switching(self, t, x):
        return x[0] + 100.0


class TwoNeurons(jf.System):
    """x0' = 1 and x1' = 0.05 with thresholds at 1; each that fires kicks the other by 0.2."""

    slides = False

    def vector_field(self, t, x, side):
        return jnp.array([1.0, 0.05])

    def switching(self, t, x):
        return 1 - x

    def reset(self, t, x, surface):
        return jnp.where(jnp.arange(2, dtype=surface.dtype) == surface, 0.0, x + 0.2)


CUT = [
    (Store(), [3.0], lambda t, x: x[0] - 8.0, 1, 2.5, [6.78]),
    (StoreAboveItsFloor(), [3.0], lambda t, x: x[0] - 8.0, 1, 2.5, [6.78]),
    # The tick at the time of the section belongs to the run that ends there.
    (Store(), [3.0], lambda t, x: t - 2.0, 1, 2.5, [6.78]),
    (TwoNeurons(), [0.0, 0.9], lambda t, x: x[0] - 0.6, -1, 1.5, [0.7, 0.025]),
]


def in_two_runs(system, section, direction, t1):
    """The end as a function of the start, of a run that ends at a section and of the next one."""
    last = jf.Section(section, direction=direction, terminal=1)

    def chained(x0):
        first = jf.solve(system, x0, 0.0, t1, 0.05, sections=last)
        return jf.solve(system, first.x_final, first.t_final, t1, 0.05).x_final

    return chained


@pytest.mark.parametrize(
    "system, x0, section, direction, t1, end", CUT, ids=["store", "floor", "time", "neurons"]
)
@pytest.mark.slow
def test_a_run_that_ends_between_two_maps_ends_after_the_last(
    system, x0, section, direction, t1, end
):
    """So that the run from there is the rest of the whole one."""
    chained = in_two_runs(system, section, direction, t1)
    x0 = jnp.array(x0)
    whole = jf.solve(system, x0, 0.0, t1, 0.05).x_final
    np.testing.assert_allclose(whole, end, rtol=1e-13)
    np.testing.assert_allclose(chained(x0), whole, rtol=1e-13)
    if isinstance(system, Store):  # each of the two losses leaves 0.7
        np.testing.assert_allclose(jax.jacfwd(chained)(x0), [[0.49]], rtol=1e-13)


@pytest.mark.release
def test_a_run_from_between_two_kicks_has_the_derivative_of_the_whole():
    system, x0, section, direction, t1, _ = CUT[-1]
    slopes = jax.jacfwd(lambda x: jf.solve(system, x, 0.0, t1, 0.05).x_final)(jnp.array(x0))
    chained = in_two_runs(system, section, direction, t1)
    np.testing.assert_allclose(jax.jacfwd(chained)(jnp.array(x0)), slopes, atol=1e-13)


def test_a_bound_between_two_maps_ends_the_run_after_the_last():
    full = jf.bound(lambda t, x: 8.0 - x[0])
    sol = jf.solve(Store(), jnp.array([3.0]), 0.0, 2.5, 0.05, sections=full, throw=False)
    assert sol.result == jf.RESULTS.out_of_bounds
    np.testing.assert_allclose(sol.t_final, 2.0, rtol=1e-15)
    np.testing.assert_allclose(sol.x_final, [7.28], rtol=1e-13)
