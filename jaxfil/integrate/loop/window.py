"""The span of a run that is averaged over, from one sample of a sweep to another."""

import equinox as eqx
from jaxtyping import Array

from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.loop.extensions import sections_in


class Window(eqx.Module):
    """The time from a grid point to the end of the run; for a run sampled at a section, from one of
    its crossings."""

    first: Array
    """The number of the grid point, or of the crossing, counted from 1."""

    def is_open(self, state: LoopState) -> Array:
        """Whether a lane has reached that grid point or crossing."""
        return self.count(state) >= self.first

    def count(self, state: LoopState) -> Array:
        """The number of grid points, or of crossings, that a lane has reached."""
        sections = sections_in(state)
        return state.counts.index if sections is None else sections.watch.total
