"""The grade of a program: compact, or written out.

In a *compact* program the stages of a step are a loop (`compact_step`), a state is an array, and
sines are XLA's own functions, one operation in place of twenty. Its lanes run one after the other,
by the program of one lane. A program that is *written out* has each stage and each number of a
state by itself, and its lanes run in blocks of 64 that share vector instructions. It takes longer
to compile and less time to run.

A run of a few lanes (`is_compact_run`) is compact. It is called repeatedly, as by optimisers, and
its number of steps is often unknown. For a call with a known number of steps, as a sweep is, two
times are estimated (`is_compact_sweep`), the seconds that a compact program saves in compilation,
once, and the seconds that it loses at run time, in this call and in the next ones: a diagram is
drawn again over another range, and 256 lanes of the SD oscillator that took 0.3 s less to compile
and run take 2.4 s in place of 0.13 s then. Processor time on one core of x86-64 with
AVX-512, jaxlib 0.10.2, 256 lanes, 40 steps a period; "operations" is the product in `ProgramSize`:

    system, stepper              operations   saved, s        lost, µs a step of a lane
                                              measured model  measured model
    linear, Dopri8                      195        1.2   1.3      0.56  0.53
    SD oscillator, Dopri8               247        4.0   4.1      0.66  0.67
    SD oscillator, Tsit5                114        3.3   3.2      0.30  0.31
    impact oscillator, Dopri8           247        6.0   6.5      0.60  0.67
    belt friction, Dopri8               507        5.5   6.2      0.89  1.37
    belt friction, Tsit5                234        3.8   4.4      0.46  0.63
    belt friction, RK4                  156        3.2   3.8      0.34  0.42
    two blocks on belts, Dopri8         676        9.4   9.3      1.69  1.83
    two blocks on belts, RK4            208        6.3   6.2      0.82  0.56
    belt and wall, Dopri8               234        9.9  11.6      1.19  0.63
    the same coupled, Dopri8            858       16.1  15.7      2.12  2.32
    rotor and stator, Dopri8           3120       33.1  29.7     12.1   8.4
    rotor and stator, Tsit5            1440       26.1  18.6      6.9   3.9
    rotor and stator, RK4               960       18.2  15.4      5.2   2.6

    chain of 10 numbers, Dopri8         897       21.6   8.5      1.34  2.44
    chain of 20 numbers, Dopri8        1430       47.5  12.0      0.17  0.41

The rotor has two coupled surfaces and is at one of them in most of its steps; the fraction of steps
at a surface is unknown before a run. The two estimates balance at 1 to 9 million steps of all
lanes. A state of more than 12 numbers, as in the last system, is an array in both grades; its own
numbers fill the vectors, and a compact program loses a tenth. With two tangent vectors belt
friction takes 4.2 µs a step in a compact program of one lane, and half of that written out.

Several surfaces with resets compile longest. The difference grows about as the square of m²·n,
`ProgramSize.normals` (first call and a run of 256 lanes of 400 steps, both in seconds of processor
time):

    system                                         m²·n   compact      written out   saved, s
                                                                                     measured model
    a mass between two walls                          8   14   0.15     32   0.05       19    21
    a mass with friction and a wall                   8   17   0.34     41   0.04       24    21
    the same with a load of two numbers              16   15   0.17     65   0.06       51    52
    two masses that strike at both ends of a gap     16   13   0.15     43   0.04       30    54
    random, a mass, friction, a wall, a load         16   21   0.40     79   0.60       58    54
    random, two masses, two walls, a load            24   21   0.36     72   1.21       51   105
    random, two masses, friction, a wall, a load     24   28   0.73    125   1.13       97   107
    random, a mass, friction, two walls, a load      36   51   0.04    293   0.12      242   225

Lanes of a random system differ, and those of a block wait for each other at their contacts, which
is not known before a run either. A run is compact too if writing out would take a minute more.
"""

import dataclasses
import functools as ft
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.system.lowered import build
from jaxfil.model import check
from jaxfil.model.system import System, field_of
from jaxfil.xla.kernel import BLOCK
from jaxfil.xla.lanes import lanes_of
from jaxfil.xla.program import programs

# The largest number of lanes of a single run.
_FEW = 8
# Seconds of compilation that a compact program saves, for each operation, for each operation of H,
# and for each surface (counted twice with resets). Fitted to the table above.
_OPERATION, _GUARD, _SURFACE = 6.6e-3, 0.2, 2.0
# Seconds per step of a lane and per operation in a compact program, and the relative cost of each
# tangent vector.
_STEP, _TANGENT = 2.9e-9, 1.5
# Cost of a block of lanes in a program that is written out, as a multiple of one lane in a compact
# one: a constant for a block of any size, a cost for each lane in it, and the cost for each lane
# whose state is an array in both grades.
_BLOCK, _LANE, _LANE_OF_ARRAY = 0.5, 0.055, 0.9
# The number of calls with one program over which a sweep is to be fast.
_CALLS = 2.25
# The largest array that a program spells out number by number (see `lowered`).
_SPELLED = 12
# The same for the square of m²·n, for several surfaces with resets. Fitted to the second table.
_NORMAL = 0.16
# The longest compilation, in seconds, that a compact run saves by default.
_PATIENCE = 60.0


