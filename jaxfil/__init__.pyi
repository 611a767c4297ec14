"""What is public: `__init__.py` offers these names, and imports each when it is first used."""

from . import plot as plot, systems as systems
from .bifurcations.locate import (
    BIFURCATION_KINDS as BIFURCATION_KINDS,
    Bifurcation as Bifurcation,
    find_bifurcation as find_bifurcation,
)
from .bifurcations.margin import (
    GrazingMargin as GrazingMargin,
    grazing_margin as grazing_margin,
)
from .bifurcations.nearest import (
    NearestGrazing as NearestGrazing,
    nearest_grazing as nearest_grazing,
)
from .bifurcations.sequence import (
    BifurcationSequence as BifurcationSequence,
    find_bifurcations as find_bifurcations,
)
from .bifurcations.two_parameter import (
    CODIMENSION_TWO_KINDS as CODIMENSION_TWO_KINDS,
    BifurcationCurve as BifurcationCurve,
    continue_bifurcation as continue_bifurcation,
)
from .equilibria.continue_equilibrium import continue_equilibrium as continue_equilibrium
from .equilibria.equilibrium import Equilibrium as Equilibrium
from .equilibria.equilibrium_branch import (
    EQUILIBRIUM_BIFURCATION_KINDS as EQUILIBRIUM_BIFURCATION_KINDS,
    EquilibriumBifurcation as EquilibriumBifurcation,
    EquilibriumBranch as EquilibriumBranch,
)
from .equilibria.search import equilibrium as equilibrium
from .equilibria.tangency_points import (
    FieldTangency as FieldTangency,
    tangency_points as tangency_points,
)
from .equilibria.two_parameter import (
    EquilibriumCurve as EquilibriumCurve,
    continue_equilibrium_bifurcation as continue_equilibrium_bifurcation,
)
from .exponents.coupled import (
    Synchronization as Synchronization,
    TransverseExponent as TransverseExponent,
)
from .exponents.drive_response import drive_response as drive_response
from .exponents.lyapunov import (
    LyapunovSpectrum as LyapunovSpectrum,
    lyapunov_spectrum as lyapunov_spectrum,
)
from .exponents.synchronization import (
    synchronization_exponent as synchronization_exponent,
    transverse_exponent as transverse_exponent,
)
from .files.load import load as load
from .integrate.run.solution import Crossings as Crossings, Events as Events, Solution as Solution
from .integrate.run.solve import solve as solve
from .integrate.run.step_choice import StepChoice as StepChoice
from .integrate.steppers.adaptive import Adaptive as Adaptive
from .integrate.steppers.explicit import RK4 as RK4
from .integrate.steppers.rosenbrock import Rodas5P as Rodas5P
from .integrate.steppers.taylor import Taylor as Taylor
from .model.clock import Clock as Clock
from .model.outcomes import RESULTS as RESULTS, EventKind as EventKind
from .model.quantity import (
    RMS as RMS,
    EventSum as EventSum,
    Maximum as Maximum,
    Minimum as Minimum,
)
from .model.section import (
    Section as Section,
    bound as bound,
    maxima as maxima,
    minima as minima,
)
from .model.smoothed import smoothed as smoothed
from .model.system import System as System, piecewise as piecewise
from .orbits.branch import Branch as Branch, SpecialPoint as SpecialPoint
from .orbits.continue_orbit import continue_orbit as continue_orbit
from .orbits.fourier import FourierOrbit as FourierOrbit
from .orbits.harmonic_balance import harmonic_balance as harmonic_balance
from .orbits.orbit import Orbit as Orbit
from .orbits.periodic_orbit import periodic_orbit as periodic_orbit
from .studies.average import Average as Average, average as average
from .studies.choose_step import choose_step as choose_step
from .studies.fit import Fit as Fit, fit as fit
from .studies.return_map import Returns as Returns, poincare_map as poincare_map
from .studies.work_precision import (
    WorkPrecision as WorkPrecision,
    work_precision as work_precision,
)
from .sweep.basins import Basins as Basins, basins_of_attraction as basins_of_attraction
from .sweep.diagram import BifurcationDiagram as BifurcationDiagram
from .sweep.settled_average import (
    SettledAverage as SettledAverage,
    settled_average as settled_average,
)
from .sweep.sweep import bifurcation_diagram as bifurcation_diagram
from .version import __version__ as __version__
