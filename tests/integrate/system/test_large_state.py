"""States of many numbers, which are one array inside the loop, against the same motion in few.

Each system is padded with states x_k' = −k (x_k − x_0) / 8, linear and driven by its first one, so
that nothing of its own motion changes.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil.integrate.system.lowered import build
from jaxfil.xla.compiler import makes_whole_kernels

MORE = 14


class Padded(jf.System):
    """A system with `MORE` states that it drives."""

    of: jf.System
    count: int = eqx.field(static=True)
    slides: bool = eqx.field(static=True)

    def __init__(self, of, count=MORE):
        self.of, self.count, self.slides = of, count, of.slides

    @property
    def period(self):
        return self.of.period

    def vector_field(self, t, x, side):
        own, more = jnp.split(x, [x.size - self.count])
        rates = jnp.arange(1, self.count + 1, dtype=x.dtype) / 8
        return jnp.concatenate([self.of.vector_field(t, own, side), rates * (own[0] - more)])

    def switching(self, t, x):
        return self.of.switching(t, x[: x.size - self.count])

    def reset(self, t, x, surface):
        own, more = jnp.split(x, [x.size - self.count])
        return jnp.concatenate([self.of.reset(t, own, surface), more])

    @property
    def resets(self):
        return self.of.resets


def wide(x):
    return jnp.concatenate([jnp.asarray(x), jnp.zeros(MORE, jnp.asarray(x).dtype)])


SCENES = {
    "slides": (jf.systems.BeltFriction(), [0.3, 0.1], 12.0),
    "crossings": (jf.systems.SDOscillator(), [0.3, 0.1], 20.0),
    "impacts": (jf.systems.ImpactOscillator(), [0.0, 0.0], 20.0),
    "two surfaces": (jf.systems.TwoRelays(), [1.0, 0.4], 6.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("compact", [True, False])
def test_contacts_and_states_are_those_of_the_few(name, compact):
    system, x0, t1 = SCENES[name]
    big = Padded(system)
    x = wide(x0)
    built = build(big, x, compact=False)
    separate = build(system, jnp.array(x0), compact=False).structure.separate
    assert built.unpack(x).is_array and built.structure.separate == separate
    # Written out, fewer stages compile sooner.
    stepper = diffrax.Dopri8() if compact else diffrax.Tsit5()
    options = {"compact": compact, "throw": False, "stepper": stepper}
    # Short enough for what is beside the few to halve no step of theirs.
    few = jf.solve(system, jnp.array(x0), 0.0, t1, 0.02, **options)
    many = jf.solve(big, x, 0.0, t1, 0.02, **options)
    assert many.result == few.result and many.num_events == few.num_events
    count = int(few.num_events)
    assert_allclose(many.events.ts[:count], few.events.ts[:count], rtol=1e-12)
    assert (many.events.kinds[:count] == few.events.kinds[:count]).all()
    assert_allclose(many.xs[-1, : len(x0)], few.xs[-1], rtol=1e-11, atol=1e-13)


@pytest.mark.release
@pytest.mark.parametrize("name", SCENES)
def test_jacobians_are_those_of_the_few(name):
    system, x0, t1 = SCENES[name]

    def end(system, x):
        return jf.solve(system, x, 0.0, t1 / 2, 0.05, max_events=None).xs[-1]

    few = jax.jit(jax.jacfwd(lambda x: end(system, x)))(jnp.array(x0))
    many = jax.jit(jax.jacfwd(lambda x: end(Padded(system), x)))(wide(x0))
    n = len(x0)
    assert_allclose(many[:n, :n], few, rtol=1e-9, atol=1e-11)
    assert_allclose(many[:n, n:], 0.0, rtol=0, atol=1e-13)
    back = jax.jit(jax.jacrev(lambda x: end(Padded(system), x)))(wide(x0))
    assert_allclose(back, many, rtol=1e-12, atol=1e-13)


@pytest.mark.release
def test_sweeps_orbits_and_exponents():
    system = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=12.0)
    x0, values = np.array([0.6, 0.0]), np.linspace(11, 12, 5)
    few_stages = {"stepper": jf.RK4()}
    options = {"transient": 20, "samples": 5, "progress": False, **few_stages}
    few = jf.bifurcation_diagram(system, "omega", values, x0, compact=True, **options)
    for compact in (True, False):
        many = jf.bifurcation_diagram(
            Padded(system), "of.omega", values, wide(x0), compact=compact, **options
        )
        assert_allclose(many.xs[..., :2], few.xs, rtol=1e-10, atol=1e-12)
    few, many = (
        jf.periodic_orbit(s, x, **few_stages) for s, x in ((system, x0), (Padded(system), wide(x0)))
    )
    assert_allclose(many.x0[:2], few.x0, rtol=1e-11)
    few, many = (
        jf.lyapunov_spectrum(s, x, periods=40, transient=40, **few_stages)
        for s, x in ((system, x0), (Padded(system), wide(x0)))
    )
    # The frame need not have turned to each direction for their sum to be the divergence.
    assert_allclose(
        many.exponents.sum(), few.exponents.sum() - np.arange(MORE + 1).sum() / 8, rtol=1e-9
    )


@pytest.mark.release
def test_checkpointed_gradients_and_float32():
    system, x0, t1 = SCENES["slides"]

    def end(x, **options):
        options["stepper"] = diffrax.Tsit5()
        end = jf.solve(Padded(system), x, 0.0, t1 / 4, 0.02, **options).xs[-1]
        return end[0], end

    adjoint = {"adjoint": diffrax.RecursiveCheckpointAdjoint(), "max_steps": 500}
    forward, double = jax.jit(jax.grad(end, has_aux=True))(wide(x0))
    reverse = jax.jit(jax.grad(lambda x: end(x, **adjoint)[0]))(wide(x0))
    assert_allclose(reverse, forward, rtol=1e-10)
    _, single = end(wide(np.float32(x0)))
    assert single.dtype == jnp.float32
    assert_allclose(single, double, rtol=0, atol=2e-5)


@pytest.mark.slow
def test_stiff_steps():
    system, x0, t1 = SCENES["crossings"]
    few, many = (
        jf.solve(s, jnp.asarray(x), 0.0, t1, 0.05, stepper=jf.Rodas5P()).xs[-1]
        for s, x in ((system, x0), (Padded(system), wide(x0)))
    )
    assert_allclose(many[:2], few, rtol=1e-11)


class Product(jf.System):
    """x' = A x − b side, A full."""

    a: jax.Array

    def vector_field(self, t, x, side):
        return self.a @ x - side

    def switching(self, t, x):
        return x[0]


@pytest.mark.slow
def test_a_product_with_a_matrix_stays_in_the_kernel():
    n = 24
    a = np.random.default_rng(0).normal(size=(n, n)) / n - np.eye(n)
    x0 = jnp.linspace(1.0, 2.0, n)

    def end(x):
        return jf.solve(Product(jnp.asarray(a)), x, 0.0, 0.5, 0.05).xs[-1]

    def with_value(x):
        value = end(x)
        return value, value

    if makes_whole_kernels():
        assert "dot_general" not in jax.jit(end).lower(x0).as_text()
    # Until the surface is met the motion is linear: x = e^{At}(x0 − c) + c, A c = 1.
    values, vectors = np.linalg.eig(a)
    flow = (vectors * np.exp(0.5 * values)) @ np.linalg.inv(vectors)
    c = np.linalg.solve(a, np.ones(n))
    exact = (flow @ (np.asarray(x0) - c)).real + c
    assert exact[0] > 0
    jacobian, value = jax.jacfwd(with_value, has_aux=True)(x0)
    assert_allclose(value, exact, rtol=1e-12)
    assert_allclose(jacobian, flow.real, rtol=1e-10, atol=1e-13)
