"""Differentiable, batched simulation and bifurcation analysis of nonsmooth systems in JAX."""

import importlib
import os
import signal
import sys
from types import ModuleType

# `python -m jaxfil` comes here before its own file: Ctrl-C ends it without a word while it loads.
_is_command = sys.argv[:1] == ["-m"] and "jaxfil" in sys.orig_argv
if _is_command and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(130))

from jaxfil import systems as systems
from jaxfil.bifurcations.locate import (
    BIFURCATION_KINDS as BIFURCATION_KINDS,
    Bifurcation as Bifurcation,
    find_bifurcation as find_bifurcation,
)
from jaxfil.bifurcations.margin import (
    GrazingMargin as GrazingMargin,
    grazing_margin as grazing_margin,
)
from jaxfil.bifurcations.sequence import (
    BifurcationSequence as BifurcationSequence,
    find_bifurcations as find_bifurcations,
)
from jaxfil.bifurcations.two_parameter import (
    BifurcationCurve as BifurcationCurve,
    continue_bifurcation as continue_bifurcation,
)
from jaxfil.exponents.coupled import (
    Synchronization as Synchronization,
    TransverseExponent as TransverseExponent,
)
from jaxfil.exponents.drive_response import drive_response as drive_response
from jaxfil.exponents.lyapunov import (
    LyapunovSpectrum as LyapunovSpectrum,
    lyapunov_spectrum as lyapunov_spectrum,
)
from jaxfil.exponents.synchronization import (
    synchronization_exponent as synchronization_exponent,
    transverse_exponent as transverse_exponent,
)
from jaxfil.integrate.rosenbrock import Rodas5P as Rodas5P
from jaxfil.integrate.solution import Events as Events, Solution as Solution
from jaxfil.integrate.solve import solve as solve
from jaxfil.integrate.stepper import RK4 as RK4
from jaxfil.integrate.work_precision import (
    WorkPrecision as WorkPrecision,
    work_precision as work_precision,
)
from jaxfil.model import deprecation, drawing
from jaxfil.model.outcomes import RESULTS as RESULTS, EventKind as EventKind
from jaxfil.model.system import System as System, piecewise as piecewise, smoothed as smoothed
from jaxfil.orbits.branch import Branch as Branch, SpecialPoint as SpecialPoint
from jaxfil.orbits.continue_orbit import continue_orbit as continue_orbit
from jaxfil.orbits.fourier import FourierOrbit as FourierOrbit
from jaxfil.orbits.harmonic_balance import harmonic_balance as harmonic_balance
from jaxfil.orbits.orbit import Orbit as Orbit
from jaxfil.orbits.periodic_orbit import periodic_orbit as periodic_orbit
from jaxfil.sweep.basins import Basins as Basins, basins_of_attraction as basins_of_attraction
from jaxfil.sweep.diagram import BifurcationDiagram as BifurcationDiagram
from jaxfil.sweep.load import load as load
from jaxfil.sweep.sweep import bifurcation_diagram as bifurcation_diagram
from jaxfil.version import __version__ as __version__


def _plot() -> ModuleType:
    # matplotlib is imported with the first picture, not before.
    return importlib.import_module("jaxfil.plot")


drawing.use(_plot)


_RENAMED = {"KINDS": "EventKind", "Route": "BifurcationSequence"}


def __getattr__(name: str):
    if name == "plot":
        return _plot()
    if name in _RENAMED:
        deprecation.warn_renamed(f"jaxfil.{name}", f"jaxfil.{_RENAMED[name]}")
        return globals()[_RENAMED[name]]
    raise AttributeError(f"module 'jaxfil' has no attribute {name!r}")
