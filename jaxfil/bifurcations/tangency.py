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

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfil.integrate.surfaces import filippov
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.lowered import build
from jaxfil.model.system import System
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


class Tangency(eqx.Module):
    """A tangency of an orbit of M arcs of equal length, and the flight around it that is followed
    in one mode. Phases are times since t = 0 in periods."""

    starts: Float[Array, "M n"]
    """The states at the starts of the arcs. The first arc contains the flight."""
    node: Float[Array, ""]
    """The phase of the start of the first arc."""
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


def approach(
    system: System, t: Array, x: Float[Array, " n"], tangency: Tangency
) -> tuple[Array, Float[Array, " n"]]:
    """s Ḣ_s at (t, x), and its gradient by the state."""
    return jax.value_and_grad(_Rates(system, x, tangency).rate, argnums=1)(t, x)


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
    # Where both rates vanish together, as in a continuous field, there is no sliding region.
    scale, eps = abs(found.other_rate) + abs(found.rate), float(jnp.finfo(found.h.dtype).eps)
    slides = (found.other_rate > 0) & (scale > jnp.sqrt(eps) * abs(found.bend))
    visible, no = found.bend > 0, jnp.zeros((), bool)
    flags = [
        (visible & ~slides, visible & slides, no, no, no),
        # On a slide Ḣ_s is negative within the sliding region, and reaches zero from below.
        (no, no, (found.slide_bend < 0) & slides, no, no),
        (no, no, no, slides & visible, slides & (found.bend < 0)),
    ]
    kinds = jnp.stack([jnp.stack(row) for row in flags])[family]
    return select(jnp.any(kinds), jnp.argmax(kinds), -1)
