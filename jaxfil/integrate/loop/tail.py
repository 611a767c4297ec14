"""The part of a path whose tail is known: narrow features that the end of a step does not show.

The defect at the end of a step is blind to a pulse, or to a stiff potential, that lies within the
step and is zero to rounding at both ends. Its beginning is in the last coefficients, far below the
tolerance, but growing from order to order. They are continued by the series of an exponential
function, of size A and of the rate λ in a step,

    c_k ≈ A λ^k/k!,    λ² = (p (p − 1) |c_p| + (p − 1) (p − 2) |c_{p−1}|)/(|c_{p−2}| + |c_{p−3}|),

which reaches the tolerance where A e^(λ s) does. A step ends there, or where λ s = p/2, up to which
the coefficients fall to the end of the series, whichever is later. This is beyond the steps that
the error allows wherever the series shows the whole motion. A feature that is zero in floating
point has no coefficients, and stays unknown.
"""

import math

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.cubic import NEVER
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.system.components import least, on_each
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.xla.select import select


def known_part(problem: Problem, path: Polynomial) -> Array:
    """The fraction of a path within which its tail is known; `NEVER` for the whole of it."""
    order, tolerance = problem.tableau.order, problem.tableau.tolerance
    assert tolerance is not None
    atol, rtol = tolerance.atol, tolerance.rtol

    def of_number(x: Array, *tail: Array) -> Array:
        a, b, c, d = map(abs, tail)
        low, high = a + b, (order - 1.0) * ((order - 2.0) * c + order * d)
        there = (low > 0) & (high > 0)
        rate = jnp.sqrt(select(there, high, 1.0) / select(there, low, 1.0))
        last = (order - 1, c), (order, d)
        sizes = [jnp.log(v) + math.lgamma(k + 1) - k * jnp.log(rate) for k, v in last]
        far = jnp.log(atol + rtol * abs(x)) - jnp.maximum(*sizes)
        part = jnp.maximum(far, order / 2) / rate
        # Coefficients that are not finite give NaN, which fails this comparison.
        return select(there & (part > 0), part, NEVER)

    start, *_ = path.x
    return jnp.minimum(least(on_each(of_number, *stop_gradient((start, *path.x[-4:])))), NEVER)
