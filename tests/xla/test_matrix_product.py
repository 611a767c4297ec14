"""Products of matrices made of sums, in a kernel, against NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxfil.xla import fits
from jaxfil.xla.kernel import kernel_if_it_fits
from jaxfil.xla.matrix_product import by_sums
from tests.xla.operations import names

# Axes of both operands in the notation of `einsum`, and their lengths: short sums, loops over
# columns, of which some cannot be divided, and products that are long without any sum.
PRODUCTS = [
    ("ij,j->i", dict(i=4, j=4)),
    ("ij,j->i", dict(i=64, j=64)),
    ("ij,j->i", dict(i=200, j=200)),
    ("ji,j->i", dict(i=90, j=67)),
    ("j,j->", dict(j=5000)),
    ("ij,jk->ik", dict(i=32, j=32, k=32)),
    ("ij,kj->ik", dict(i=70, j=9, k=70)),
    ("bij,bj->bi", dict(b=3, i=40, j=40)),
    ("ijk,kjl->il", dict(i=6, j=11, k=12, l=7)),
]


def operands(axes, sizes, dtype=float):
    rng = np.random.default_rng(0)
    names = axes.partition("->")[0].split(",")
    return [rng.normal(size=[sizes[c] for c in name]).astype(dtype) for name in names]


@pytest.mark.parametrize(("axes", "sizes"), PRODUCTS)
def test_a_kernel_holds_products(axes, sizes):
    if not fits.makes_whole_kernels():
        pytest.skip("this compiler makes no kernels of loops")

    def product(a, b):
        turn = lambda s: (s[0] + 1, s[1] + jnp.einsum(axes, a, b))  # noqa: E731
        zero = jax.eval_shape(lambda a, b: jnp.einsum(axes, a, b), a, b)
        return jax.lax.while_loop(lambda s: s[0] < 2, turn, (0, jnp.zeros(zero.shape)))[1]

    a, b = operands(axes, sizes)
    program = jax.jit(kernel_if_it_fits(product)).lower(a, b).compile()
    text = program.as_text()
    assert text is not None and " while(" not in text[text.index("ENTRY") :]
    got = program(a, b)
    # Of sums in another order.
    assert_allclose(got, 2 * np.einsum(axes, a, b), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("axes", "sizes"), PRODUCTS)
def test_no_call_of_a_library_is_left(axes, sizes):
    a, b = operands(axes, sizes)
    loop = lambda a, b: jax.lax.fori_loop(  # noqa: E731
        0, 2, lambda _, s: s + jnp.sum(jnp.einsum(axes, a, b)), 0.0
    )
    program = jax.make_jaxpr(loop)(a, b)
    assert "dot_general" in set(names(program.jaxpr))
    assert "dot_general" not in set(names(by_sums(program).jaxpr))


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (jnp.ones((300, 300)), jnp.ones(300)),  # too large
        (jnp.ones((4, 4), int), jnp.ones(4, int)),  # of whole numbers
        (jnp.ones((4, 4), complex), jnp.ones(4, complex)),
    ],
)
def test_other_products_fit_into_no_kernel(a, b):
    assert not fits.fits(jax.make_jaxpr(jnp.matmul)(a, b).jaxpr)
