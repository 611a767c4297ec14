"""The defining equations of a tangency of an orbit to a surface, and the conditions of its kind.

Three families cover all kinds:

- "flight": in a mode ±1 the orbit is tangent to Σ: H = Ḣ_s = 0 (grazing, grazing-sliding);
- "slide": a slide is tangent to the end of the sliding region: Ḣ_s = 0 and D Ḣ_s = 0, D along the
  slide (adding-sliding);
- "arrival": from the other side it arrives on Σ at the end of the sliding region: H = Ḣ_s = 0
  (crossing-sliding, switching-sliding).

Ḣ_s = ∂H/∂t + ⟨∇H, F_s⟩, with time as a state. Around the tangency the orbit is followed in one mode
as if Σ were not there, from phase `start` to phase `stop`, and by the full flow elsewhere. On
either side of the bifurcation the equations are then smooth.

In a program a family is its index in `FAMILY_NAMES`, so that one program serves all kinds.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from jaxfil.integrate.lane.problem import KeptMode, even_grid
from jaxfil.integrate.loop.extensions import problem_of
from jaxfil.integrate.loop.iterate import integrate
from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.integrate.surfaces import filippov
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.lowered import ComponentSystem, build
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.system import System
from jaxfil.orbits.shooting import ShootingOptions
from jaxfil.xla.kernel import kernel_if_it_fits
from jaxfil.xla.select import select

FAMILY_NAMES = ("flight", "slide", "arrival")
FLIGHT, SLIDE, ARRIVAL = range(len(FAMILY_NAMES))
# The family of each kind.
FAMILIES = {
    "grazing": FLIGHT,
    "grazing-sliding": FLIGHT,
    "adding-sliding": SLIDE,
    "crossing-sliding": ARRIVAL,
    "switching-sliding": ARRIVAL,
}

# Pieces of the flight on either side of the tangency.
_PIECES = 16
# A guard below this fraction of its largest value on the flight is zero, at the tangency itself.
_ROUNDING = 1e-7


class Tangency(eqx.Module):
    """A tangency of an orbit, and the flight around it that is followed in one mode. Phases are
    times since t = 0 in periods."""

    x: Float[Array, " n"]
    """The state at the start of the flight."""
    phase: Float[Array, ""]
    """The phase of the tangency."""
    start: Float[Array, ""]
    """The phase of the start of the flight."""
    stop: Float[Array, ""]
    """The phase of the end of the flight."""
    mode: Float[Array, " m"]
    """The mode of the flight."""
    surface: Int[Array, ""]
    """The number of the surface."""
    side: Float[Array, ""]
    """The side s = ±1 from which the orbit comes."""
    struck: Bool[Array, ""]
    """Whether the surface resets the state at the tangency. The reset of a wall at rest is the
    identity, and the flight continues. The spike of a neuron is not, and there are two orbits, with
    and without it."""


class Conditions(eqx.Module):
    """The conditions at a tangency that define the kind of the bifurcation. All are multiplied by
    s, so that positive means away from Σ on side s."""

    h: Float[Array, ""]
    """The switching function H."""
    rate: Float[Array, ""]
    """Ḣ along the field F_s of this side."""
    bend: Float[Array, ""]
    """Ḧ along F_s, positive at a visible tangency."""
    other_rate: Float[Array, ""]
    """Ḣ along the field of the other side, positive at the end of a sliding region."""
    slide_rate: Float[Array, ""]
    """The derivative of Ḣ_s along the slide; 0 for a system without sliding."""
    slide_bend: Float[Array, ""]
    """Its second derivative along the slide."""


class _Rates:
    """H of the surface and its derivatives along the fields at the tangency."""

    def __init__(self, system: System, x: Float[Array, " n"], tangency: Tangency):
        self.system, self.tangency = build(system, x, compact=True), tangency
        self.number = jnp.arange(tangency.mode.shape[0], dtype=jnp.int32)

    def h(self, t: Array, x: Array) -> Array:
        """s H."""
        values = pack(self.system.switching(t, self.system.unpack(x)), x.dtype)
        return self.tangency.side * jnp.sum(select(self.number == self.tangency.surface, values, 0))

    def with_rate(
        self, side: Array, function: Callable[[Array, Array], Array]
    ) -> Callable[[Array, Array], tuple[Array, Array]]:
        """A function of (t, x) and its derivative along the field with this side of the surface."""
        mode = select(self.number == self.tangency.surface, side, self.tangency.mode)

        def both(t: Array, x: Array) -> tuple[Array, Array]:
            blocks = filippov.field(
                self.system, t, self.system.unpack(x), self.system.of_surfaces(mode)
            )
            field = pack(blocks, x.dtype)
            return jax.jvp(function, (t, x), (jnp.ones_like(t), field))

        return both

    def along(
        self, side: Array, function: Callable[[Array, Array], Array]
    ) -> Callable[[Array, Array], Array]:
        """The derivative alone."""
        both = self.with_rate(side, function)
        return lambda t, x: both(t, x)[1]

    @property
    def rate(self) -> Callable[[Array, Array], Array]:
        """s Ḣ_s."""
        return self.along(self.tangency.side, self.h)


def defining(
    system: System, family: Int[Array, ""], t: Array, x: Float[Array, " n"], tangency: Tangency
) -> Float[Array, "2"]:
    """The two equations of a family at (t, x)."""
    rates = _Rates(system, x, tangency)
    if not rates.system.slides:
        return jnp.stack(rates.with_rate(tangency.side, rates.h)(t, x))
    h = rates.h(t, x)
    rate, along_slide = rates.with_rate(0 * tangency.side, rates.rate)(t, x)
    return select(family == SLIDE, jnp.stack([rate, along_slide]), jnp.stack([h, rate]))


def approach(system: System, there: Tangency) -> tuple[Array, Float[Array, " n"]]:
    """s Ḣ_s where a flight starts, and its gradient by the state."""
    rate = _Rates(system, there.x, there).rate
    return jax.value_and_grad(rate, argnums=1)(there.start, there.x)


@eqx.filter_jit
def conditions(system: System, t: Array, x: Float[Array, " n"], tangency: Tangency) -> Conditions:
    """All conditions at (t, x)."""

    def at(t: Array, x: Array) -> Conditions:
        rates, s = _Rates(system, x, tangency), tangency.side
        rate, bend = rates.with_rate(s, rates.rate)(t, x)
        slide_rate = slide_bend = jnp.zeros_like(t)
        if rates.system.slides:
            on_slide = rates.along(0 * s, rates.rate)
            slide_rate, slide_bend = rates.with_rate(0 * s, on_slide)(t, x)
        h, other_rate = rates.with_rate(-s, rates.h)(t, x)
        return Conditions(
            h=h,
            rate=rate,
            bend=bend,
            other_rate=other_rate,
            slide_rate=slide_rate,
            slide_bend=slide_bend,
        )

    # Compiled part by part it would take twice as long.
    return kernel_if_it_fits(at)(t, x)


def kind_of(family: Int[Array, ""], found: Conditions) -> Int[Array, ""]:
    """The number in `FAMILIES` of the kind with these conditions; −1 without one."""
    # Where both rates vanish together there is no sliding region.
    scale, eps = abs(found.other_rate) + abs(found.rate), float(jnp.finfo(found.h.dtype).eps)
    slides = (found.other_rate > 0) & (scale > jnp.sqrt(eps) * abs(found.bend))
    visible, no = found.bend > 0, jnp.zeros((), bool)
    arrives = found.other_rate > 0
    flags = [
        (visible & ~slides, visible & slides, no, no, no),
        # On a slide Ḣ_s is negative within the sliding region, and reaches zero from below.
        (no, no, (found.slide_bend < 0) & arrives, no, no),
        (no, no, no, arrives & visible, arrives & (found.bend < 0)),
    ]
    kinds = jnp.stack([jnp.stack(row) for row in flags])[family]
    return select(jnp.any(kinds), jnp.argmax(kinds), -1)


class Closing(eqx.Module):
    """The closure residual of an orbit through a tangency, with its contacts. `holds` is true if
    the guards of the flight, followed as if Σ were not there, are positive except at the
    tangency. `contacts` counts the contacts of the orbit elsewhere."""

    gap: Float[Array, " n"]
    t: Array
    x: Float[Array, " n"]
    size: Float[Array, " n"]
    holds: Array
    contacts: Int[Array, ""]
    result: RESULTS


def close(
    system: System,
    period: Array,
    options: ShootingOptions,
    family: Int[Array, ""],
    tangency: Tangency,
) -> Closing:
    """Integrate the orbit once from the start of the flight, with the reset at the tangency if that
    is struck."""
    on_components = build(system, tangency.x, compact=options.compact)
    mode = on_components.of_surfaces(tangency.mode)
    start, at = tangency.start * period, tangency.phase * period
    arrival = family == ARRIVAL
    stop = select(arrival, at, tangency.stop * period)
    # The full flow covers the remainder, or for an arrival, an ordinary contact, the whole period.
    rest = select(arrival, start, stop)
    times = jnp.concatenate([_divided(start, at), _divided(at, stop), rest[None]])
    lengths = jnp.repeat(jnp.stack([at - start, stop - at]) / _PIECES, _PIECES)
    lengths = jnp.append(lengths, start + period - rest)

    def stretch(carry: tuple, now: tuple[Array, Array, Array, Array]) -> tuple:
        x, size, result = carry
        t, length, keeps, after = now
        x = select(keeps | ~arrival, x, tangency.x)
        if system.resets:
            x = select(after & tangency.struck, system.reset(t, x, tangency.surface), x)
        flow = _Flow(on_components, options, KeptMode(mode, keeps), period)
        x, new_size, contacts, new = flow(t, length, x)
        result = RESULTS.where(result == RESULTS.successful, new, result)
        return (x, jnp.maximum(size, new_size), result), (x, contacts)

    # One program for the pieces of the flight, whose guards are checked, and for the remainder.
    number = np.arange(2 * _PIECES + 1)
    keeps, after = jnp.asarray(number < 2 * _PIECES), jnp.asarray(number == _PIECES)
    first = (tangency.x, abs(stop_gradient(tangency.x)), RESULTS.successful)
    (end, size, result), (xs, contacts) = jax.lax.scan(
        stretch, first, (times, lengths, keeps, after)
    )
    ts = jnp.append(start, (times + lengths)[:-1])
    xs = jnp.concatenate([tangency.x[None], xs[:-1]])
    # After a reset the full flow follows the orbit, in a mode of its own.
    seen = ~tangency.struck | jnp.asarray(number <= _PIECES)
    return Closing(
        gap=end - tangency.x,
        t=at,
        x=xs[_PIECES],
        size=size,
        holds=_holds(on_components, tangency.mode, seen, *stop_gradient((ts, xs))),
        contacts=contacts[-1],
        result=result,
    )


def _divided(start: Array, stop: Array) -> Array:
    """The beginnings of equal pieces."""
    return start + (stop - start) * jnp.arange(_PIECES).astype(start.dtype) / _PIECES


def _holds(on_components: ComponentSystem, mode: Array, seen: Array, ts: Array, xs: Array) -> Array:
    """Whether all guards are positive beyond rounding at the points `seen` of a flight, and so are
    their minima between two."""
    modes = on_components.of_surfaces(mode)

    def guards(t: Array, x: Array) -> Array:
        return pack(filippov.guard(on_components, t, on_components.unpack(x), modes), x.dtype)

    def with_rates(t: Array, x: Array) -> tuple[Array, Array]:
        blocks = filippov.field(on_components, t, on_components.unpack(x), modes)
        return jax.jvp(guards, (t, x), (jnp.ones_like(t), pack(blocks, x.dtype)))

    values, rates = jax.vmap(with_rates)(ts, xs)
    low, high = rates[:-1], rates[1:]
    least = least_between(jnp.diff(ts)[:, None], (values[:-1], values[1:]), (low, high))[1]
    least = select((low < 0) & (high > 0), least, values[1:])
    least = jnp.concatenate([values[:1], least])
    positive = least >= -_ROUNDING * jnp.max(abs(values), axis=0)
    return jnp.all(positive | ~seen[:, None])


_Number = TypeVar("_Number", Array, np.ndarray)


def least_between(
    length: _Number, values: tuple[_Number, _Number], rates: tuple[_Number, _Number]
) -> tuple[_Number, _Number]:
    """The minimum of the cubic with these values and rates at both ends of a step, the first rate
    negative and the second one not: its fraction of the step, and its value."""
    low, high = values
    down, up = (length * rate for rate in rates)
    cubic, square = 2 * (low - high) + down + up, 3 * (high - low) - 2 * down - up
    inner = square**2 - 3 * cubic * down
    # On a short step values that differ by rounding do not agree with the rates.
    part = (-down / (square + inner.clip(0) ** 0.5)).clip(0, 1)
    return part, ((cubic * part + square) * part + down) * part + low


class _Flow(eqx.Module):
    """The flow over stretches of time."""

    system: ComponentSystem
    options: ShootingOptions
    kept: KeptMode
    period: Array

    def __call__(self, t0: Array, length: Array, x: Array) -> tuple[Array, Array, Array, RESULTS]:
        """End, sizes, the number of contacts and the outcome."""
        options = self.options
        count = jnp.ceil(options.steps * abs(stop_gradient(length / self.period)))
        num_steps = jnp.clip(jnp.nan_to_num(count), 1, 8 * options.steps).astype(jnp.int32)
        problem = problem_of(
            self.system,
            tableau_of(options.stepper),
            even_grid(t0, length, num_steps, options.max_events),
            kept=self.kept,
        )
        state = integrate(problem, self.system.unpack(x))
        size = jnp.maximum(pack(state.motion.scale, x.dtype), abs(x))
        return (
            pack(state.motion.x, x.dtype),
            stop_gradient(size),
            state.counts.at_surfaces,
            state.result,
        )
