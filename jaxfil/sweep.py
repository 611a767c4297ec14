"""Many lanes: one parameter of a system swept over thousands of values.

A system, the name of a parameter and its values enter; the motion that each value settles on,
sampled once a forcing period, leaves. Lanes run in chunks, a chunk on every core at a time, and
each has its own outcome.
"""

import functools as ft
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil import check, scene
from jaxfil.chunk import chunks, collect, compiled, one_after_another
from jaxfil.flow import integrate
from jaxfil.kernel import in_blocks, one_kernel
from jaxfil.lane import Policy, Span
from jaxfil.parameter import parameter, replace
from jaxfil.results import RESULTS, outcome_names
from jaxfil.stepper import tableau
from jaxfil.system import System

# Lanes that share a loop, on CPU: few enough for all of their numbers to stay in the first-level
# cache, and to wait for few others.
_BLOCK = 64


class BifurcationDiagram(eqx.Module):
    """The motion settled on against a parameter.

    `xs[i, k]` is the state at the k-th sampled forcing period (t a multiple of the period) for
    `values[i]`; NaN from where a lane failed. `results[i]` is the lane's outcome.
    """

    values: Float[np.ndarray, " p"]
    xs: Float[np.ndarray, "p samples n"]
    results: RESULTS
    parameter: str = eqx.field(static=True)
    system: str = eqx.field(static=True)

    @property
    def successful(self) -> np.ndarray:
        """Which lanes reached their end, shape (p,)."""
        return np.asarray(self.results == RESULTS.successful)

    def plot(self, ax: Any = None, component: int = 0) -> Any:
        """Draw one component of the samples against the parameter; returns the matplotlib axes."""
        from jaxfil import plot

        return plot.bifurcation_diagram(self, ax=ax, component=component)

    def to_xarray(self) -> Any:
        """An `xarray.Dataset` of `x` (parameter, sample, component) and `outcome` (parameter).

        Needs the package xarray.
        """
        import xarray

        return xarray.Dataset(
            {
                "x": ((self.parameter, "sample", "component"), self.xs),
                "outcome": ((self.parameter,), outcome_names(self.results)),
            },
            coords={self.parameter: self.values},
            attrs={"system": self.system},
        )

    def __repr__(self) -> str:
        p, samples, n = self.xs.shape
        lines = [
            f"BifurcationDiagram of {self.system}",
            f"  {self.parameter}: {p} values from {self.values[0]:g} to {self.values[-1]:g}",
            f"  {samples} samples of {n} components each",
            f"  {int(self.successful.sum())} of {p} lanes successful",
        ]
        return "\n".join(lines)


