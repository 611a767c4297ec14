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
