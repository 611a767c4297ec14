"""The phase of an autonomous orbit, which may start at any of its states."""

import numpy as np

from jaxfil.orbits.orbit import Orbit


def phased_like(orbit: Orbit, u: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The unknowns u of an orbit, with the starts of its arcs shifted to where it is nearest to
    another orbit's start, to about the square of a fine step."""
    m, n = orbit.starts.shape
    run = orbit.trajectory()
    assert run.xs is not None and run.ts is not None
    ts, xs = np.asarray(run.ts), np.asarray(run.xs)
    seen = np.isfinite(ts)
    ts, xs = ts[seen] - ts[0], xs[seen]
    size = np.where(abs(xs).max(axis=0) == 0, 1, abs(xs).max(axis=0))
    # The nearest point of the polygon of all states.
    steps, away = np.diff(xs, axis=0) / size, (other[:n] - xs[:-1]) / size
    lengths = np.sum(steps**2, axis=1)
    parts = np.clip(np.sum(steps * away, axis=1) / np.where(lengths == 0, 1, lengths), 0, 1)
    distances = np.sum((away - parts[:, None] * steps) ** 2, axis=1)
    if orbit.system.resets and run.events is not None:
        # A step with a reset in it jumps, past states that are not on the orbit.
        hits = np.asarray(run.events.ts)
        hits = hits[np.isfinite(hits)] - np.asarray(run.ts)[0]
        distances[(np.searchsorted(ts, hits) - 1).clip(0, distances.size - 1)] = np.inf
    k = int(np.argmin(distances))
    first = ts[k] + parts[k] * (ts[k + 1] - ts[k])
    at = (first + np.arange(m) * ts[-1] / m) % ts[-1]
    starts = np.stack([np.interp(at, ts, x) for x in xs.T], axis=1)
    return np.append(starts.ravel(), u[m * n :])
