"""A mode that is kept: the motion is the smooth one of that mode, with its derivatives, whatever
surfaces are in its way. Closed forms are those of the linear fields."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.integrate.lane.problem import KeptMode, even_grid
from jaxfil.integrate.loop.extensions import problem_of
from jaxfil.integrate.loop.iterate import integrate
from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.lowered import build
from jaxfil.model.outcomes import RESULTS

MU, SPEED, END = 0.3, 0.1, 5.0


class Belt(jf.System):
    """A mass between springs on a belt."""

    mu: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(MU))

    def vector_field(self, t, x, side):
        q, v = x
        return jnp.stack([v, -q - self.mu * side])

    def switching(self, t, x):
        return x[1] - SPEED


class Ball(jf.System):
    """A ball above a floor that it bounces from."""

    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return x * jnp.array([1.0, -0.5])


def run(system, x0, mode, on, compact):
    """The state of the loop at the end."""
    on_components = build(system, x0, compact=compact)
    problem = problem_of(
        on_components,
        tableau_of(diffrax.Dopri8()),
        even_grid(jnp.asarray(0.0), jnp.asarray(END), jnp.int32(100)),
        kept=KeptMode(on_components.of_surfaces(jnp.asarray([mode])), jnp.asarray(on)),
    )
    return integrate(problem, on_components.unpack(x0))


def on_side(side):
    """Where the belt's mass is in the end, on a side: q'' = −q − μ s."""
    c, s = np.cos(END), np.sin(END)

    def exact(x0):
        q, v = x0 + np.array([MU * side, 0])
        return np.array([q * c + v * s - MU * side, v * c - q * s])

    return exact, np.array([[c, s], [-s, c]])


SLIDE = (lambda x0: np.array([x0[0] + END * x0[1], x0[1]]), np.array([[1.0, END], [0.0, 1.0]]))
FALL = (
    lambda x0: np.array([x0[0] + END * x0[1] - END**2 / 2, x0[1] - END]),
    np.array([[1.0, END], [0.0, 1.0]]),
)
CASES = {
    "above": (Belt(), [1.0, 0.0], 1.0, on_side(1)),
    "below": (Belt(), [1.0, 0.5], -1.0, on_side(-1)),
    "from the surface": (Belt(), [1.0, SPEED], 1.0, on_side(1)),
    "a slide beyond its end": (Belt(), [0.1, SPEED], 0.0, SLIDE),
    "a slide beside its surface": (Belt(), [0.0, 0.4], 0.0, SLIDE),
    "through a floor": (Ball(), [1.0, 0.0], 1.0, FALL),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "compact"), [*((case, True) for case in CASES), ("a slide beyond its end", False)]
)
def test_the_motion_is_that_of_the_mode(case, compact):
    system, x0, mode, (exact, jacobian) = CASES[case]
    x0 = jnp.asarray(x0)

    def end(x0):
        state = run(system, x0, mode, True, compact)
        x = pack(state.motion.x, x0.dtype)
        return x, (x, state.result, state.counts.num_events)

    found, (x, result, contacts) = jax.jit(jax.jacfwd(end, has_aux=True))(x0)
    assert result == RESULTS.successful and contacts == 0
    np.testing.assert_allclose(x, exact(np.asarray(x0)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found, jacobian, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["above", "from the surface", "through a floor"])
def test_a_lane_that_keeps_no_mode_meets_its_contacts(case):
    system, x0, mode, _ = CASES[case]
    x0 = jnp.asarray(x0)
    state = jax.jit(lambda x: run(system, x, mode, False, True))(x0)
    found = jf.solve(system, x0, 0.0, END, END / 100, throw=False)
    assert state.counts.num_events > 0 and state.counts.num_events == found.num_events
    np.testing.assert_array_equal(pack(state.motion.x, x0.dtype), found.xs[-1])
