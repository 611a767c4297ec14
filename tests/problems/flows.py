"""Motions whose end is known in closed form, to be differentiated by all that it depends on.

Through crossings, slides, an intersection and impacts; parameters and starts are no round numbers.
"""

import jax.numpy as jnp

import jaxfil as jf
from tests.problems import closed_forms as exact
from tests.problems.problem import Problem
from tests.problems.systems import Box, Leave

S = jf.systems


def _flow(system, x0, t0, t1, tags, flow):
    return Problem(system, x0, t1, 0.03, tags, t0=t0, atol=1e-11, flow=flow)


FLOWS = {
    "rotating by everything": _flow(
        S.RotatingOscillator(omega=-6.0), (0.3, 0.2), 0.1, 2.2, "crossing", exact.rotating
    ),
    "ball by everything": _flow(
        S.BouncingBall(g=9.8, restitution=0.8), (10, 1.0), -0.3, 4.0, "impact", exact.ball
    ),
    "relays by everything": _flow(S.TwoRelays(), (1.5, 1.0), 0.0, 1.0, "sliding", exact.relays),
    "box by everything": _flow(
        Box(jnp.asarray(0.7), jnp.asarray(0.9)),
        (1.0, 2.0, 0.5),
        0.2,
        4.1,
        "sliding intersection",
        exact.box,
    ),
    "leave by everything": _flow(
        Leave(jnp.asarray(2.0)), (0.0, 0.4), 0.5, 3.3, "sliding", exact.leave
    ),
    "coulomb by everything": _flow(
        S.CoulombOscillator(friction=0.4), (2.8, 0.7), 0.3, 20.0, "crossing sliding", exact.coulomb
    ),
}
