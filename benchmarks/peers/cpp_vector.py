"""What an expert writes in C++: `cpp_vector.cpp`, compiled for one scene and one method.

In: a scene, frequencies, a method and its steps per period. Out: sampled states. The methods are
the explicit ones of the numba peers, their stages written out, and Taylor series, for which the
scene's fields are differentiated by hand.
"""

import ctypes
import functools
import pathlib
import shutil
import subprocess
import tempfile

import numpy as np

from .numba_scalar import SHAPED, effort, label, method
from .tableaus import TABLEAUS, written_out

__all__ = ["SHAPED", "effort", "label", "method", "missing", "prepare", "sample"]

NAME = "C++ vector"
SOURCE = pathlib.Path(__file__).with_suffix(".cpp")
# Lanes of a pack: WIDTH there.
WIDTH = 8
SETTINGS = [dict(method="rk4", steps=n) for n in (100, 200, 400, 800)]
SETTINGS += [dict(method="dop853", steps=n) for n in (20, 30, 40, 64, 100)]
SETTINGS += [dict(method="taylor12", steps=n) for n in (12, 16, 25, 40, 64, 80)]
# Fast math may regroup sums, those that reduce an angle too: measured errors say if it harms.
FLAGS = ("-std=c++17", "-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512")


def _compiler():
    """GCC, whose vectors the program is written in."""
    return shutil.which("g++")


def missing():
    """Why it cannot run; empty where there is a compiler."""
    return "" if _compiler() else "no g++ is installed"


def prepare(cores):
    """Threads are started as asked for, in each call."""


def step_source(tableau):
    """The lines of `Motion::at` for a Runge–Kutta method; stages at one time share a cosine."""
    lines = written_out(
        tableau,
        "T {force} = p.f0 * cosine(T(omega * (t + {node} * h)));",
        [
            "T z{i} = x1 + h * ({first});",
            "T k{i}1 = x2 + h * ({second});",
            "T k{i}2 = p.field({force}, z{i}, k{i}1, s);",
        ],
        [
            "y1 = x1 + h * ({first});",
            "y2 = x2 + h * ({second});",
            "e2 = p.field({force}, y1, y2, s);",
        ],
    )
    return "\n".join(["T k01 = x2, k02 = d2;", *lines])


@functools.cache
def kernel(kind, method):
    """The compiled function of all lanes for one scene and method."""
    with tempfile.TemporaryDirectory() as folder:
        library, step = (pathlib.Path(folder) / name for name in ("lanes.so", "step.h"))
        chosen = ["-DBELT"] if kind == "belt" else []
        if method in TABLEAUS:
            step.write_text(step_source(TABLEAUS[method]))
            chosen.append(f'-DSTEP="{step}"')
        else:
            chosen.append(f"-DORDER={method.removeprefix('taylor')}")
        linked = ("-shared", "-fPIC", "-pthread", str(SOURCE), "-o", str(library))
        subprocess.run([_compiler(), *FLAGS, *chosen, *linked], check=True)
        return ctypes.CDLL(str(library)).lanes


def _numbers(array):
    """The array as C takes it."""
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def sample(scene, omegas, transient, samples, setting, cores=1):
    """States at the end of the last `samples` periods, (lanes, samples, 2)."""
    asked = len(omegas)
    packs = -(-asked // WIDTH)
    filled = np.minimum(np.arange(packs * WIDTH), asked - 1)
    omegas = np.ascontiguousarray(omegas, dtype=float)[filled]
    spans = np.array([scene.period(omega) for omega in omegas])
    out = np.empty((len(omegas), samples, 2))
    constants, start = np.array(scene.constants()), np.array(scene.x0)
    run = kernel(scene.kind, setting["method"])
    inputs = (_numbers(v) for v in (constants, omegas, spans))
    sizes = (setting["steps"], _numbers(start), transient, samples)
    run(*inputs, packs, *sizes, _numbers(out), cores)
    return out[:asked]
