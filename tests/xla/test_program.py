"""Functions of programs give what the programs' own functions give, and are not traced for it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from jaxfil.xla.program import call_of, opened, operations

X = jnp.asarray([0.3, 0.7])


def sine(x, k):
    return jnp.sin(x) * k, k + 1


@pytest.mark.parametrize("whole", [call_of, operations])
def test_a_program_is_its_function_under_all_transformations(whole):
    program, values, _ = opened(sine, (X[0], 2))
    run = whole(program)

    def ran(x, k):
        return tuple(run(x, k))

    def swung(f):
        return lambda x: jax.jvp(lambda x: f(x, 2)[0], (x,), (x,))

    assert_array_equal(ran(*values), sine(*values))
    assert_array_equal(jax.jit(ran)(*values), sine(*values))
    assert_array_equal(jax.vmap(ran, (0, None))(X, 2)[0], sine(X, 2)[0])
    assert_array_equal(jax.vmap(swung(ran))(X), jax.vmap(swung(sine))(X))
    assert_array_equal(jax.grad(lambda x: ran(x, 2)[0])(X[0]), 2 * jnp.cos(X[0]))
    with jax.disable_jit():
        assert_array_equal(ran(*values), sine(*values))


def test_a_call_is_one_operation_that_holds_the_program_itself():
    program, values, _ = opened(sine, (X[0], 2))
    (call,) = jax.make_jaxpr(call_of(program))(*values).eqns
    assert call.params["jaxpr"] is program
    assert [v.aval.dtype for v in call.outvars] == [np.float64, values[1].dtype]


def test_what_nobody_needs_is_in_no_program():
    pair = jax.jit(lambda x: (jnp.sin(x), jnp.exp(x)))

    def function(x):
        def body(s):
            jnp.cosh(s[1])
            return s[0] + 1, s[1] + pair(s[1])[0]

        jnp.tan(x)
        return pair(jax.lax.while_loop(lambda s: s[0] < 2, body, (0, x))[1])[0]

    program, values, _ = opened(function, (X[0],))
    for name, kept in {"sin": True, "exp": False, "cosh": False, "tan": False}.items():
        assert (f" {name} " in str(program)) == kept, name
    assert_array_equal(operations(program)(*values), [function(X[0])])


def test_what_calls_share_they_share_in_a_program_without_what_nobody_needs():
    pair = jax.jit(lambda x: (jnp.sin(x), jnp.exp(x)))
    program, _, _ = opened(lambda x: pair(pair(x)[0])[0], (X[0],))
    first, second = (eqn.params["jaxpr"] for eqn in program.eqns)
    assert first is second


def test_known_numbers_are_written_into_a_program_and_others_are_its_arguments():
    scale, shift = jnp.asarray(3.0), jnp.asarray([1.0, 2.0])

    def function(x):
        return x * scale + shift

    program, values, _ = opened(function, (X,))
    assert [v.shape for v in values] == [(2,), (2,)]
    assert_array_equal(operations(program)(*values), [function(X)])

    def moved(scale):
        program, values, _ = opened(lambda x: x * scale, (X,))
        assert len(values) == 2
        return operations(program)(*values)[0]

    assert_array_equal(jax.vmap(moved)(X), X[:, None] * X)
    assert_array_equal(opened(lambda: scale, ())[1], [])
