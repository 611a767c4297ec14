"""Functions whose numbers are moved by slices, against themselves."""

import jax
import jax.extend.core as jexc
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxfil.xla import fits
from jaxfil.xla.moves import by_slices, taken
from jaxfil.xla.trace import Traced
from tests.xla.operations import names

X, V = jnp.array([1.0, -2.0, 3.5, 4.0]), jnp.array(2.0)
TWICE = jnp.array([2, 0, 2])

MOVED = {
    "add to the first": lambda x, v: x.at[0].add(v),
    "add to the last": lambda x, v: x.at[-1].add(v),
    "add to some": lambda x, v: x.at[jnp.array([0, -1])].add(v * x[:2]),
    "add to one twice": lambda x, v: x.at[TWICE].add(v * x[:3]),
    "add to a part": lambda x, v: x.at[1:].add(v * x[1:]),
    "set one": lambda x, v: x.at[2].set(v),
    "set a part": lambda x, v: x.at[1:3].set(v),
    "set every other": lambda x, v: x.at[::2].set(v),
    "set some": lambda x, v: x.at[np.array([3, 0])].set(v * x[1:3]),
    "set a row": lambda x, v: jnp.outer(x, x).at[1].set(v * x),
    "add to a column": lambda x, v: jnp.outer(x, x).at[:, 2].add(v * x),
    "set two of a matrix": lambda x, v: jnp.outer(x, x).at[[0, 2], [1, 3]].set(v),
    "a triangle": lambda x, v: jnp.zeros((2, 2)).at[np.tril_indices(2)].set(v * x[:3]),
    "many": lambda x, v: jnp.zeros(300).at[::3].set(v) * jnp.tile(x, 75),
    "subtract from one": lambda x, v: x.at[1].subtract(v),
    "multiply one": lambda x, v: x.at[1].mul(-v),
    "divide one": lambda x, v: x.at[-1].divide(v),
    "raise some": lambda x, v: jnp.abs(x).at[:2].power(v),
    "at least": lambda x, v: x.at[:3].max(v),
    "at most": lambda x, v: x.at[jnp.array([3, 1])].min(v),
    "add to an unknown one": lambda x, v: x.at[jnp.argmax(x)].add(v),
    "count at an unknown one": lambda x, v: (
        v * jnp.zeros(4, jnp.int32).at[jnp.argmax(x)].add(1).astype(float)
    ),
    "set a place outside": lambda x, v: x.at[7].set(v),
    "set an unknown one": lambda x, v: x.at[jnp.argmin(x)].set(v),
    "multiply an unknown row": lambda x, v: jnp.outer(x, x).at[jnp.argmin(x)].mul(v),
    "set an unknown place outside": lambda x, v: x.at[jnp.argmax(x) + 2].set(v),
    "set the last unknown one": lambda x, v: x.at[-jnp.argmax(x)].set(v),
    "take some": lambda x, v: v * x[jnp.array([1, 0, -1])],
    "take columns": lambda x, v: v * jnp.outer(x, x)[:, jnp.array([3, 1])],
    "take two of a matrix": lambda x, v: v * jnp.outer(x, x)[jnp.array([0, 2]), jnp.array([1, 3])],
    "split": lambda x, v: jnp.stack(jnp.split(v * x, 2)),
    "split columns": lambda x, v: jnp.hstack(jnp.split(v * jnp.outer(x, x), [1], axis=1)[::-1]),
    "unstack columns": lambda x, v: jnp.stack(jnp.unstack(v * jnp.outer(x, x), axis=1)[::-1]),
    "sum up": lambda x, v: jnp.cumsum(v * x),
    "sum up rows from the end": lambda x, v: jax.lax.cumsum(v * jnp.outer(x, x), 0, reverse=True),
}
LEFT = {
    "two unknown places": lambda x, v: x.at[jnp.argsort(x)[:2]].add(v),
    "an unknown place of many": lambda x, v: jnp.outer(jnp.tile(x, 8), x).at[jnp.argmax(x)].add(v),
    "an unknown place at a border": lambda x, v: x.at[jnp.argmax(x) + 2].set(v, mode="clip"),
    "one place set twice": lambda x, v: x.at[TWICE].set(v),
}


def program(function):
    return by_slices(jax.make_jaxpr(function)(X, V))


