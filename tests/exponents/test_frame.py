"""Frames, of a few numbers and of many, against NumPy's QR factorisation and exact exponents."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil.exponents.frame import generic_frame, gram_schmidt
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.lowered import build
from tests.exponents.test_lyapunov import ONCE, Linear, MovingTable, rows_of
from tests.integrate.system.test_large_state import MORE, Padded, wide

FEW, MANY = 4, 20


def orthonormalised(vectors, dropped=False, projected=False):
    """The frame and the logarithms that `gram_schmidt` finds for the rows of a matrix."""
    n = len(vectors)
    system = build(Linear(jnp.eye(n)), jnp.ones(n), compact=False)
    frame, given = jnp.asarray(vectors), map(jnp.asarray, (dropped, projected))
    if isinstance(generic_frame(system), tuple):
        frame = tuple(system.constant(row) for row in np.asarray(vectors))
    found, logs = jax.jit(lambda frame: gram_schmidt(system, frame, *given))(frame)
    return rows_of(found), np.asarray(pack(logs, float))


@pytest.mark.parametrize("n", [FEW, MANY])
def test_a_frame_is_that_of_a_qr_factorisation(n):
    vectors = np.random.default_rng(n).normal(size=(n, n)) * np.logspace(0, -8, n)[:, None]
    frame, logs = orthonormalised(vectors)
    q, r = np.linalg.qr(vectors.T)
    assert_allclose(logs, np.log(abs(np.diag(r))), rtol=0, atol=1e-12)
    assert_allclose(frame, (q * np.sign(np.diag(r))).T, rtol=0, atol=1e-12)


@pytest.mark.parametrize("n", [FEW, MANY])
@pytest.mark.parametrize("dropped, told", [(True, -np.inf), (False, np.nan)])
def test_what_is_lost_is_replaced(n, dropped, told):
    vectors = np.random.default_rng(n).normal(size=(n, n))
    vectors[1] = 3 * vectors[0]
    vectors[-1] = vectors[0] - vectors[2]
    frame, logs = orthonormalised(vectors, dropped)
    assert_array_equal(logs[[1, -1]], told)
    assert np.isfinite(np.delete(logs, [1, n - 1])).all()
    assert_allclose(frame @ frame.T, np.eye(n), rtol=0, atol=1e-13)


@pytest.mark.parametrize("n", [FEW, MANY])
def test_vectors_that_a_slide_has_taken_away_are_rounding_and_not_small(n):
    kept = np.random.default_rng(n).normal(size=(n, n))
    # Of unit vectors there is left a plane, or nothing, up to rounding.
    for rank in (2, 0):
        vectors = kept[:, :rank] @ kept[:rank] + 1e-16 * kept
        _, logs = orthonormalised(vectors, dropped=True, projected=True)
        assert_array_equal(np.isneginf(logs), np.arange(n) >= rank)
    # Elsewhere a small vector may be what a map has left of it.
    assert np.isfinite(orthonormalised(1e-16 * kept, dropped=True)[1]).all()


def test_many_exponents_are_those_of_the_matrix():
    # Triangular, so that its diagonal is what they are.
    rates = np.linspace(0.5, -1.5, MANY)
    matrix = np.diag(rates) + np.triu(np.random.default_rng(0).normal(size=(MANY, MANY)), 1) / 9
    # Neighbours differ by 0.1, and the frame joins for a time of 160 before they are averaged.
    run = {"periods": 100, "transient": 1280, "steps": 10, "stepper": jf.RK4(), "interval": 0.5}
    found = jf.lyapunov_spectrum(Linear(jnp.asarray(matrix)), jnp.ones(MANY), **run)
    assert_allclose(found.exponents, rates, rtol=0, atol=1e-6)


@pytest.mark.release
def test_many_directions_go_through_contacts_as_few_do():
    more = np.arange(MORE + 1).sum() / 8
    # An impact at a time that the state moves: the volume shrinks by it as it does alone.
    system, x0 = MovingTable(jnp.asarray(0.8)), jnp.array([1.0, 0.0])
    found = jf.lyapunov_spectrum(Padded(system), wide(x0), **ONCE, interval=2.0)
    assert_allclose(found.exponents.sum(), np.log(0.8) - 0.1 - more, rtol=1e-7)
    # One direction is lost where the block sticks, and no other one is.
    found = jf.lyapunov_spectrum(
        Padded(jf.systems.MovingBelt()), wide(jnp.array([3.0, 0.0])), **ONCE, interval=12.0
    )
    assert np.isneginf(found.exponents).sum() == 1
