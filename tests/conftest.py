"""Every test runs in float64, with strict type promotion."""

import equinox as eqx
import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(autouse=True, scope="module")
def compiled_programs_end_with_their_file():
    """Hundreds of compiled programs would otherwise take gigabytes by the end."""
    yield
    jax.clear_caches()
    eqx.clear_caches()
