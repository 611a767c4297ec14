"""Programs of functions, and functions of programs.

A program is closed: values that the function closes over are arguments. It can be run as a
function, operation by operation or as a single call, interpreted, and stripped of unused
operations.
"""

import functools as ft
from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import jax.core
import jax.extend.core as jexc
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval as pe

from jaxfil.xla.known import is_known


def opened(function: Callable, args: tuple) -> tuple[Any, list, Any]:
    """The program of a function, with the values that it closes over as arguments; the values of
    all arguments; and the tree structure of the results."""
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    # A constant array would be written out in a kernel's code, and a tracer in the closure would be
    # mistaken for one lane's number in a batch, so both become arguments.
    jaxpr, consts = _with_known_numbers(closed)
    whole = jaxpr.replace(constvars=(), invars=[*jaxpr.constvars, *jaxpr.invars])
    values = [*map(jnp.asarray, (*consts, *jax.tree.leaves(args)))]
    return pruned(jexc.ClosedJaxpr(whole, ())), values, jax.tree.structure(shapes)


def _with_known_numbers(closed: Any) -> tuple[Any, list]:
    """A program in which known scalars of its closure are literals, and the remaining values of its
    closure. Known scalars belong, for example, to a system that is constant under a user's
    `jax.jit`."""
    jaxpr, known, rest = closed.jaxpr, {}, []
    for var, value in zip(jaxpr.constvars, closed.consts, strict=True):
        if np.ndim(value) == 0 and is_known(value):
            known[var] = jexc.Literal(np.asarray(value), var.aval)
        else:
            rest.append((var, value))

    def put(atoms: Sequence[Any]) -> list:
        return [v if isinstance(v, jexc.Literal) else known.get(v, v) for v in atoms]

    equations = [eqn.replace(invars=put(eqn.invars)) for eqn in jaxpr.eqns] if known else jaxpr.eqns
    jaxpr = jaxpr.replace(
        constvars=[var for var, _ in rest], eqns=equations, outvars=put(jaxpr.outvars)
    )
    return jaxpr, [value for _, value in rest]


def with_traced_values(program: Any) -> tuple[Any, tuple]:
    """A program whose closure has known values alone, and those that are traced, which are its
    first arguments. A rule for derivatives that evaluates the program later would otherwise see
    traced values of an outer transformation, and miss their tangents."""
    pairs = list(zip(program.jaxpr.constvars, program.consts, strict=True))
    moved = [(var, value) for var, value in pairs if not is_known(value)]
    if not moved:
        return program, ()
    kept = [(var, value) for var, value in pairs if is_known(value)]
    first = [var for var, _ in moved]
    jaxpr = program.jaxpr.replace(
        constvars=[var for var, _ in kept],
        invars=[*first, *program.jaxpr.invars],
    )
    return jexc.ClosedJaxpr(jaxpr, [value for _, value in kept]), tuple(v for _, v in moved)


def pruned(program: Any) -> Any:
    """The same program without operations whose results are unused, such as tangents of values
    whose derivative is zero by structure. XLA would remove them too, but only after they have been
    lowered."""
    return _pruned(program, {})


def _pruned(program: Any, done: dict[int, tuple]) -> Any:
    """`pruned`, given the programs already pruned, by identity, so that programs shared by several
    calls remain shared."""
    if id(program) in done:
        return done[id(program)][1]
    every = [True] * len(program.out_avals)
    # Unused arguments remain (`instantiate`), since callers pass all of them.
    jaxpr, _ = pe.dce_jaxpr(program.jaxpr, every, instantiate=True)
    # JAX has no pruning rule for the bodies of loops, so they are pruned here.
    equations = [_with_programs(eqn, lambda v: _pruned(v, done)) for eqn in jaxpr.eqns]
    out = jexc.ClosedJaxpr(jaxpr.replace(eqns=equations), program.consts)
    # The program is stored too, since the identity of a deleted one could be used again.
    done[id(program)] = program, out
    return out


def _with_programs(eqn: Any, change: Callable) -> Any:
    """An operation with its inner programs changed."""

    def changed(value: Any) -> Any:
        if _is_program(value):
            return change(value)
        # The operation of `jax.checkpoint` has a program that is not closed.
        return change(closed(value)).jaxpr if isinstance(value, jexc.Jaxpr) else value

    found = {
        name: jax.tree.map(changed, value)
        for name, value in eqn.params.items()
        if isinstance(value, (jexc.ClosedJaxpr, jexc.Jaxpr))
        or (isinstance(value, tuple) and any(map(_is_program, value)))
    }
    return eqn.replace(params={**eqn.params, **found}) if found else eqn


def programs(params: Any) -> list:
    """The programs inside an operation, such as the body of a loop or the branches of a
    conditional."""
    leaves = jax.tree.leaves(params, is_leaf=lambda v: hasattr(v, "eqns"))
    return [v for v in leaves if hasattr(v, "eqns")]


def _is_program(value: Any) -> bool:
    return isinstance(value, jexc.ClosedJaxpr)


