"""One sweep in two processes on this machine, through JAX's own runtime, against one process."""

import socket
import subprocess
import sys

import jax
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import jaxfil as jf
from jaxfil.sweep import multiprocess
from tests import ROOT

X0 = np.array([0.3, 0.1])
VALUES = np.linspace(0.6, 0.9, 300)  # five chunks: three for one process, two for the other
SCRIPT = """
import sys
import jax
from tests.sweep.test_multiprocess import answers, sweep  # jaxfil, too, is imported before
jax.config.update("jax_enable_x64", True)
port, index, out = sys.argv[1:]
jax.distributed.initialize(f"127.0.0.1:{port}", 2, int(index))
answers(out, index)
try:
    sweep(transient=2 + int(index))
except AssertionError as error:
    print(error)
"""


def sweep(values=VALUES, **kwargs):
    run = {"transient": 2, "samples": 2, "steps": 20, "stepper": jf.RK4(), "progress": False}
    system = jf.systems.SDOscillator()
    return jf.bifurcation_diagram(system, "omega", values, X0, **run | kwargs)


def answers(out, index):
    """What a process finds; each writes it, and leaves its chunks in the same checkpoint."""
    whole = sweep(checkpoint=f"{out}/checkpoint")
    follow = sweep(VALUES[:20], follow="up")
    assert jax.process_index() == int(index) and jax.process_count() == 2
    np.savez(
        f"{out}/{index}.npz",
        whole=whole.xs,
        successful=whole.successful,
        follow=follow.xs,
        zeros=multiprocess.from_first(np.array([-0.0, 0.0]) if index == "0" else np.ones(2)),
    )


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@pytest.mark.slow
def test_two_processes_find_what_one_finds(tmp_path):
    port = str(free_port())
    both = [
        subprocess.Popen(
            [sys.executable, "-c", SCRIPT, port, str(index), str(tmp_path)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for index in range(2)
    ]
    told = [process.communicate(timeout=120)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], told
    assert all("All processes must call with the same arguments" in text for text in told)
    one, follow = sweep(), sweep(VALUES[:20], follow="up")
    for index in range(2):
        with np.load(tmp_path / f"{index}.npz") as two:
            assert_array_equal(two["whole"], one.xs)
            assert_array_equal(two["successful"], one.successful)
            assert_array_equal(two["follow"], follow.xs)
            assert two["zeros"].tobytes() == np.array([-0.0, 0.0]).tobytes()
    assert len(list((tmp_path / "checkpoint").glob("lanes-*"))) == 5
    # One process goes on where two left off.
    assert_array_equal(sweep(checkpoint=tmp_path / "checkpoint").xs, one.xs)
