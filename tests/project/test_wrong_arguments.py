"""Every argument of every public function, given every wrong kind of value: one line that names the
argument, says what it must be and what it was.

The table is drawn from the signatures of what `jaxfil` offers. What the types of an argument allow
is left out, and all else must be refused before anything is compiled.
"""

import functools as ft
import inspect
import types
import typing
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.bifurcations.tangency import Conditions, Tangency
from jaxfil.orbits.shooting import ShootingOptions
from tests.project.test_docstrings import FUNCTIONS

BLOCK, FORCED = jf.systems.CoulombOscillator(), jf.systems.SDOscillator()
X0, ZERO = jnp.array([3.0, 0.0]), jnp.zeros(())

VALUES = {
    "None": None,
    "a word": "word",
    "a function": len,
    "a class": dict,
    "a list": [0.5, 0.75],
    "a list of words": ["left", "right"],
    "a ragged list": [[0.5], [0.5, 0.75]],
    "an empty tuple": (),
    "a dictionary": {"a": 1.0},
    "NaN": float("nan"),
    "infinity": float("inf"),
    "an integer": 3,
    "a negative number": -1,
    "zero": 0,
    "a fraction": 2.5,
    "a flag": True,
    "a complex number": 1j,
    "a matrix": np.ones((2, 3)),
    "a tensor": jnp.ones((2, 2, 2)),
    "an array of no numbers": jnp.zeros(0),
    "an array of integers": np.array([1, 2]),
    "an array of words": np.array(["left", "right"]),
    "complex numbers": jnp.array([1j, 2.0]),
    "NaN in an array": np.array([1.0, np.nan]),
    "an object": object(),
}
NUMBERS = {"an integer", "a negative number", "zero", "a fraction"}
VECTORS = {"a list", "an array of integers", "NaN in an array"}
ARRAYS = {"a matrix", "a tensor"}
# What each type that occurs in a signature allows: what the function itself may refuse or not.
ALLOWED: dict[object, set[str]] = {
    type(None): {"None"},
    bool: {"a flag"},
    int: {"an integer"},
    float: NUMBERS,
    jax.Array: NUMBERS | VECTORS,
    np.ndarray: NUMBERS | VECTORS,
    np.generic: NUMBERS,
    Callable: {"a function", "a class"},
    Sequence: VECTORS,
    tuple: set(),
    str: set(),
}
FOLLOWING = (
    "continue_orbit",
    "continue_bifurcation",
    "continue_equilibrium",
    "continue_equilibrium_bifurcation",
    "find_bifurcations",
)
# Arguments for which a type allows less, and more, than it says.
POSITIVE = {"dt", "width", "tolerance", "period", "interval", "max_step", "max_return", "sigma"}
POSITIVE |= {"transient_time"}
MORE = {
    ("load", "path"): {"a word"},
    ("bifurcation_diagram", "checkpoint"): {"a word"},
    # A pair of arrays.
    ("basins_of_attraction", "axes"): {"a ragged list", "a matrix"},
    # Batches.
    ("bifurcation_diagram", "x0"): ARRAYS,
    ("choose_step", "x0"): ARRAYS,
    ("poincare_map", "x0"): ARRAYS,
    ("clock", "period"): ARRAYS,
    ("clock", "phase"): ARRAYS,
    ("drive_response", "coupling"): ARRAYS,
    ("smoothed", "width"): ARRAYS,
    ("piecewise", "period"): ARRAYS | {"a negative number", "zero"},
    # Whole numbers of another range, and none at all.
    ("section", "direction"): {"a negative number", "zero"},
    ("solve", "sections"): {"an empty tuple"},
    ("basins_of_attraction", "transient"): {"None"},
    **{(verb, "stop"): {"a list", "an array of integers"} for verb in FOLLOWING},
}
# Of what may be anything, these are right.
ANYTHING = {
    ("fit", "ts"): VECTORS,
    ("fit", "data"): VECTORS,
    ("fit", "sigma"): NUMBERS | VECTORS | {"None"},
    ("fit", "guesses"): NUMBERS | VECTORS | {"None"},
    ("nearest_grazing", "metric"): {"None", "a list", "an array of integers"},
}


