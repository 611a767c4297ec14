"""Many lanes: one parameter of a system swept over thousands of values.

A system, the name of a parameter and its values enter; the motion that each value settles on,
sampled once a forcing period, leaves. Lanes run in chunks, a chunk on every core at a time, and
each has its own outcome.
"""

import functools as ft
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil import check, scene
from jaxfil.flow import integrate
from jaxfil.lane import Policy, Span
from jaxfil.parameter import parameter, replace
from jaxfil.results import RESULTS, outcome_names
from jaxfil.stepper import tableau
from jaxfil.system import System

# Lanes of one call: enough for the cost of starting each fused kernel to vanish, few enough for
# their state to stay in the second-level cache.
_CHUNK = 1024
# Values of one call when each starts from the last one's end.
_FOLLOW = 16


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
        _compiled(),
        system,
        name,
        transient=jnp.asarray(transient, jnp.int32),
        samples=samples,
        steps=jnp.asarray(steps, jnp.int32),
        stepper=stepper,
    )
    if follow is None:
        order = np.arange(values.shape[0])
        pieces = _chunks(job, values, states)
    else:
        order = np.argsort(values, kind="stable")
        order = order if follow == "up" else order[::-1]
        if states.shape[0] != 1:
            raise ValueError(f"`x0` must be of shape (n,) with `follow`, got {states.shape}.")
        pieces = _followed(job, values[order], states[0])
    xs, results = _collect(pieces, values.shape[0], samples, states.shape[1], dtype, progress)
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


def _run(system, name, values, states, *, transient, samples, steps, stepper, followed):
    """A chunk of values side by side, or one after the other each from the last one's end."""

    def lane(value, x0):
        return _lane(system, name, value, x0, transient, samples, steps, stepper)

    if not followed:
        return jax.vmap(lane)(values, states)

    def next_value(x, value):
        xs, result, end = lane(value, x)
        return jnp.where(result == RESULTS.successful, end, x), (xs, result)

    end, (xs, results) = jax.lax.scan(next_value, states, values)
    return xs, results, end


# Vectors as wide as the machine has them. (XLA's fast math would be a fifth faster still, but NaN
# goes unnoticed under it, whatever its options promise.)
_CPU_OPTIONS = {"xla_cpu_prefer_vector_width": "512"}


@ft.cache
def _compiled() -> Callable:
    """The compiled chunk."""
    options = _CPU_OPTIONS if jax.default_backend() == "cpu" else None
    # Equinox's overloads leave out the keywords that it hands on to `jax.jit`.
    return eqx.filter_jit(_run, compiler_options=options)  # pyright: ignore[reportCallIssue]


def _cores() -> int:
    if jax.default_backend() != "cpu":
        return 1
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _chunks(job: Callable, values: np.ndarray, states: np.ndarray) -> Iterator[tuple]:
    """Chunks of equal size, the last one padded, one at a time on each core."""
    p, cores = values.shape[0], _cores()
    size = min(_CHUNK, -(-p // cores))
    states = np.broadcast_to(states, (p, states.shape[1]))

    def chunk(start: int):
        pick = np.minimum(np.arange(start, start + size), p - 1)
        xs, results, _ = job(values[pick], states[pick], followed=False)
        keep = min(size, p - start)
        return start, jax.tree.map(lambda v: np.asarray(v)[:keep], (xs, results))

    with ThreadPoolExecutor(cores) as pool:
        starts = list(range(0, p, size))
        # Lanes that fail at once: what follows is compiled here, and not on every core.
        job(np.full(size, np.nan, values.dtype), states[:1].repeat(size, axis=0), followed=False)
        for done in as_completed([pool.submit(chunk, start) for start in starts]):
            yield done.result()


def _followed(job: Callable, values: np.ndarray, state: np.ndarray) -> Iterator[tuple]:
    """Runs of values, each value from the last one's end."""
    p, size = values.shape[0], min(_FOLLOW, values.shape[0])
    for start in range(0, p, size):
        pick = np.minimum(np.arange(start, start + size), p - 1)
        xs, results, state = job(values[pick], state, followed=True)
        keep = min(size, p - start)
        yield start, jax.tree.map(lambda v, keep=keep: np.asarray(v)[:keep], (xs, results))


def _collect(pieces: Iterator[tuple], p: int, samples: int, n: int, dtype: Any, progress: bool):
    """All chunks in one array, with a progress bar that counts lanes."""
    from tqdm.auto import tqdm

    xs = np.full((p, samples, n), np.nan, dtype)
    codes = np.zeros((p,), np.int32)
    outcomes = None
    with tqdm(total=p, unit="lane", disable=not progress) as bar:
        for start, (piece, outcomes) in pieces:
            (code,) = jax.tree.leaves(outcomes)
            xs[start : start + len(code)] = piece
            codes[start : start + len(code)] = code
            bar.update(len(code))
    return xs, jax.tree.map(lambda _: codes, outcomes)
