"""The extensions of a run, and access to the state of one.

A new extension is a subclass of `Extension`. One that the system or its sections ask for has a line
in `problem_of`; one that an option asks for, such as averages, is passed to it in `others`.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp

from jaxfil.integrate.lane.clocks import Clocks
from jaxfil.integrate.lane.extension import Extension
from jaxfil.integrate.lane.problem import (
    NOTHING,
    KeptMode,
    Problem,
    Recording,
    TimeGrid,
    budget_with_ticks,
)
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.loop.section_search import SectionSearch
from jaxfil.integrate.loop.section_state import SectionState
from jaxfil.integrate.steppers.explicit import Tableau
from jaxfil.integrate.surfaces.sections import WatchedSections
from jaxfil.integrate.system.lowered import ComponentSystem

# Iteration budget of a run whose steps follow a tolerance: a minimum, an addition for each step of
# the grid (which may be a period), and the largest number of grid steps counted.
_LEAST, _OF_EACH, _MOST_GRID_STEPS = 2**20, 4096, 2**18


def problem_of(
    system: ComponentSystem,
    tableau: Tableau,
    grid: TimeGrid,
    recording: Recording = NOTHING,
    sections: WatchedSections | None = None,
    kept: KeptMode | None = None,
    limited: bool = False,
    others: tuple[Extension, ...] = (),
) -> Problem:
    """The problem of one lane, with the extensions that its system and its sections need, and
    `others`. Unless `limited`, the iteration budget is raised if a tolerance determines the number
    of steps, and by the ticks of clocks."""
    if tableau.tolerance is not None and not limited:
        most = jnp.minimum(grid.num_steps, _MOST_GRID_STEPS)
        enough = jnp.maximum(grid.max_iterations, _LEAST + _OF_EACH * most)
        grid = dataclasses.replace(grid, max_iterations=enough)
    if system.clocks and not limited:
        grid = dataclasses.replace(grid, max_iterations=budget_with_ticks(grid, system.clocks))
    extensions: list[Extension] = []
    # Clocks come first, since they restrict the times at which others evaluate functions.
    if system.clocks:
        extensions.append(Clocks())
    if sections is not None:
        extensions.append(SectionSearch(sections))
    return Problem(system, tableau, grid, recording, (*extensions, *others), kept)


def sections_in(state: LoopState) -> SectionState | None:
    """The state of the section search of a lane; None without sections."""
    own: list[Any] = [v for v in state.extensions if isinstance(v, SectionState)]
    return own[0] if own else None