def closed(program: Any) -> Any:
    """An inner program, closed if it is not."""
    return program if _is_program(program) else jexc.ClosedJaxpr(program, ())


def replaced(program: Any, name: str, rule: Callable) -> Any:
    """The same program with each operation `name`, including those in loops and conditionals,
    replaced by the single result of `rule(eqn, *operands)`."""
    return _replaced(program, name, rule, {}) if holds(program.jaxpr, (name,)) else program


def replaced_inside(eqn: Any, name: str, rule: Callable) -> Any:
    """The same operation with `name` replaced in the programs inside it, as in `replaced`."""
    return _with_programs(eqn, lambda program: replaced(program, name, rule))


def holds(jaxpr: Any, names: Collection[str]) -> bool:
    """Whether a program has one of some operations, also in the programs inside it."""
    return any(
        eqn.primitive.name in names or any(holds(inner, names) for inner in programs(eqn.params))
        for eqn in jaxpr.eqns
    )


def _replaced(program: Any, name: str, rule: Callable, done: dict[int, tuple]) -> Any:
    """`replaced`, given the programs already done, by identity."""
    if id(program) in done:
        return done[id(program)][1]
    equations = []
    for eqn in program.jaxpr.eqns:
        if eqn.primitive.name == name:
            # The replacement may have the same operation in it.
            call = _call(ft.partial(rule, eqn), [v.aval for v in eqn.invars])
            equations.append(call.replace(invars=eqn.invars, outvars=eqn.outvars))
        else:
            equations.append(_with_programs(eqn, lambda v: _replaced(v, name, rule, done)))
    out = jexc.ClosedJaxpr(program.jaxpr.replace(eqns=equations), program.consts)
    done[id(program)] = program, out
    return out


def _call(function: Callable, shapes: Sequence[Any]) -> Any:
    """The operation that calls a function."""
    # Wrapped, since JAX asks a function for its name, which `function` may lack.
    with jax.disable_jit(False):
        shown = jax.make_jaxpr(jax.jit(lambda *values: function(*values)))(*shapes)
    (call,) = shown.eqns
    return call


_CALLS = ("jit", "pjit", "closed_call")


def names(jaxpr: Any) -> set[str]:
    """The names of a program's operations, including those in the functions it calls."""
    inner = [eqn.params["jaxpr"].jaxpr for eqn in jaxpr.eqns if eqn.primitive.name in _CALLS]
    return {eqn.primitive.name for eqn in jaxpr.eqns}.union(*map(names, inner))


def interpreted(
    program: Any,
    args: Sequence[Any],
    of_known: Callable,
    rule: Callable,
    show: Callable | None = None,
) -> list[Any]:
    """Abstract values of the results of a program, operation by operation, including the functions
    that it calls. `rule(jaxpr, eqn, inputs)` evaluates an operation, and `of_known(value)` converts
    constants and literals. Operations without a result, such as `jax.debug.print`, are skipped,
    unless there is a function `show` for them, with the same arguments as `rule`."""
    jaxpr = program.jaxpr
    values = dict(zip(jaxpr.constvars, map(of_known, program.consts), strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))

    def read(atom: Any) -> Any:
        return of_known(atom.val) if isinstance(atom, jexc.Literal) else values[atom]

    for eqn in jaxpr.eqns:
        inputs = [read(v) for v in eqn.invars]
        if eqn.primitive.name in _CALLS:
            outputs = interpreted(eqn.params["jaxpr"], inputs, of_known, rule, show)
        elif eqn.outvars:
            outputs = rule(jaxpr, eqn, inputs)
        else:
            outputs = show(jaxpr, eqn, inputs) if show else []
        values.update(zip(eqn.outvars, outputs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def evaluate_one(jaxpr: Any, eqn: Any, inputs: Sequence[Any]) -> list[Any]:
    """One equation of a program as it stands."""
    pairs = zip(eqn.invars, inputs, strict=True)
    free = [(v, x) for v, x in pairs if not isinstance(v, jexc.Literal)]
    single = jaxpr.replace(
        constvars=(), invars=[v for v, _ in free], outvars=eqn.outvars, eqns=[eqn]
    )
    return jax.core.eval_jaxpr(single, (), *(x for _, x in free))


def operations(program: Any) -> Callable:
    """A closed program as a function, which applies its operations."""
    run = jexc.jaxpr_as_fun(program)

    # Wrapped, since JAX asks a function that it transforms for its name; without one it prints the
    # whole program.
    def apply_operations(*values: Any) -> list:
        return run(*values)

    return apply_operations


def call_of(program: Any) -> Callable:
    """A closed program as one operation, a call of a function under `jax.jit`, which is not traced
    again."""

    def same_numbers(*_: Any) -> list:
        return [jnp.zeros(())] * len(program.out_avals)

    # The call of a dummy function with as many arguments and results has all parameters that this
    # version of JAX needs; only its program is then replaced.
    call = _call(same_numbers, program.in_avals)
    params = {**call.params, "name": "program", "jaxpr": program}
    return lambda *values: call.primitive.bind(*values, **params)
