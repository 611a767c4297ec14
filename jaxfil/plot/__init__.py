"""Pictures: a diagram, a motion or an orbit enters, the matplotlib axes it was drawn on leave.

The only folder that knows matplotlib, which is why importing jaxfil does not import this one. Every
picture takes the axes to draw on, or makes its own, and gives them back.

The words of this room:

- page: a figure that no window shows, for a picture that goes to a file.
- canvas: what pictures are drawn on and with: pages, axes, and the colours of Okabe and Ito, which
  colour-blind readers tell apart.
- history: one component against time, over bands that show the mode.
- portrait: one component against another, with the contacts marked.
- section: the states at which a motion meets a Poincaré section.
- band: a strip of the axes in the colour of a mode, one for each surface.
- map: a colour for each point of a plane, of two parameters or of two components.
- hook: each picture of a result registers itself (`draws`), and the result's `plot()` finds it.
"""

from jaxfil.plot.basins import basins as basins
from jaxfil.plot.canvas import page as page
from jaxfil.plot.exponents import (
    lyapunov_convergence as lyapunov_convergence,
    lyapunov_exponents as lyapunov_exponents,
    synchronization as synchronization,
)
from jaxfil.plot.motion import (
    BANDS as BANDS,
    MARKERS as MARKERS,
    phase_portrait as phase_portrait,
    time_history as time_history,
)
from jaxfil.plot.multipliers import multipliers as multipliers
from jaxfil.plot.orbits import bifurcation_curve as bifurcation_curve, branch as branch
from jaxfil.plot.periods import PERIODS as PERIODS, parameter_map as parameter_map
from jaxfil.plot.precision import work_precision as work_precision
from jaxfil.plot.samples import bifurcation_diagram as bifurcation_diagram
from jaxfil.plot.section import poincare_section as poincare_section
