"""Differentiable, batched simulation and bifurcation analysis of nonsmooth systems in JAX.

What is public is listed in `__init__.pyi`. Each name is imported when it is first used: JAX takes a
second to import, and the command line answers much without it.
"""

import importlib
import os
import signal
import sys
from types import ModuleType

# `python -m jaxfil` comes here before its own file: Ctrl-C ends it without a word while it loads.
_is_command = sys.argv[:1] == ["-m"] and "jaxfil" in sys.orig_argv
if _is_command and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(130))

import lazy_loader

from jaxfil.model import drawing

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def _plot() -> ModuleType:
    # matplotlib is imported with the first picture, not before.
    return importlib.import_module("jaxfil.plot")


drawing.use(_plot)


def __getattr__(name: str):
    if name not in __all__:
        raise AttributeError(f"module 'jaxfil' has no attribute {name!r}")
    return _attribute(name)