def bifurcation_diagram(
    system: System,
    name: str,
    values: Float[Array | np.ndarray, " p"],
    x0: Float[Array, " n"],
    *,
    transient: int = 200,
    samples: int = 100,
    steps: int = 40,
    stepper: Any = None,
    follow: Literal["up", "down"] | None = None,
    progress: bool = True,
) -> BifurcationDiagram:
    """Sweep the parameter `name` of a forced system over `values`.

    For each value the system runs `transient` forcing periods from t = 0 unseen, then `samples`
    periods, and its state is kept at the end of each: a stroboscopic Poincaré section.

    **Arguments**

    - `name`: a float leaf of the system; a dotted path for nested modules.
    - `values`: shape (p,). New values never recompile.
    - `x0`: the initial state of every lane, shape (n,), or one for each, shape (p, n).
    - `steps`: steps per forcing period.
    - `stepper`: as in `solve`; by default `diffrax.Dopri8()`.
    - `follow`: `"up"` or `"down"` starts each value, in ascending or descending order, from the
      last one's end, which follows an attractor; by default each starts from `x0`.
    - `progress`: show a progress bar.

    **Returns** a `BifurcationDiagram`. A lane that fails says why in `results` and harms no other.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> d = jf.bifurcation_diagram(
    ...     jf.systems.SDOscillator(), "omega", jnp.array([0.6, 1.2]), jnp.array([0.3, 0.1]),
    ...     transient=20, samples=5, progress=False)
    >>> d.xs.shape
    (2, 5, 2)
    """
    states = _initial_states(x0)
    dtype = states.dtype
    check.system("system", system)
    system = scene.cast(system, dtype)
    parameter(system, name)
    values = _values(values, dtype)
    if states.shape[0] not in (1, values.shape[0]):
        raise ValueError(
            f"`x0` must be of shape (n,) or (p, n) with p = {values.shape[0]}, the number of "
            f"values, got {states.shape}."
        )
    if system.period is None:
        raise ValueError(
            f"`system` must be forced: a diagram samples once a forcing period, and the period of "
            f"{type(system).__name__} is None."
        )
    transient = check.count("transient", transient, least=0)
    samples = check.count("samples", samples)
    steps = check.count("steps", steps)
    stepper = diffrax.Dopri8() if stepper is None else stepper
    tableau(stepper)
    if follow not in (None, "up", "down"):
        raise ValueError(f'`follow` must be "up", "down" or None, got {follow!r}.')

    job = ft.partial(
        compiled(_run),
        system,
        name,
        transient=jnp.asarray(transient, jnp.int32),
        samples=samples,
        steps=jnp.asarray(steps, jnp.int32),
        stepper=stepper,
    )
    if follow is None:
        order = np.arange(values.shape[0])
        pieces = chunks(job, values, states)
    else:
        order = np.argsort(values, kind="stable")
        order = order if follow == "up" else order[::-1]
        if states.shape[0] != 1:
            raise ValueError(f"`x0` must be of shape (n,) with `follow`, got {states.shape}.")
        pieces = one_after_another(job, values[order], states[0])
    xs, results = collect(pieces, values.shape[0], samples, states.shape[1], dtype, progress)
    back = np.argsort(order, kind="stable")
    return BifurcationDiagram(
        values=values,
        xs=xs[back],
        results=jax.tree.map(lambda code: jnp.asarray(code[back]), results),
        parameter=name,
        system=type(system).__name__,
    )


def _initial_states(x0: Any) -> np.ndarray:
    """One or p initial states, shape (1 or p, n)."""
    if np.ndim(x0) == 2 and np.shape(x0)[0] > 0:
        check.state("x0", x0[0])
        array = np.asarray(x0)
        return array if array.dtype.kind == "f" else array.astype(jnp.result_type(float))
    return np.asarray(check.state("x0", x0))[None]


def _values(values: Any, dtype: Any) -> np.ndarray:
    array = np.asarray(values)
    if array.ndim != 1 or array.shape[0] == 0 or array.dtype.kind not in "fiu":
        raise ValueError(
            "`values` must be real numbers of shape (p,) with p ≥ 1, got shape "
            f"{array.shape} of dtype {array.dtype}."
        )
    return array.astype(dtype)


def _lane(system, name, value, x0, transient, samples, steps, stepper):
    """One value: samples (samples, n), outcome, and the last state."""
    system = replace(system, name, value)
    scene_ = scene.build(system, x0)
    period = jnp.asarray(system.period, x0.dtype)
    num_steps = (transient + samples) * steps
    span = Span(
        t0=jnp.zeros((), x0.dtype),
        length=(transient + samples).astype(x0.dtype) * period,
        dt=period / steps.astype(x0.dtype),
        num_steps=num_steps,
        max_iterations=32 * jnp.minimum(num_steps, 2**25) + 100_000,
    )
    policy = Policy("samples", None, first=(transient + 1) * steps, every=steps)
    lane = integrate(scene_, tableau(stepper), span, policy, scene.unpack(x0), num_saves=samples)
    assert lane.saves is not None
    xs = jnp.where(jnp.isfinite(lane.saves.xs), lane.saves.xs, jnp.nan)
    return xs, lane.result, scene.pack(lane.x, x0.dtype)


def _run(system, name, values, states, *, transient, samples, steps, stepper, followed, whole):
    """A chunk of values side by side, or one after the other each from the last one's end."""

    def lane(value, x0):
        return _lane(system, name, value, x0, transient, samples, steps, stepper)

    if not followed:
        lanes = jax.vmap(lane)
        return (in_blocks(lanes, _BLOCK) if whole else lanes)(values, states)

    single = one_kernel(lane) if whole else lane

    def next_value(x, value):
        xs, result, end = single(value, x)
        return jnp.where(result == RESULTS.successful, end, x), (xs, result)

    end, (xs, results) = jax.lax.scan(next_value, states, values)
    return xs, results, end