def an_orbit() -> jf.Orbit:
    """An orbit as `periodic_orbit` would give it, which costs nothing."""
    options = ShootingOptions(ZERO, 40, 1, jf.RK4(), 8, compact=True)
    return jf.Orbit(
        x0=X0,
        period=jnp.array(9.0),
        monodromy=jnp.eye(2),
        residual=ZERO,
        events=None,
        num_events=jnp.array(0),
        first_mode=jnp.ones(1, int),
        result=jf.RESULTS.successful,
        system=FORCED,
        starts=X0[None],
        num_steps=jnp.array(1),
        options=options,
    )


def a_bifurcation() -> jf.Bifurcation:
    """A bifurcation of it."""
    phases, mode, surface = [ZERO] * 4, jnp.ones(1), jnp.array(0)
    tangency = Tangency(X0[None], *phases, mode, surface, ZERO, jnp.array(False))
    return jf.Bifurcation(
        value=jnp.array(0.7),
        orbit=an_orbit(),
        t=ZERO,
        x=X0,
        code=jnp.array(0),
        conditions=Conditions(*[ZERO] * 6),
        residual=ZERO,
        result=jf.RESULTS.successful,
        tangency=tangency,
        parameter="omega",
        family="flight",
    )


def an_equilibrium() -> jf.Equilibrium:
    """An equilibrium as `equilibrium` would give it."""
    return jf.Equilibrium(
        x=jnp.zeros(2),
        mode=jnp.zeros(1, int),
        multipliers=jnp.zeros(1),
        residual=ZERO,
        num_steps=jnp.array(1),
        result=jf.RESULTS.successful,
        system=BLOCK,
        _affine=False,
    )


def same(t, x, side=1.0):
    return x


RUN = {"system": BLOCK, "x0": X0, "t0": 0.0, "t1": 1.0, "dt": 0.1}
FOLLOWED = {"system": FORCED, "parameter": "omega", "orbit": an_orbit(), "stop": 0.8}
# Arguments with which each function would run.
CALLS = {
    jf.Clock: {"period": 1.0},
    jf.Section: {"function": same},
    jf.RMS: {"function": same},
    jf.Maximum: {"function": same},
    jf.Minimum: {"function": same},
    jf.EventSum: {"function": same},
    jf.average: RUN | {"function": same},
    jf.basins_of_attraction: {"system": FORCED, "axes": ([0.0], [0.0])},
    jf.bifurcation_diagram: {"system": FORCED, "parameter": "omega", "values": [0.7], "x0": X0},
    jf.bound: {"function": same},
    jf.choose_step: {k: RUN[k] for k in ("system", "x0", "t0", "t1")},
    jf.continue_bifurcation: {
        "system": FORCED,
        "parameters": ("omega", "f0"),
        "bifurcation": a_bifurcation(),
        "stop": 0.8,
    },
    jf.continue_equilibrium: {
        "system": BLOCK,
        "parameter": "friction",
        "equilibrium": an_equilibrium(),
        "stop": 0.5,
    },
    jf.continue_equilibrium_bifurcation: {
        "system": jf.systems.BouncingBall(),
        "parameters": ("g", "restitution"),
        "bifurcation": jf.EquilibriumBifurcation(
            "fold", 0.5, an_equilibrium(), index=1, before=(0,), after=(0,)
        ),
        "stop": 0.5,
    },
    jf.continue_orbit: FOLLOWED,
    jf.drive_response: {"system": BLOCK, "coupling": 0.1},
    jf.equilibrium: {"system": BLOCK, "guess": X0},
    jf.find_bifurcation: FOLLOWED | {"stop": ..., "kind": "grazing"},
    jf.find_bifurcations: FOLLOWED,
    jf.fit: {
        "system": BLOCK,
        "parameters": ("friction",),
        "ts": [0.5],
        "data": np.ones((1, 2)),
        "x0": X0,
        "dt": 0.1,
    },
    jf.grazing_margin: {"system": FORCED, "orbit": an_orbit()},
    jf.harmonic_balance: {"system": FORCED, "guess": np.ones((3, 2)), "harmonics": 1},
    jf.load: {"path": "nowhere.npz"},
    jf.lyapunov_spectrum: {"system": FORCED, "x0": X0},
    jf.maxima: {"function": same},
    jf.minima: {"function": same},
    jf.nearest_grazing: {"system": FORCED, "parameters": ("omega",), "orbit": an_orbit()},
    jf.periodic_orbit: {"system": FORCED, "x0": X0},
    jf.piecewise: {"f_plus": same, "f_minus": same, "switching": same},
    jf.poincare_map: {
        "system": BLOCK,
        "x0": X0,
        "section": jf.Section(lambda t, x: x[0]),
        "dt": 0.1,
        "max_time": 9.0,
    },
    jf.settled_average: {"system": FORCED, "average": same, "x0": X0},
    jf.smoothed: {"system": BLOCK, "width": 0.1},
    jf.solve: RUN,
    jf.synchronization_exponent: {"system": FORCED, "x0": X0, "couplings": [0.1]},
    jf.tangency_points: {"system": BLOCK, "limits": ((-1.0, 1.0), (-1.0, 1.0))},
    jf.transverse_exponent: {"system": FORCED, "x0": X0},
    jf.work_precision: {
        "system": BLOCK,
        "x0": X0,
        "t1": 1.0,
        "steppers": [jf.RK4()],
        "dts": [0.1],
    },
}


