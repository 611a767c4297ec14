"""Compact programs: which of the two grades of a step a call compiles.

What a user asked for, and how much work a call is, enter; whether the stages of a step are a loop
in the program (`stepper.compact_step`) leaves. Its sines are XLA's own, one operation in place of
twenty, which do not vectorise (`trace`), but for arrays of them that need time alone: these are
found once for all stages. A compact program compiles sooner and runs longer, for many lanes above
all: these are run one after the other, by the program of one lane. How much, the docstring of
`solve` says. Where a call runs for milliseconds a compact program is the better one, where it runs
for seconds the other.
"""

from typing import Any

from jaxfil.xla.lanes import lanes_of

# Lanes of one run at most. Runs are what users call again and again, as optimisers do.
_FEW = 8
# Steps of all lanes of a sweep at most: in a compact program so many take 0.5 s more, with tangent
# vectors 2.4 s; a first call takes 6 s less of processor time, with tangent vectors 9 s.
_MOST = 750_000


def is_compact_run(asked: object, arguments: Any) -> bool:
    """That of a run, or of what is made of some: as asked for, and by default for few lanes."""
    return _checked(asked, lanes_of(arguments) <= _FEW)


def is_compact_sweep(asked: object, lanes: int, steps: int) -> bool:
    """That of a call that is made once: as asked for, and by default if all its lanes take few
    steps, of which each takes `steps`."""
    return _checked(asked, lanes * steps <= _MOST)


def _checked(asked: object, default: bool) -> bool:
    if asked is not None and not isinstance(asked, bool):
        raise ValueError(f"`compact` must be True, False or None, got {asked!r}.")
    return default if asked is None else asked
