"""Integrals over long runs, each as a sum of two numbers.

A sum loses the last digits of what is added to it, by errors that may have one sign throughout: in
single precision late steps have lengths of few digits, and equal steps add equal numbers. The
integral of the last steps is therefore one number, and what has been moved from it another one.
Moving is exact, since the first number keeps the rounding of the second one (D. E. Knuth, The Art
of Computer Programming, vol. 2, section 4.2.2).
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from jaxfil.integrate.lane.extension import Extension, Step, Verdict
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.system.components import Components, where

# Numbers are moved after so many steps. After each one, an integral that is small beside its terms
# would have to be as exact as they are.
_STEPS = 32


class LongIntegrals(Extension):
    """The integrals of a lane: 2k components, k of the last steps and k of all before."""

    k: int = eqx.field(static=True)

    def after_step(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: Any,
        step: Step,
        verdict: Verdict | None,
    ) -> tuple[LoopState, Any]:
        due = after.counts.num_accepted % _STEPS == 0
        x = where(due, _moved(after.motion.x, self.k), after.motion.x)
        return dataclasses.replace(after, motion=dataclasses.replace(after.motion, x=x)), own


def _moved(x: Components, k: int) -> Components:
    """The same state, with the integrals of the last steps moved to those before."""
    if x.is_array:
        (own,) = x.parts
        left, moved = _sum(own[-2 * k : -k], own[-k:])
        return Components([jnp.concatenate([own[: -2 * k], left, moved])])
    left, moved = zip(*map(_sum, x.parts[-2 * k : -k], x.parts[-k:]), strict=True)
    return Components((*x.parts[: -2 * k], *left, *moved))


def _sum(small: Any, large: Any) -> tuple[Any, Any]:
    """The rounding of a sum, and the sum."""
    both = large + small
    added = both - large
    return (large - (both - added)) + (small - added), both
