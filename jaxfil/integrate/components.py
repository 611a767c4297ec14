"""What the loop sees of a system: its fields and surfaces on components.

A `System` and an initial state enter; a `ComponentSystem` leaves, with static sizes (n states, m surfaces)
and functions on tuples of scalars. In a batch each scalar is one contiguous array of lanes, which
XLA turns into vector instructions; an (n,) state in the loop would be strided.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.model import check
from jaxfil.model.system import System, has_resets
from jaxfil.xla.trace import EARLY, FIRST, LATE, Traced

Components = tuple[Array, ...]
"""The components of a vector: n (state) or m (surface) scalars."""
Forcing = list[Array]
"""What a field takes of time alone, at one time: see `ComponentSystem.forcing`."""


def unpack(x: Array) -> Components:
    """The components of an (n,) array."""
    return tuple(x[i] for i in range(x.shape[0]))


def pack(blocks: Components, dtype: Any) -> Array:
    """The (n,) array of components; of shape (0,) and the given dtype if there are none."""
    return jnp.stack(blocks) if blocks else jnp.zeros((0,), dtype)


def axpy(x: Components, h: Array, f: Components) -> Components:
    """x + h f."""
    return tuple(a + h * b for a, b in zip(x, f, strict=True))


def where(condition: Array, a: Components, b: Components) -> Components:
    """Componentwise choice between two vectors."""
    return tuple(jnp.where(condition, u, v) for u, v in zip(a, b, strict=True))


def any_of(flags: Components) -> Array:
    """Whether any of the flags is set; False if there are none."""
    total = jnp.zeros((), bool)
    for flag in flags:
        total = total | flag
    return total


def all_finite(*vectors: Components) -> Array:
    """Whether all components of all vectors are finite."""
    total: Any = 0.0
    for block in itertools.chain(*vectors):
        total = total + block * 0  # NaN and inf both give NaN: one test for all
    return jnp.asarray(total == 0)


@dataclasses.dataclass(frozen=True)
class ComponentSystem:
    """A system on components. `sides` are tuples of m scalars, each exactly ±1; `switched` lists
    for each component of the field the sides it depends on. `separate`: no component depends on
    more than one side, and no dH_j/dt on a side other than its own."""

    n: int
    m: int
    slides: bool
    resets: bool
    dtype: Any
    _one: Array | None
    switched: tuple[tuple[int, ...], ...]
    separate: bool
    _field: Callable[..., Components]
    _forcing: Callable[[Array], Forcing]
    _switching: Callable[[Array, Components], Components]
    _reset: Callable[[Array, Components, Array], Components]

    def once(self, function: Callable, *args: Any) -> Any:
        """`function(*args)`, each argument and each result computed once.

        XLA's CPU backend computes a value with several users again inside each user's fusion. It
        does not look through a conditional: this one always takes its first branch, on a condition
        that the compiler cannot see through.
        """
        if self._one is None:
            return function(*args)

        def never(*args):
            shapes = jax.eval_shape(function, *args)
            return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

        return jax.lax.cond(self._one > 0, function, never, *args)

    def where_any(self, flag: Array, function: Callable, otherwise: Callable, *args: Any) -> Any:
        """`function(*args)` if the flag of any lane is set, else `otherwise(*args)`, which must be
        the same where it is not set. On a processor the other one is not computed."""
        if self._one is None:
            return function(*args)
        return jax.lax.cond(eqxi.unvmap_any(flag), function, otherwise, *args)

    def hold(self, *values: Array) -> Components:
        """The same values, each computed once."""
        return self.once(lambda *held: held, *values)

    def forcing(self, t: Array, h: Array, times: Sequence[float]) -> list[Forcing]:
        """What the field takes of time alone and is dear, at t + c·h for each c of `times`: both
        sides of a surface and all stages at one time share it."""

        def at(t: Array, h: Array) -> list[Forcing]:
            return [self._forcing(t + c * h) for c in times]

        return self.once(at, t, h) if jax.eval_shape(self._forcing, t) else [[] for _ in times]

    def field(
        self,
        t: Array,
        x: Components,
        sides: Components,
        alone: bool = False,
        forcing: Forcing | None = None,
    ) -> Components:
        """F(t, x, sides), with what `forcing` has found for t, if it is given. `alone`: all that is
        made of it is one vector, blended or not."""
        return self._field(t, x, sides, alone, forcing)

    def switching(self, t: Array, x: Components) -> Components:
        """H(t, x)."""
        return self._switching(t, x)

    def reset(self, t: Array, x: Components, surface: Array) -> Components:
        """The state after an impact on `surface`."""
        return self._reset(t, x, surface)

    def rate(self, t: Array, x: Components, f: Components) -> Components:
        """dH/dt along the direction (1, f)."""
        _, rate = jax.jvp(self.switching, (t, x), (jnp.ones_like(t), f))
        return rate

    def gradients(
        self, t: Array, x: Components
    ) -> tuple[Components, Components, tuple[Components, ...]]:
        """H, ∂H/∂t and the m gradients ∂H_j/∂x."""
        h, pull = jax.vjp(self.switching, t, x)
        rows = []
        for j in range(self.m):
            pick = tuple(jnp.asarray(float(i == j), self.dtype) for i in range(self.m))
            rows.append(pull(pick))
        return h, tuple(r[0] for r in rows), tuple(r[1] for r in rows)

    def corner_sides(self) -> list[Components]:
        """All 2^m combinations of sides, the first surface varying slowest, + before −; of
        separate surfaces the first and the last, which hold the same numbers as all."""
        all_sides = [[1.0] * self.m, [-1.0] * self.m]
        corners = all_sides if self.separate else itertools.product((1.0, -1.0), repeat=self.m)
        return [tuple(jnp.asarray(s, self.dtype) for s in corner) for corner in corners]


def build(system: System, x0: Array) -> ComponentSystem:
    """The scene of a system whose float leaves have the dtype of `x0`, shape (n,)."""
    n, dtype = x0.shape[0], x0.dtype
    t0 = jnp.zeros((), dtype)
    h_shape = check.shapes(system, x0)
    m = 1 if h_shape == () else h_shape[0]
    dynamic, static = eqx.partition(system, eqx.is_array)

    def module(leaves):
        return eqx.combine(leaves, static)

    def field(leaves, t, x, sides):
        side = sides[0] if h_shape == () else pack(sides, dtype)
        return unpack(module(leaves).vector_field(t, pack(x, dtype), side))

    def switching(leaves, t, x):
        return unpack(jnp.reshape(module(leaves).switching(t, pack(x, dtype)), (m,)))

    def reset(leaves, t, x, surface):
        return unpack(module(leaves).reset(t, pack(x, dtype), surface))

    x, sides = unpack(x0), (jnp.ones((), dtype),) * m
    one, hold = _fences(dynamic, x0) if jax.default_backend() == "cpu" else (None, lambda v: v)
    when = (FIRST, EARLY, LATE, LATE)
    traced_field = Traced(field, dynamic, t0, x, sides, hold=hold, when=when)
    traced_switching = Traced(switching, dynamic, t0, x, hold=hold)
    resets = has_resets(system) and m > 0
    traced_reset = Traced(reset, dynamic, t0, x, jnp.int32(0), hold=hold) if resets else reset
    nothing = jax.tree.map(lambda _: False, (dynamic, t0, x))
    seen = [traced_field.depends(*nothing, _only(j, m)) for j in range(m)]
    switched = tuple(tuple(j for j in range(m) if seen[j][i]) for i in range(n))
    steers = [traced_switching.depends(*nothing[:2], _only(i, n)) for i in range(n)]
    return ComponentSystem(
        n=n,
        m=m,
        slides=system.slides and m > 0,
        resets=resets,
        dtype=dtype,
        _one=one,
        switched=switched,
        separate=m > 0 and _separate(switched, steers),
        _field=lambda t, x, sides, alone, known: traced_field(
            dynamic, t, x, sides, alone=alone, known=known
        ),
        _forcing=lambda t: traced_field.ahead(dynamic, t),
        _switching=lambda t, x: traced_switching(dynamic, t, x),
        _reset=lambda t, x, surface: traced_reset(dynamic, t, x, jnp.asarray(surface, jnp.int32)),
    )


def _only(i: int, size: int) -> tuple[bool, ...]:
    return tuple(k == i for k in range(size))


def _separate(switched: Sequence[tuple[int, ...]], steers: Sequence[tuple[bool, ...]]) -> bool:
    """Whether each surface is switched by its own side alone, given which sides the components of
    the field depend on, and which surfaces depend on those components of the state."""
    single = all(len(seen) <= 1 for seen in switched)
    foreign = any(
        enters and set(seen) - {j}
        for seen, steered in zip(switched, steers, strict=True)
        for j, enters in enumerate(steered)
    )
    return single and not foreign


def _fences(dynamic: Any, x0: Array) -> tuple[Array, Callable]:
    """A one that the compiler cannot see through, for `ComponentSystem.once`, and what holds a sine.

    A conditional round a single sine is dissolved by XLA, a division by a value of each lane is
    not: XLA holds a division to be expensive and computes it once.
    """
    leaves = [jnp.ravel(v)[0] for v in jax.tree.leaves((dynamic, x0)) if v.dtype == x0.dtype]
    never = sum(leaves) == jnp.finfo(x0.dtype).max
    lane_one = jax.lax.stop_gradient(jnp.where(never, 2.0, 1.0).astype(x0.dtype))
    return jax.lax.optimization_barrier(jnp.ones((), x0.dtype)), lambda v: v / lane_one
