"""Pictures of results.

Only this room imports matplotlib, so importing jaxfil does not import it. Every picture draws on
given or new axes, and returns them.

Terms of this room:

- page: a figure without a window, for a picture in a file.
- canvas: pages, axes, and the colours of Okabe and Ito, which colour-blind readers can distinguish.
- history: one component against time, over bands that show the mode.
- portrait: one component against another, with the contacts marked.
- section: the states at which a motion crosses a Poincaré section.
- band: a strip of the axes in the colour of a mode, one for each surface.
- map: a colour for each point of a plane, of two parameters or of two components.
- widget: sliders over a picture in a notebook, which is redrawn as they move.
- kinds: the marker and the colour of each kind of bifurcation, contact and mode, in every picture.
- hook: each picture of a result registers itself (`draws`), and the result's `plot()` finds it.
"""

from jaxfil.plot.animation import animation as animation
from jaxfil.plot.averages import averages as averages
from jaxfil.plot.basins import basins as basins
from jaxfil.plot.branch_orbits import branch_orbits as branch_orbits
from jaxfil.plot.canvas import PRINT as PRINT, page as page
from jaxfil.plot.density import section_density as section_density
from jaxfil.plot.equilibrium_branch import equilibrium_branch as equilibrium_branch
from jaxfil.plot.explore import explore as explore
from jaxfil.plot.exponent_map import exponent_map as exponent_map
from jaxfil.plot.exponents import (
    lyapunov_convergence as lyapunov_convergence,
    lyapunov_exponents as lyapunov_exponents,
    synchronization as synchronization,
)
from jaxfil.plot.history import time_history as time_history
from jaxfil.plot.multipliers import multipliers as multipliers
from jaxfil.plot.orbits import bifurcation_curve as bifurcation_curve, branch as branch
from jaxfil.plot.path import BANDS as BANDS, MARKERS as MARKERS
from jaxfil.plot.path_in_time import path_in_time as path_in_time
from jaxfil.plot.periods import PERIODS as PERIODS, parameter_map as parameter_map
from jaxfil.plot.phase_plane import phase_plane as phase_plane
from jaxfil.plot.portrait import phase_portrait as phase_portrait
from jaxfil.plot.precision import step_choice as step_choice, work_precision as work_precision
from jaxfil.plot.return_map import return_map as return_map
from jaxfil.plot.samples import bifurcation_diagram as bifurcation_diagram
from jaxfil.plot.section import poincare_section as poincare_section
from jaxfil.plot.sequence import bifurcation_sequence as bifurcation_sequence
from jaxfil.plot.sliding_region import sliding_region as sliding_region
from jaxfil.plot.timeline import event_timeline as event_timeline

__all__ = [
    "BANDS",
    "MARKERS",
    "PERIODS",
    "PRINT",
    "animation",
    "averages",
    "basins",
    "bifurcation_curve",
    "bifurcation_diagram",
    "bifurcation_sequence",
    "branch",
    "branch_orbits",
    "equilibrium_branch",
    "event_timeline",
    "explore",
    "exponent_map",
    "lyapunov_convergence",
    "lyapunov_exponents",
    "multipliers",
    "page",
    "parameter_map",
    "path_in_time",
    "phase_plane",
    "phase_portrait",
    "poincare_section",
    "return_map",
    "section_density",
    "sliding_region",
    "step_choice",
    "synchronization",
    "time_history",
    "work_precision",
]
