"""`select` against `jnp.where`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfil.xla.select import select
from tests.xla.operations import names

ONE, TWO = jnp.float64(1.0), jnp.float64(2.0)
ROW, OTHER = jnp.arange(3.0), jnp.ones(3)
FLAG, FLAGS = jnp.bool_(True), jnp.array([True, False, True])

CASES = {
    "numbers": (FLAG, ONE, TWO),
    "a literal": (~FLAG, ONE, 0),
    "a literal first": (FLAG, 2.5, ONE),
    "arrays by one flag": (~FLAG, ROW, OTHER),
    "arrays by flags": (FLAGS, ROW, OTHER),
    "arrays and a literal": (FLAGS, ROW, -1),
    "numbers by flags": (FLAGS, ONE, TWO),
    "an array and a number": (FLAG, ROW, ONE),
    "literals": (FLAG, 1.0, -1.0),
    "flags": (FLAG, FLAGS, False),
    "integers": (FLAG, jnp.int32(3), 0),
    "single precision": (FLAG, jnp.float32(3), 0.5),
    "of numpy": (np.array([True, False, True]), ROW, np.float64(2.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_it_is_where(case):
    flag, yes, no = CASES[case]
    got, want = (jax.jit(lambda f=f: f(flag, yes, no))() for f in (select, jnp.where))
    assert (got.shape, got.dtype) == (want.shape, want.dtype)
    np.testing.assert_array_equal(got, want)
    np.testing.assert_array_equal(select(flag, yes, no), want)


def test_what_a_type_cannot_hold_is_promoted_as_ever():
    with jax.numpy_dtype_promotion("standard"):
        assert select(FLAG, 0.5, jnp.int32(3)) == 0.5
        assert select(FLAG, 2, FLAG) == 2


def test_its_derivatives_and_batches():
    def function(f, x):
        return f(x > 1, x * x, 0.0) + f(x[0] > 0, x, 3)

    for change in (jax.jacfwd, jax.jacrev, jax.vmap):
        x = jnp.stack([ROW, -ROW]) if change is jax.vmap else ROW
        got, want = (change(lambda x, f=f: function(f, x))(x) for f in (select, jnp.where))
        np.testing.assert_array_equal(got, want)


def test_it_is_one_operation():
    def program(flag, x):
        return select(flag, select(flag, x, 0), 1.0)

    assert list(names(jax.make_jaxpr(program)(FLAG, ONE).jaxpr)) == ["select_n", "select_n"]