def members(annotation: object) -> set[object]:
    """The types that an annotation is a union of."""
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        return set().union(*map(members, typing.get_args(annotation)))
    # Of jaxtyping's the arrays that they are of.
    kind = getattr(annotation, "array_type", typing.get_origin(annotation) or annotation)
    return {kind}


def allowed(call: Callable, parameter: inspect.Parameter) -> set[str]:
    """The names of those values that an argument may have."""
    place, kinds = (call.__name__.lower(), parameter.name), members(parameter.annotation)
    if typing.Any in kinds:
        return ANYTHING[place]
    found = set().union(*(ALLOWED.get(kind, set()) for kind in kinds))
    if parameter.name in POSITIVE:
        found -= {"a negative number", "zero"}
    return found | MORE.get(place, set()) | ({"zero"} if parameter.name == "transient" else set())


def arguments(call: Callable) -> list[inspect.Parameter]:
    """Those that a value can be given for; of **options the names are those of another function."""
    every = inspect.signature(call).parameters.values()
    return [p for p in every if p.kind is not inspect.Parameter.VAR_KEYWORD]


TABLE = [(call, parameter) for call in CALLS for parameter in arguments(call)]


# Of static fields, before they are looked at.
@pytest.mark.filterwarnings("ignore:A JAX array is being set as static")
@pytest.mark.parametrize(
    ("call", "parameter"), TABLE, ids=[f"{c.__name__}-{p.name}" for c, p in TABLE]
)
def test_every_wrong_kind_of_value_is_named(call, parameter):
    given = {k: v for k, v in CALLS[call].items() if v is not ...}
    right, opaque = allowed(call, parameter), []
    for what, value in VALUES.items():
        if what not in right:
            told = refusal(ft.partial(call, **given | {parameter.name: value}))
            if not is_one_line(told, parameter.name):
                opaque.append(f"{what}: {told}")
    assert opaque == []


def refusal(call: Callable) -> str:
    """What a call says that is refused."""
    try:
        call()
    except Exception as error:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        return f"{kind}{error}"
    return "not refused"


def is_one_line(told: str, name: str) -> bool:
    """Whether a refusal is a line that begins with the argument."""
    begins = told.startswith((f"`{name}`", f"`{name}[", f"`{name}."))
    return begins and " must " in told and " got " in told and len(told.splitlines()) == 1


def test_every_public_function_is_in_the_table():
    public = {v for name, v in FUNCTIONS.items() if name.count(".") == 1}
    assert public - {*CALLS} == set()
