"""The question of a decision, which modes may follow from a point on several surfaces, and what two
of its answers have in common (see `decision`).
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.surfaces.reactions import Forces
from jaxfil.integrate.system.components import Components, any_of, where

# Rounding of rates, accelerations and fields, in eps of the sizes of their terms.
NOISE = 64
# Tolerance for equal velocities, in eps; weights of coupled surfaces magnify rounding.
_ONE_MOTION = 1024


class Question(eqx.Module):
    """The data of a decision. Components are m."""

    rates: Corners
    """ψ, on each combination of sides."""
    fields: Corners | None
    """The fields on these combinations, n components; None to count all modes as different
    motions."""
    following: Corners | None
    """dψ/dt on these combinations; None if it does not decide, or with `forces`, which have it."""
    mode: Components
    """The mode, including rests, of surfaces that are not decided; the side of those that are, on
    which a motion that stands still stays."""
    on: Components
    """Surfaces to be decided."""
    walls: Components | None
    """Surfaces to be decided that the motion can rest but not slide on; None without any."""
    kept: Components | None
    """Surfaces to be decided on which the motion continues unchanged if it can, within rounding;
    None without any."""
    now: Components | None
    """The current mode of the surfaces in `kept`."""
    forces: Forces | None
    """Reactions; None without walls."""
    direction: Array
    """+1 forward in time, −1 backward."""
    steered: Components
    """Surfaces whose dH/dt is another function on other sides (`Structure.steered`)."""
    threshold: Array | float
    """The rate above which the motion leaves a surface, relative to all rates there."""
    leaves: Array | bool = True
    """Whether dψ/dt is known, and may decide."""
    instant: Array | float = 0.0
    """The rounding of the time, during which a rate may have been zero."""
    slides: bool = eqx.field(static=True, default=True)
    """Whether the system may slide. Otherwise a motion that the field of one side holds on its
    surface, while that of the other pushes it there, stays on its side."""

    def ended(self, sides: Components) -> Components:
        """Slides that have ended at their `sides` at this time, m flags: in this event, or in one
        before it, after which the motion is still on the surface. A rate that vanishes on the side
        of another surface is a coincidence."""
        if self.now is None or self.kept is None:
            return self.on & ~self.on
        return (~self.on & (self.now == 0)) | (self.kept & (self.now == sides))


def question_of(
    rates: Corners,
    fields: Corners | None,
    following: Corners | None,
    mode: Components,
    on: Components,
    direction: Array,
    steered: Components,
    instant: Array | float = 0.0,
    slides: bool = True,
) -> Question:
    """The question for surfaces without resets, of which all are open."""
    return Question(
        rates=rates,
        fields=fields,
        following=following,
        mode=mode,
        on=on,
        walls=None,
        kept=None,
        now=None,
        forces=None,
        direction=direction,
        steered=steered,
        threshold=0.0,
        instant=instant,
        slides=slides,
    )


def in_place(
    rates: Corners, following: Corners, direction: Array, instant: Array | float, free: Any = True
) -> tuple[Corners, Components]:
    """The rates ψ, with dψ/dt in place of ψ for surfaces, among the `free` ones, whose rates
    vanish on every side; and flags of these. Just after, at the time s, these rates are s dψ/dt,
    with the sign that they have in the direction of time. A rate that vanishes at a time known up
    to rounding vanishes here."""
    level = (rates.sizes() <= instant * following.sizes()) & free
    return rates.map(lambda rate, a: where(level, direction * a, rate), following), level


def pushed_by_none(question: Question) -> Components:
    """Surfaces to be decided whose rate no reaction changes. The derivative of a rate that a
    reaction cancels says nothing, since the reaction goes on to cancel it."""
    on, known = question.on, question.forces
    if known is None:
        return on
    return on & (abs(known.pushes) @ on.like(jnp.ones_like(question.direction)) == 0)


class Velocity(eqx.Module):
    """A velocity, n components, and the size of its terms."""

    f: Components
    size: Components


def are_apart(a: Velocity, b: Velocity) -> Array:
    """Whether two velocities differ by more than rounding."""
    eps = float(jnp.finfo(a.f.parts[0].dtype).eps)
    size = a.size + abs(a.f) + abs(b.f)
    return any_of(abs(a.f - b.f) > _ONE_MOTION * eps * size)
