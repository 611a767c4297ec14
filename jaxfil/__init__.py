"""Differentiable, batched simulation and bifurcation analysis of nonsmooth systems in JAX."""

import importlib

from jaxfil import systems as systems
from jaxfil.analysis.bifurcation import (
    Bifurcation as Bifurcation,
    find_bifurcation as find_bifurcation,
)
from jaxfil.analysis.branch import (
    Branch as Branch,
    SpecialPoint as SpecialPoint,
    continue_orbit as continue_orbit,
)
from jaxfil.analysis.curve import (
    BifurcationCurve as BifurcationCurve,
    continue_bifurcation as continue_bifurcation,
)
from jaxfil.analysis.drive_response import drive_response as drive_response
from jaxfil.analysis.harmonic import (
    FourierOrbit as FourierOrbit,
    harmonic_balance as harmonic_balance,
)
from jaxfil.analysis.lyapunov import (
    LyapunovSpectrum as LyapunovSpectrum,
    lyapunov_spectrum as lyapunov_spectrum,
)
from jaxfil.analysis.margin import grazing_margin as grazing_margin
from jaxfil.analysis.orbit import Orbit as Orbit, periodic_orbit as periodic_orbit
from jaxfil.analysis.route import Route as Route, find_bifurcations as find_bifurcations
from jaxfil.analysis.synchronization import (
    Synchronization as Synchronization,
    TransverseExponent as TransverseExponent,
    synchronization_exponent as synchronization_exponent,
    transverse_exponent as transverse_exponent,
)
from jaxfil.analysis.work_precision import (
    WorkPrecision as WorkPrecision,
    work_precision as work_precision,
)
from jaxfil.basins import Basins as Basins, basins_of_attraction as basins_of_attraction
from jaxfil.diagram import BifurcationDiagram as BifurcationDiagram, load as load
from jaxfil.initial_value import solve as solve
from jaxfil.results import KINDS as KINDS, RESULTS as RESULTS
from jaxfil.rosenbrock import Rodas5P as Rodas5P
from jaxfil.solution import Events as Events, Solution as Solution
from jaxfil.stepper import RK4 as RK4
from jaxfil.sweep import bifurcation_diagram as bifurcation_diagram
from jaxfil.system import System as System, piecewise as piecewise, smoothed as smoothed
from jaxfil.version import __version__ as __version__


def __getattr__(name: str):
    # matplotlib is imported with the first use of `jaxfil.plot`, not before.
    if name == "plot":
        return importlib.import_module("jaxfil.plot")
    raise AttributeError(f"module 'jaxfil' has no attribute {name!r}")
