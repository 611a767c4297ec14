"""A frame: n tangent vectors, orthonormalised one after the other.

The orthonormalisation also gives log R_ii of each vector. For a state that is one array the frame
is one too, (n, n), with a vector in each row, so that the size of programs does not depend on n;
for a state of few numbers the vectors are written out.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.system.components import Components, dot, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select
from jaxfil.xla.thresholds import LOST_DIRECTION

Frame = tuple[Components, ...] | Array
"""The vectors, or an array of them."""


def generic_frame(system: ComponentSystem) -> Frame:
    """n orthonormal vectors in directions that are unlikely to be special to the system."""
    # The axes would be special: where a slide loses x', the axis of x' is lost at once.
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(system.n, system.n)))
    if zeros(system).is_array:
        return jnp.asarray(q.T, system.dtype)
    return tuple(system.constant(column) for column in q.T)


def zeros(system: ComponentSystem) -> Components:
    """A zero for each vector."""
    return system.constant(np.zeros(system.n))


def for_each(
    function: Callable[[Components, Array], tuple[Components, Array]],
    frame: Frame,
    numbers: Components,
) -> tuple[Frame, Components]:
    """Map `function` over the vectors and their numbers; it returns a vector and a number."""
    if isinstance(frame, tuple):
        vectors, out = zip(*map(function, frame, numbers.parts), strict=True)
        return vectors, Components(out)
    moved, out = jax.vmap(function)(Components([frame]), numbers.parts[0])
    return moved.parts[0], Components([out])


def gram_schmidt(
    system: ComponentSystem, frame: Frame, dropped: Array, projected: Array
) -> tuple[Frame, Components]:
    """An orthonormal frame, and log R_ii of each vector.

    A vector whose part outside of the previous ones is rounding is replaced by an orthogonal one.
    Its logarithm is −inf where a contact or a slide has `dropped` it, with an exact length of zero,
    and NaN elsewhere, because it is too small to be resolved. A frame that a step along surfaces
    has `projected` was orthonormal before it, so its vectors have the rounding of a length of one:
    a vector that is lost as a whole is rounding itself.
    """
    size = select(projected, 1.0, 0.0).astype(system.dtype)
    # A QR factorisation of LAPACK would end the kernel.
    if not isinstance(frame, tuple):
        return _gram_schmidt_of_array(system, frame, dropped, size)
    done: list[Components] = []
    logs = []
    for v in frame:
        rest = v
        for _ in range(2):  # the second pass removes the rounding of the first
            for q in done:
                rest = rest + -dot(q, rest) * q
        terms = jnp.maximum(_norm(v), size)
        unit, log = _normalised(system, terms, rest, lambda: _complement(system, done), dropped)
        done.append(unit)
        logs.append(log)
    return tuple(done), Components(logs)


def _gram_schmidt_of_array(
    system: ComponentSystem, frame: Array, dropped: Array, size: Array
) -> tuple[Array, Components]:
    """The same for the rows of an array."""
    rows = jnp.arange(system.n, dtype=jnp.int32)

    def outside(done: Array, v: Array) -> Array:
        """The part of a vector orthogonal to the vectors done."""
        return v - jnp.sum(jnp.sum(done * v, axis=1)[:, None] * done, axis=0)

    def complement(done: Array) -> Components:
        """A unit vector orthogonal to those done, from the axis with the largest such part."""
        most = jax.lax.argmin(jnp.sum(done * done, axis=0), 0, jnp.int32)
        axis = (rows == most).astype(system.dtype)
        left = outside(done, axis)
        return Components([left / jnp.sqrt(jnp.sum(left * left))])

    def next_vector(done: Array, turn: tuple[Array, Array]) -> tuple[Array, Array]:
        k, v = turn
        rest = outside(done, outside(done, v))  # the second pass removes the rounding of the first
        terms, left = jnp.maximum(_norm(Components([v])), size), Components([rest])
        unit, log = _normalised(system, terms, left, lambda: complement(done), dropped)
        return select((rows == k)[:, None], unit.parts[0], done), log

    done, logs = jax.lax.scan(next_vector, jnp.zeros_like(frame), (rows, frame))
    return done, Components([logs])


def _normalised(
    system: ComponentSystem,
    terms: Array,
    rest: Components,
    complement: Callable[[], Components],
    dropped: Array,
) -> tuple[Components, Array]:
    """The remaining part of a vector of terms of this size with unit length, and the logarithm of
    its length; or its replacement."""
    length = _norm(rest)
    lost = length <= LOST_DIRECTION * system.eps * terms
    length = select(lost, 1.0, length)
    nothing = select(dropped, -jnp.inf, jnp.nan)
    return where(lost, complement(), rest / length), select(lost, nothing, jnp.log(length))


def _norm(v: Components) -> Array:
    square = jnp.asarray(dot(v, v))
    zero = square == 0  # the square root has no derivative there
    return select(zero, 0.0, jnp.sqrt(select(zero, 1.0, square)))


def _complement(system: ComponentSystem, done: list[Components]) -> Components:
    """A unit vector orthogonal to orthonormal ones, from the axis with the largest such part."""
    eye = np.eye(system.n)
    best, most = system.constant(0 * eye[0]), jnp.zeros((), system.dtype)
    for j in range(system.n):
        axis = system.constant(eye[j])
        for q in done:
            axis = axis + -q.parts[j] * q
        square = axis.parts[j]  # a projection's diagonal is the square of its column
        best, most = where(square > most, axis, best), jnp.maximum(most, square)
    return best / jnp.sqrt(most)
