"""Compact programs: which of the two grades of a step a call compiles.

What a user asked for, and how much work a call is, enter; whether the stages of a step are a loop
in the program (`stepper.compact_step`) leaves. A compact program compiles in half the time or a
third of it, and runs half as long again for one lane, four or five times as long for many: where a
call runs for milliseconds it is the better one, where it runs for seconds the other.
"""

from typing import Any

from jaxfil.xla.lanes import lanes_of

# Lanes of one run at most. Runs are what users call again and again, as optimisers do.
_FEW = 8
# Steps of all lanes of a sweep at most: in a compact program a million take 0.2 s more where lanes
# share a vector, 1.8 s more with tangent vectors; compiling it takes 3 s less.
_MOST = 1_000_000


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
