"""Types and shapes of arguments and results, checked as the tests run.

jaxtyping's import hook (`--jaxtyping-packages=jaxfil,tests.inner`, as `.ci/release` has it, since
it takes a sixth more time) hands every function of the package to `inner`. What answers for bad
arguments itself is left as it is, since tests call it with bad ones and look at its answer: the
public functions, and the modules that are the door; and the textbook systems, whose functions
anybody may call with plain numbers.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

DOORS = (
    "jaxfil.model",
    "jaxfil.plot",
    "jaxfil.systems",
    "jaxfil.exponents.intervals",
    "jaxfil.integrate.run.options",
    "jaxfil.integrate.steppers.explicit",
    "jaxfil.sweep.diagram",
    "jaxfil.sweep.parameter_grid",
)
_NAMES = (Path(__file__).parent.parent / "jaxfil" / "__init__.pyi").read_text()


def inner(function: Callable) -> Any:
    """The function with its types checked, unless it is one that checks its arguments itself."""
    # Programs that import from the tests, as the benchmarks do, may do without it.
    from beartype import beartype

    public = f" {function.__qualname__} as {function.__qualname__}" in _NAMES
    door = any(f"{function.__module__}.".startswith(f"{name}.") for name in DOORS)
    return function if public or door else beartype(function)
