"""Errors at run time: under `vmap` and derivatives the sentence alone, under `jit` the sentence
before what JAX says of it."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import code, outcomes, raise_if_failed, raise_outcome

RESULTS = jf.RESULTS
STALLED = RESULTS.newton_stalled
LAST = getattr(RESULTS, [*RESULTS._name_to_item][-1])


def checked(x):
    """x, or an error: of numbers below 0 a stalled search, of those above 1 the last outcome."""
    result = RESULTS.where(x < 0, STALLED, RESULTS.successful)
    return raise_if_failed(x, RESULTS.where(x > 1, LAST, result))


@pytest.mark.parametrize(
    ("call", "x"),
    [
        (checked, -1.0),
        (jax.grad(checked), -1.0),
        (jax.vmap(checked), [0.5, -1.0]),
        (jax.vmap(jax.value_and_grad(checked)), [0.5, -1.0]),
        (jax.jacrev(jax.vmap(checked)), [0.5, -1.0]),
    ],
)
def test_where_flags_are_known_it_is_the_sentence_alone(call, x):
    x = jnp.array(x)
    with pytest.raises(eqx.EquinoxRuntimeError) as caught:
        call(x)
    assert str(caught.value) == RESULTS[STALLED]


@pytest.mark.parametrize("jit", [jax.jit, eqx.filter_jit])
def test_under_jit_the_sentence_is_logged_first(jit, caplog):
    with pytest.raises(RuntimeError, match="cannot reduce the residual"):
        jax.block_until_ready(jit(jax.vmap(checked))(jnp.array([0.5, -1.0])))
    assert caplog.messages == [RESULTS[STALLED]]


def test_what_others_raise_in_a_callback_is_logged_as_it_was(caplog):
    def fail(x):
        raise KeyError("theirs")

    with pytest.raises(jax.errors.JaxRuntimeError):
        jax.jit(lambda x: jax.pure_callback(fail, x, x))(1.0).block_until_ready()
    assert RESULTS[STALLED] not in caplog.text


def test_of_a_batch_the_last_member_is_told_and_a_good_one_never():
    with pytest.raises(eqx.EquinoxRuntimeError, match=re.escape(RESULTS[LAST])):
        jax.vmap(checked)(jnp.array([-1.0, 2.0]))
    good = outcomes(jnp.array([code(RESULTS.section_reached), code(RESULTS.successful)]))
    assert raise_outcome(1.0, good, RESULTS.successful, RESULTS.section_reached) == 1.0
    assert jax.vmap(checked)(jnp.zeros(0)).shape == (0,)
