"""Differentiable, batched simulation and bifurcation analysis of nonsmooth systems in JAX."""

import importlib

from jaxfil import systems as systems
from jaxfil.initial_value import solve as solve
from jaxfil.results import KINDS as KINDS, RESULTS as RESULTS
from jaxfil.solution import Events as Events, Solution as Solution
from jaxfil.stepper import RK4 as RK4
from jaxfil.sweep import (
    BifurcationDiagram as BifurcationDiagram,
    bifurcation_diagram as bifurcation_diagram,
)
from jaxfil.system import System as System, piecewise as piecewise, smoothed as smoothed

__version__ = "0.1.0"


def __getattr__(name: str):
    # matplotlib is imported with the first use of `jaxfil.plot`, not before.
    if name == "plot":
        return importlib.import_module("jaxfil.plot")
    raise AttributeError(f"module 'jaxfil' has no attribute {name!r}")
