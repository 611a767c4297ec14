"""`CriticalOrbits`: the equations of an orbit with a multiplier on the unit circle.

The equations of shooting and of the critical vectors have a residual with exact first derivatives
of the flow, through all contacts. Only Newton's matrix needs second derivatives, which are
differences of these. A root is as exact as with exact ones, and no program is compiled in addition
to the programs of a branch of orbits.

Extended systems: Yu. A. Kuznetsov, Elements of Applied Bifurcation Theory (2004), chapter 10.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.bifurcations.critical_vectors import VECTORS, Slopes
from jaxfil.model.outcomes import is_successful
from jaxfil.model.parameter import replace_parameter, replace_parameters
from jaxfil.model.system import System
from jaxfil.orbits.affine import Affine, affine
from jaxfil.orbits.closing import OrbitProblem, phase_condition, shoot_near
from jaxfil.orbits.constant import unchanged
from jaxfil.orbits.corrector import contacts_of
from jaxfil.orbits.curve import ArclengthConstraint
from jaxfil.orbits.newton import Evaluation, Root, Stages, root_of
from jaxfil.orbits.shooting import ShootingOptions, Shot
from jaxfil.xla.known import array_of

# Differences of first derivatives use this power of eps of each unknown; their error is comparable
# to the previous step of Newton's method.
_STEP = 0.45
# The least scale of a component of the state, relative to its value at a neighbour.
_LEAST = 0.01
# Newton's method from a neighbour converges in a few steps or not at all.
_NEWTON_STEPS = 12


class Known(NamedTuple):
    """The shot at a root, and the derivatives of the closure there."""

    shot: Shot
    slopes: Slopes


@dataclasses.dataclass(frozen=True)
class CriticalOrbits:
    """The orbits of a system with critical multipliers in two parameters. Unknowns u are the state,
    the period of an autonomous system, the critical vectors, and the two parameters."""

    system: System
    options: ShootingOptions
    periods: int
    free: tuple[str, str]
    kind: str

    @property
    def autonomous(self) -> bool:
        """Whether the period is one of the unknowns."""
        return self.system.period is None

    def split(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The orbit with its parameters, s = (x, period, p), and the critical vectors."""
        n = self._dimension(u)
        head = n + int(self.autonomous)
        return np.append(u[:head], u[-2:]), u[head:-2]

    def joined(self, s: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """The unknowns of orbit and vectors."""
        return np.concatenate([s[:-2], vectors, s[-2:]])

    def _dimension(self, u: np.ndarray) -> int:
        """The dimension of the state."""
        own = int(self.autonomous)
        return VECTORS[self.kind].dimension(u.size - 2 - own, own)

    def shot(self, s: np.ndarray, first: int = 0) -> Shot:
        """The orbit's shot. The last of its global unknowns is the first parameter, or with
        `first` = 1 the second one."""
        values = array_of(s)
        near, still, starts = _near(self.system, self.free, self.periods, values, array_of(first))
        return jax.tree.map(np.asarray, shoot_near(near, self.options, starts, still))

    def first_slopes(self, s: np.ndarray) -> Float[np.ndarray, "n k"]:
        """The derivative of the orbit's end by state, period and the first parameter."""
        return _by_all(self.shot(s))

    def slopes(self, s: np.ndarray, shot: Shot, normal: np.ndarray, least: np.ndarray) -> Slopes:
        """First derivatives of the orbit's end, and by differences second ones. `least` bounds
        scales of the state from below."""
        first = _by_all(shot)
        by_second = self.shot(s, 1).by_global[0][:, -1:]
        # Units: a component's largest value on the orbit, the size of any other unknown.
        n = shot.size.size
        unit = np.append(np.maximum(shot.size, least), np.where(s[n:] == 0, 1.0, abs(s[n:])))
        steps = np.finfo(s.dtype).eps ** _STEP * unit
        turned = [self._turned(s, shot, h) for h in np.diag(steps)]
        first, still = np.hstack([first, by_second]), np.zeros(n, bool)
        still[list(shot.constant.numbers)] = True
        kept = unchanged(*jax.device_put((still, first[:, :n])))
        still = np.asarray(kept) & ~np.any(first[:, n:], axis=1)
        return Slopes(first, np.stack(turned, axis=-1), normal, unit, still)

    def _turned(self, s: np.ndarray, shot: Shot, h: np.ndarray) -> Float[np.ndarray, "n k"]:
        """The change of first derivatives by one unknown, to the side on which the orbit keeps its
        contacts."""
        ahead = self.shot(s + h)
        if contacts_of(ahead.events) != contacts_of(shot.events):
            h = -h
            ahead = self.shot(s + h)
        return (_by_all(ahead) - _by_all(shot)) / h.sum()

    def normal_at(self, s: np.ndarray) -> np.ndarray:
        """The direction of the field at the start, as one row; without rows for a forced system."""
        if not self.autonomous:
            return np.zeros((0, s.size - 2))
        phase = phase_condition(self.problem(s), array_of(s[:-1]))
        assert phase is not None
        return np.asarray(phase.normal)[None]

    def problem(self, s: np.ndarray) -> OrbitProblem:
        """The orbit problem at the value of the second parameter."""
        system = replace_parameter(self.system, self.free[1], s[-1])
        return OrbitProblem(system, self.options, self.free[0], self.periods)

    def root(self, guess: np.ndarray, constraint: ArclengthConstraint) -> Root:
        """Newton's root of the equations and the constraint, whose base fixes the phase and the
        scales of vectors."""
        base = np.asarray(constraint.base)
        normal = self.normal_at(self.split(base)[0])
        # Relative to its own size a component that goes to zero would never be small.
        least = _LEAST * np.asarray(constraint.scale)[: normal.shape[1]]

        def work(u: Array) -> Evaluation:
            return self._evaluation(np.asarray(u), base, normal, least)

        stages = Stages(work, work, _done)
        return root_of(stages, array_of(guess), _NEWTON_STEPS, constraint.appended, known=True)

    def _evaluation(
        self, u: np.ndarray, base: np.ndarray, normal: np.ndarray, least: np.ndarray
    ) -> Evaluation:
        """All equations at u except the constraint."""
        s, y = self.split(u)
        n, own = normal.shape[1], len(normal)
        shot = self.shot(s)
        sound = is_successful(shot.result)
        # Values that are not finite fail by the outcome of the shot, without differences.
        slopes = self.slopes(s, shot, normal, least) if sound else _unknown(n, own, u.dtype)
        vectors = VECTORS[self.kind]
        block = vectors.equations(slopes, y, self.split(base)[1])
        unfolding = vectors.unfolding(slopes, self.split(base)[1])
        gap = shot.ends[0] - s[:n] + unfolding @ y
        phase = normal @ (s[:n] - base[:n])
        by_s = slopes.closing
        closing = np.hstack([by_s[:, : n + own], unfolding, by_s[:, n + own :]])
        anchor = np.hstack([normal, np.zeros((own, u.size - n))])
        by_s = block.by_orbit
        turned = np.hstack([by_s[:, : n + own], block.by_vectors, by_s[:, n + own :]])
        unit = slopes.unit
        numbers = (
            np.concatenate([gap, phase, block.residual]),
            np.vstack([closing, anchor, turned]),
            np.concatenate([unit[:n], abs(normal) @ unit[:n], block.scale]),
            self.joined(unit, vectors.scale(slopes)),
        )
        residual, jacobian, rows, columns = jax.device_put(numbers)
        known = Known(shot, slopes)
        return Evaluation(residual, jacobian, rows, columns, shot.result, known)


# One function for all roots, because a new one would be traced each time.
def _done(u: Array, done: Evaluation) -> Evaluation:
    return done


def _by_all(shot: Shot) -> np.ndarray:
    """The derivative of the end of the one arc by its start and by the global unknowns."""
    return np.hstack([shot.by_start[0], shot.by_global[0]])


def _unknown(n: int, own: int, dtype: np.dtype) -> Slopes:
    """The slopes of a shot that has failed."""
    k = n + own
    first, second = np.full((n, k + 2), np.nan, dtype), np.full((n, k + 1, k + 2), np.nan, dtype)
    ones = np.ones((own, n), dtype), np.ones(k + 2, dtype)
    return Slopes(first, second, *ones, still=np.zeros(n, bool))


@eqx.filter_jit
def _near(
    system: System, free: tuple[str, str], periods: int, s: Array, first: Array
) -> tuple[Affine[tuple[System, Array]], Array, Array]:
    """The setting near s, in the form of a branch of orbits, as period and one of the parameters
    vary; these unknowns, which are zero there; and the start."""
    own = int(system.period is None)

    def setting(q: Array) -> tuple[System, Array]:
        at = replace_parameters(system, free, q[own:])
        return at, q[0] if own else jnp.asarray(at.period, q.dtype) * periods

    n = s.shape[0] - 2 - own
    near = affine(setting, s[n:], 1 + own, first)
    return near, jnp.zeros(near.width, s.dtype), s[None, :n]
