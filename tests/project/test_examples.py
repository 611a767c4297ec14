"""Examples run as they are pasted into a fresh Python: see `tests.project.examples`."""

import os
import subprocess
import sys

import pytest

from tests import ROOT
from tests.project.examples import NAMES


def run(folder, *names, code="from tests.project.examples import main; main()"):
    """What the program prints of some names, and its exit status."""
    set_up = {"JAX_ENABLE_X64", "JAX_NUMPY_DTYPE_PROMOTION"}
    env = {k: v for k, v in os.environ.items() if k not in set_up}
    env |= {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code, *names], env=env, cwd=folder, capture_output=True, text=True
    )
    return done.stdout + done.stderr, done.returncode


# The examples are dealt out to as many programs, so that several run at a time.
_PROGRAMS = 8


@pytest.mark.release
@pytest.mark.parametrize("part", range(_PROGRAMS))
def test_all_examples_run_where_nothing_is_set(part, tmp_path):
    told, status = run(tmp_path, *NAMES[part::_PROGRAMS])
    assert status == 0, told


PLANTED = """
import jaxfil as jf
from tests.project import examples

def planted():
    '''
    >>> import jax.numpy as jnp
    >>> jnp.zeros(1).dtype
    dtype('float64')
    '''

examples.DOCUMENTED["planted"] = planted
examples.main()
"""


@pytest.mark.slow
def test_an_example_that_needs_another_precision_is_seen(tmp_path):
    assert run(tmp_path, "jaxfil.EventKind") == ("", 0)
    told, status = run(tmp_path, "planted", code=PLANTED)
    assert status == 1 and "dtype('float32')" in told