@pytest.mark.slow
@pytest.mark.parametrize("name", [*MOVED, *LEFT])
def test_numbers_and_derivatives_are_the_same(name):
    function = {**MOVED, **LEFT}[name]
    made = program(function)

    def moved(x, v):
        return jexc.jaxpr_as_fun(made)(x, v)[0]

    # Sums are made in another order.
    assert_allclose(moved(X, V), function(X, V), rtol=4 * float(jnp.finfo(X.dtype).eps))
    if "sum up" not in name:
        assert_array_equal(moved(X, V), function(X, V))
    for differentiate in (jax.jacfwd, jax.jacrev):
        got, want = (differentiate(f, (0, 1))(X, V) for f in (moved, function))
        for a, b in zip(got, want, strict=True):
            assert_allclose(a, b, rtol=1e-14)


@pytest.mark.parametrize("name", MOVED)
def test_nothing_is_left_that_a_kernel_does_not_hold(name):
    found = {eqn.primitive.name for eqn in program(MOVED[name]).jaxpr.eqns}
    left = {"split", "unstack", "cumsum", "gather"}
    assert not any("scatter" in name for name in found), found
    assert found.isdisjoint(left - {"gather"} if name == "many" else left), found & left


@pytest.mark.parametrize(
    "apply",
    [
        lambda x, v: x.at[TWICE].mul(v * x[:3]),
        lambda x, v: v * x.at[1].apply(jnp.negative),
        lambda x, v: v * x.at[jnp.array([3, 0])].apply(jnp.square),
        lambda x, v: v * jnp.outer(x, x).at[:, 1].apply(lambda y: 0.5 * y),
        lambda x, v: v * x.at[jnp.argmax(x)].apply(jnp.square),
    ],
)
def test_what_jax_has_no_derivatives_of(apply):
    assert_array_equal(jexc.jaxpr_as_fun(program(apply))(X, V)[0], apply(X, V))


def test_a_function_is_applied_where_it_has_a_derivative():
    """It has none at the other numbers, neither if its place is known, nor if not."""
    for k in (1, jnp.argmin(X)):
        made = program(lambda x, v, k=k: v * jnp.abs(x).at[k].apply(lambda y: jnp.sqrt(y - 1.5)))
        found = jax.jacrev(lambda x, p=made: jexc.jaxpr_as_fun(p)(x, V)[0])(X)
        assert_allclose(found, 2 * jnp.diag(jnp.array([1, -0.5 / jnp.sqrt(0.5), 1, 1])), rtol=1e-15)


def test_a_function_applied_to_numbers_is_not_linear():
    many = jnp.zeros(100)

    def field(t, x, side):
        moved = (side * many).at[jnp.argmax(jnp.stack(x))].apply(jnp.cos)
        return tuple(moved[:4])

    assert not Traced(field, V, tuple(X), V).is_affine(False, (False,) * 4, True)


@pytest.mark.parametrize("name", LEFT)
def test_what_is_not_known_is_left(name):
    assert any("scatter" in eqn.primitive.name for eqn in program(LEFT[name]).jaxpr.eqns)


def test_a_program_without_moves_is_the_same_one():
    written = jax.make_jaxpr(lambda x: x[1:] - x[:-1])(X)
    assert by_slices(written) is written


def friction(t, x, side):
    """A chain's field, as one writes it with JAX."""
    q, v = jnp.split(jnp.stack(x), 2)
    ends = jnp.pad(q, 1)
    pull = (ends[2:] - 2 * q + ends[:-2]).at[0].add(jnp.cos(t)).at[1].add(-side)
    return tuple(jnp.concatenate([v, pull]))


@pytest.mark.parametrize("fast", [True, False])
def test_a_field_with_a_force_on_one_mass_fits_into_a_kernel(fast):
    if not fits.makes_whole_kernels():
        pytest.skip("this compiler makes no kernels of loops")
    traced = Traced(friction, V, tuple(X), V, fast=fast)
    assert fits.fits(jax.make_jaxpr(traced)(V, tuple(X), V).jaxpr)
    assert_allclose(traced(V, tuple(X), V), friction(V, tuple(X), V), rtol=1e-15)


def test_a_force_on_one_mass_is_known_to_be_on_that_one():
    traced = Traced(friction, V, tuple(X), V)
    assert traced.depends(False, (False,) * 4, True) == (False, False, False, True)
    assert traced.is_affine(False, (True,) * 4, True)


@pytest.mark.parametrize("places", [[0, 1, 2, 3], [2, 3, 0], [[1], [3]], [0] * 40, [1, 1, 2]])
def test_numbers_at_known_places_are_taken_by_slices(places):
    places, row = np.array(places), jnp.arange(4.0) ** 2
    assert_allclose(taken(row, places), row[places], rtol=0)
    assert_allclose(jax.jacfwd(lambda v: taken(v, places))(row), np.eye(4)[places], rtol=0)
    found = set(names(jax.make_jaxpr(lambda v: taken(v, places))(row).jaxpr))
    assert ("gather" in found) == (places.size == 40)
