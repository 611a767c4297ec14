"""A single run is one kernel: the same numbers as the many parts of a traced one, where XLA can
compile it, and where it cannot."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil import initial_value


class Coupled(jf.System):
    """A field written with what one kernel may hold (a product) or not (LAPACK, a scatter)."""

    a: jax.Array
    how: str = eqx.field(static=True)

    def vector_field(self, t, x, side):
        matrix = jnp.eye(2) + self.a
        pull = {
            "product": lambda: matrix @ x,
            "solve": lambda: jnp.linalg.solve(matrix, x),
            "scatter": lambda: x.at[jnp.array([1, 0])].add(self.a * x),
        }
        return -pull[self.how]() - 0.4 * side

    def switching(self, t, x):
        return x[0] - 0.5


def run(a, how):
    sol = jf.solve(Coupled(a, how), jnp.array([1.0, 0.5]), 0.0, 2.0, 0.05, stepper=jf.RK4())
    return sol.x_final, sol.events.ts[:2]


@pytest.mark.parametrize("how", ["product", "solve", "scatter"])
def test_a_run_alone_gives_what_a_traced_one_gives(how, monkeypatch):
    refused = set()
    monkeypatch.setattr(initial_value, "_REFUSED", refused)
    alone = run(jnp.float64(0.3), how)
    assert len(refused) == (how != "product")
    traced = jax.jit(run, static_argnums=1)(jnp.float64(0.3), how)
    assert np.isfinite(alone[1]).any(), "there was no contact"
    for a, b in zip(alone, traced, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)
    assert len(refused) == (how != "product")


def test_an_error_of_the_users_own_is_told():
    class Guarded(Coupled):
        def vector_field(self, t, x, side):
            return eqx.error_if(-x, x[0] < 0.9, "left the model's range")

    with pytest.raises(eqx.EquinoxRuntimeError, match="left the model's range"):
        jf.solve(Guarded(jnp.float64(0.3), "product"), jnp.array([1.0, 0.5]), 0.0, 2.0, 0.05)