@dataclasses.dataclass(frozen=True)
class ProgramSize:
    """The size of the program of a lane, known from the functions of a system alone."""

    operations: int
    """Number of operations in all fields that a step evaluates. It is the operations of one field,
    times the stages, and for coupled surfaces times the combinations of sides."""
    guards: int
    """Number of operations in H."""
    contacts: int
    """Number of surfaces; those with resets count twice."""
    spelled: bool
    """Whether the numbers of a state are spelled out in a program that is written out."""
    normals: int
    """m²·n for several surfaces with resets; 0 for others, and without numbers spelled out."""

    @property
    def seconds_saved(self) -> float:
        """Seconds of compilation saved by a compact program."""
        guards, contacts = _GUARD * self.guards, _SURFACE * self.contacts
        return _OPERATION * self.operations + guards + contacts + _NORMAL * self.normals**2

    def seconds_lost(self, lanes: int, steps: int, block: int, tangents: int) -> float:
        """Seconds of run time lost by a compact program. `block` is the number of lanes that share
        vector instructions in a program that is written out."""
        one = _STEP * self.operations * (1 + _TANGENT * tangents) * steps
        share = _BLOCK + _LANE * block if self.spelled else _LANE_OF_ARRAY * block
        # A last block with fewer lanes counts as a full one.
        return one * (lanes - math.ceil(lanes / block) * share)


def is_compact_run(asked: object, system: System, x0: Any, others: Any = ()) -> bool:
    """The grade of a run, or of a function that consists of runs: as requested, and by default
    compact for a few lanes, and if a minute of compilation is saved. `others` are further arguments
    that may be batched."""

    def default() -> bool:
        few = lanes_of((system, x0, others)) <= _FEW
        return few or program_size(system, x0, 1).seconds_saved > _PATIENCE

    return _checked(asked, default)


def is_compact_sweep(
    asked: object,
    system: System,
    x0: Any,
    *,
    stages: int,
    lanes: int,
    steps: int,
    block: int | None = None,
    tangents: int = 0,
) -> bool:
    """The grade of a call with a known number of steps: as requested, and by default the faster
    one, including compilation, over a few calls.

    Each of the `lanes` takes `steps` steps of `stages` stages each, with `tangents` tangent vectors
    beside the state x0, shape (n,). `block` lanes run at a time if the program is written out, by
    default all of them, up to 64.
    """

    def default() -> bool:
        size = program_size(system, x0, stages)
        together = min(lanes, BLOCK) if block is None else block
        return size.seconds_saved >= _CALLS * size.seconds_lost(lanes, steps, together, tangents)

    return _checked(asked, default)


def _checked(asked: object, default: Callable[[], bool]) -> bool:
    if asked is not None and not isinstance(asked, bool):
        raise ValueError(f"`compact` must be True, False or None, got {check.told(asked)}.")
    # The default is computed only where it is needed, since it may trace the system's functions.
    return default() if asked is None else asked


def program_size(system: System, x0: Any, stages: int) -> ProgramSize:
    """The size of the program of a lane of a system with a state like x0, shape (n,), for a stepper
    of the given number of stages."""
    # Only traced; JAX caches the trace, so that new values of parameters cost nothing.
    field, guards, contacts, normals = eqx.filter_eval_shape(_counts, system, x0)
    spelled = len(x0) <= _SPELLED
    return ProgramSize(field * stages, guards, contacts, spelled, normals if spelled else 0)


@eqx.filter_jit
def _counts(system: System, x0: Array) -> tuple[int, int, int, int]:
    """Operations in the fields of one stage, operations in H, contacts, `ProgramSize.normals`."""
    on_components = build(system, x0, compact=True)
    structure, m = on_components.structure, on_components.m
    h, t = check.shapes(system, x0), jnp.zeros((), x0.dtype)
    field = jax.make_jaxpr(ft.partial(field_of, system))(t, x0, jnp.ones(h, x0.dtype))
    guards = jax.make_jaxpr(system.switching)(t, x0)
    # Coupled surfaces need the field on several combinations of sides. If it is affine in them, one
    # base and one more for each surface are enough; otherwise all 2^m are evaluated.
    corners = 1 if structure.separate else m + 1 if structure.affine else 2**m
    contacts = 2 * m if on_components.resets else m
    normals = m * m * len(x0) if on_components.resets and m > 1 else 0
    return corners * _operations(field.jaxpr), _operations(guards.jaxpr), contacts, normals


def _operations(jaxpr: Any) -> int:
    """Operations in a program on single numbers, or on arrays that are not spelled out."""
    count = 0
    for eqn in jaxpr.eqns:
        inner = [getattr(program, "jaxpr", program) for program in programs(eqn.params)]
        sizes = (int(np.prod(v.aval.shape)) for v in eqn.outvars)
        own = sum(size if size <= _SPELLED else 1 for size in sizes)
        # An operation that contains programs, such as a call or a loop, counts as these.
        count += sum(map(_operations, inner)) if inner else own
    return count
