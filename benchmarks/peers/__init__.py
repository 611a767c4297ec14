"""The integrators that are measured, one a file, all behind the same few names.

Each module offers

- `NAME`: how the tables call it;
- `SETTINGS`: accuracy settings, cheap to dear within a method, each a dict that JSON can hold;
- `SHAPED`: whether another number of lanes compiles anew;
- `missing()`: why it cannot run, in words; empty where it can;
- `prepare(cores)`: called once in a process, before anything else;
- `label(setting)` and `method(setting)`: the setting in a few letters, and its method;
- `effort(quick)`: the most lanes it is asked for at a time (None: as many as you like);
- `sample(scene, omegas, transient, samples, setting, cores=1) -> xs (lanes, samples, 2)`:
  the states at the end of each of the last `samples` periods, every lane started from `scene.x0`
  at t = 0.
"""

import importlib

MODULES = (
    "jaxfil_sweep",
    "numba_scalar",
    "numba_vector",
    "cpp_vector",
    "heyoka_batch",
    "diffrax_events",
    "scipy_events",
)


def load(name):
    """The module of one integrator."""
    return importlib.import_module(f"{__name__}.{name}")
