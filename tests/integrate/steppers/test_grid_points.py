"""Slides and rests that end at a grid point: by the rounding of times they end beside it."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf


class Block(jf.System):
    """A block on a plate: v' = cos ωt − sgn(v)/2, which slips where cos ωt = ±1/2."""

    omega: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.cos(self.omega * t) - 0.5 * side])

    def switching(self, t, x):
        return x[0]

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def sweep(system, omegas, x0, steps):
    return jf.bifurcation_diagram(
        system,
        "omega",
        omegas,
        np.array(x0),
        transient=20,
        samples=2,
        steps=steps,
        stepper=diffrax.Tsit5(),
        compact=True,
        progress=False,
    )


def test_a_slide_may_end_at_a_grid_point():
    """In units of 1/ω all frequencies have one motion; T/6 is the end of a step of T/60."""
    omegas = np.linspace(0.2, 3.0, 256)
    found = sweep(Block(jnp.asarray(1.0)), omegas, [0.0], 60)
    assert found.successful.all()
    scaled = found.xs[:, :, 0] * omegas[:, None]
    assert_allclose(scaled, scaled[0, 0], rtol=0, atol=64 * np.finfo(float).eps)


@pytest.mark.slow
def test_a_rest_may_end_at_a_grid_point():
    """The wall stands where there is no force from the spring: it is left at T/4."""
    wall = jf.systems.ImpactOscillator(wall=0.0, amplitude=1.0, restitution=0.6)
    omegas = np.linspace(0.2, 0.6, 64)
    on, beside = (sweep(wall, omegas, [-0.1, 0.0], steps) for steps in (160, 161))
    assert on.successful.all() and beside.successful.all()
    assert_allclose(on.xs, beside.xs, rtol=0, atol=1e-7)  # the error of the stepper
