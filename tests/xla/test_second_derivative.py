"""Second derivatives added where a first one has none, in every order of modes."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from jaxfil.xla.second_derivative import add_second_derivative

POINT = jnp.array([2.0, 3.0])


def vanishing(x, y, whole):
    """Zero at `POINT`, and so are its first derivatives."""
    return (x - 2) ** 2 * y + jnp.sin(x - 2) * (y - 3)


def added(z):
    return add_second_derivative(vanishing, z[0] * z[1] ** 2, z[0], z[1], jnp.int32(5))


def written_out(z):
    return z[0] * z[1] ** 2 + vanishing(z[0], z[1], 5)


forward, reverse = jax.jacfwd, jax.jacrev


@pytest.mark.slow
@pytest.mark.parametrize("outer", [forward, reverse])
@pytest.mark.parametrize("inner", [forward, reverse])
def test_it_is_there_in_every_order_of_modes(outer, inner):
    want = jax.hessian(written_out)(POINT)
    hessian = outer(inner(added))
    assert_allclose(hessian(POINT), want, rtol=1e-15)
    batch = jax.jit(jax.vmap(hessian))(jnp.stack([POINT, POINT]))
    assert_allclose(batch, jnp.stack([want, want]), rtol=1e-15)


@pytest.mark.parametrize("inner", [forward, reverse])
def test_a_first_derivative_has_nothing_of_it(inner):
    def operations(function):
        program = jax.jit(inner(function)).lower(POINT).compile().as_text()
        return sum(program.count(f" {name}(") for name in ("add", "multiply", "sine", "cosine"))

    assert_allclose(inner(added)(POINT), inner(written_out)(POINT), rtol=1e-15)
    assert operations(added) == operations(lambda z: z[0] * z[1] ** 2)


def test_a_third_derivative_is_refused_by_name():
    with pytest.raises(NotImplementedError, match="Third derivatives through contacts"):
        forward(forward(forward(added)))(POINT)
    with pytest.raises(NotImplementedError, match="Third derivatives through contacts"):
        forward(jax.hessian(added))(POINT)
