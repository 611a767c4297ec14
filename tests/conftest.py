"""Every test runs in float64, with strict type promotion.

The folders mirror those of the package: `tests/orbits` tests `jaxfil/orbits`, and a file is called
after the file or the noun that it tests. `tests/project` holds what is about the project as a whole
(layout, README, notebooks, gallery, paper, programs of the benchmarks). One room is run by its
folder, `python -m pytest tests/orbits`, the quick tests of it by `-m "not slow"` besides. What only
a release must pass is marked `release`: notebooks, figures, long comparisons with exact motions,
and the dearest tests, most of them beside a cheaper one of the same property.

What several rooms use is here: `problems`, a bank of problems with known answers, by name and by
tag; `oracles`, exact motions and other things to compare with; `results`, what is done with a
solution; `pictures`, a picture of each kind, and their references.
"""

import gc
import os
import resource
import signal
import sys
from pathlib import Path

import equinox as eqx
import jax
import pytest

# Files compile much that others have compiled, and so do the processes that tests start.
_TESTS = Path(__file__).resolve().parent
_PROGRAMS = _TESTS.parent / ".pytest_cache" / "compiled"
_KEPT = os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_PROGRAMS))
_LEAST = os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
jax.config.update("jax_compilation_cache_dir", _KEPT)
jax.config.update("jax_persistent_cache_min_compile_time_secs", float(_LEAST))
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
pytest.register_assert_rewrite("tests.results")


# Tracing makes objects by the million, and few of them are garbage in circles: looking for these
# as often as Python does by itself takes a tenth of it.
gc.set_threshold(100_000, 50, 50)

# Compiling takes half of the tests' time, and a third of that goes into making programs fast that
# run once: they are told not to, as JAX's own tests are. What is about the vectors that lanes are
# put into, compares programs to the last bit, or runs for longer than it compiles (marked
# `long_run`) is compiled as it is for users, and so is everything if the environment says
# JAX_DISABLE_MOST_OPTIMIZATIONS=0.
_OPTIMIZED = (
    "sweep/test_checkpoint.py",
    "sweep/test_multiprocess.py",
    "sweep/test_section_diagram.py",
    "sweep/test_sweep.py",
    "xla",
    "integrate/loop/test_batch_loop.py",
    "integrate/loop/test_kept_mode.py",
    "integrate/system/test_compact.py",
    "integrate/system/test_pay_for_use.py",
)
_CHOSEN = os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS")
# Of each small kernel XLA's CPU backend makes a program of MLIR, with a compiler of its own that
# takes 20 ms, however small the kernel. The emitter that makes the one kernel of a loop can make
# these too, in half the time; it does so in all files, for XLA reads its flags once. One that it
# does not know ends the process: later versions, which may do without it, are not given this one.
if _CHOSEN is None and (0, 7) <= jax.__version_info__ < (0, 11):
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"--xla_cpu_use_fusion_emitters=false {flags}"

_UNIT = 1 if sys.platform == "darwin" else 1024
_MEMORY = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
# Half of the machine's memory may be that of compiled programs, but no more than they ever need.
_MOST = min(6 * 2**30, _MEMORY / 2 / int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))


def _is_optimized(item):
    if item.get_closest_marker("long_run") is not None:
        return True
    return any(item.path.is_relative_to(_TESTS / part) for part in _OPTIMIZED)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """What is for a release is slow; what is compiled in the same way runs one after the other."""
    for item in items:
        if item.get_closest_marker("release") is not None:
            item.add_marker("slow")
    items.sort(key=_is_optimized)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """A program that is compiled one way is not run by a test that asks for the other."""
    asked = _is_optimized(item)
    if _CHOSEN is None and jax.config.read("jax_disable_most_optimizations") == asked:
        _forget_programs()
        jax.config.update("jax_disable_most_optimizations", not asked)


@pytest.fixture(autouse=True, scope="module")
def compiled_programs_end_before_memory_does():
    """Files share what is compiled until it takes gigabytes, and from then on no more."""
    yield
    if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT > _MOST:
        _forget_programs()


def _forget_programs():
    jax.clear_caches()
    eqx.clear_caches()
    gc.collect()


@pytest.fixture
def ctrl_c_interrupts():
    """Ctrl-C does, also in a test that a shell has started in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
