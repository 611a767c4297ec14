"""Differentiable, batched simulation and bifurcation analysis of nonsmooth systems in JAX.

`__init__.pyi` lists the public names. Each is imported on first use, because JAX takes a second to
import and the command line often does not need it.
"""

import importlib
import os
import signal
import sys
from types import ModuleType

# `python -m jaxfil` runs this file first: Ctrl-C ends it silently during loading.
_is_command = sys.argv[:1] == ["-m"] and "jaxfil" in sys.orig_argv
if _is_command and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(130))

import lazy_loader

from jaxfil.model import drawing

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def _plot() -> ModuleType:
    # matplotlib is imported with the first picture.
    return importlib.import_module("jaxfil.plot")


drawing.use(_plot)


def __getattr__(name: str):
    if name not in __all__:
        raise AttributeError(f"module 'jaxfil' has no attribute {name!r}")
    return _attribute(name)
