"""Sweeps that are broken off: Ctrl-C, and checkpoints after a kill."""

import dataclasses
import errno
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names
from jaxfil.model.system import System
from jaxfil.sweep import checkpoint, execution, identity, interrupt
from tests import ROOT
from tests.sweep import runs
from tests.sweep.runs import ESTIMATED, X0, sweep


def interrupt_after(monkeypatch, pieces):
    """Press Ctrl-C when so many pieces are finished, and again after the next."""
    finished = []
    before = execution._Lanes.finish

    def piece(*args):
        done = before(*args)
        finished.append(done)
        if len(finished) in (pieces, pieces + 1):
            signal.raise_signal(signal.SIGINT)
        return done

    monkeypatch.setattr(execution, "_cores", lambda: 1)
    monkeypatch.setattr(execution._Lanes, "finish", piece)


@pytest.mark.slow
@pytest.mark.usefixtures("ctrl_c_interrupts")
@pytest.mark.parametrize("follow", [None, "down"])
def test_what_is_done_comes_back_after_ctrl_c(monkeypatch, tmp_path, follow):
    values = np.linspace(0.6, 0.9, 200 if follow is None else 40)
    whole = sweep(values, follow=follow)
    with monkeypatch.context() as patch:
        interrupt_after(patch, 2)
        with pytest.warns(RuntimeWarning, match="[24]0+ lanes are finished.*continues from") as w:
            part = sweep(values, follow=follow, checkpoint=tmp_path)
    assert w[0].filename == runs.__file__
    done = ~(outcome_names(part.results) == "interrupted")
    assert 0 < done.sum() < len(values) and part.successful.sum() == done.sum()
    assert np.all(np.isnan(part.xs[~done]))
    np.testing.assert_array_equal(part.xs[done], whole.xs[done])
    assert eqx.tree_equal(whole, sweep(values, follow=follow, checkpoint=tmp_path))


@pytest.mark.usefixtures("ctrl_c_interrupts")
@pytest.mark.parametrize("pieces, lost", [(2, "samples"), (6, "errors")])
def test_errors_come_back_after_ctrl_c_in_either_run(monkeypatch, tmp_path, pieces, lost):
    values = np.linspace(0.6, 0.9, 200)  # four pieces in each of the two runs
    whole = sweep(values, **ESTIMATED)
    with monkeypatch.context() as patch:
        interrupt_after(patch, pieces)
        with pytest.warns(RuntimeWarning, match=f"the {lost} of the others are NaN; the .* from"):
            part = sweep(values, **ESTIMATED, checkpoint=tmp_path)
    known = np.isfinite(part.errors[:, 0])
    assert known.any() == part.successful.all() == (lost == "errors") and not known.all()
    np.testing.assert_array_equal(part.errors[known], whole.errors[known])
    assert eqx.tree_equal(whole, sweep(values, **ESTIMATED, checkpoint=tmp_path))


def test_a_finished_sweep_is_only_read_when_its_errors_are_asked_for(monkeypatch, tmp_path):
    plain = sweep([0.7, 0.8], **ESTIMATED | {"estimate_error": False}, checkpoint=tmp_path)
    written = []
    before = checkpoint.Checkpoint.write
    monkeypatch.setattr(
        checkpoint.Checkpoint,
        "write",
        lambda self, *args: (written.append(self._path), before(self, *args)),
    )
    asked = sweep([0.7, 0.8], **ESTIMATED, checkpoint=tmp_path)
    assert written == [tmp_path / "half_step"]
    assert eqx.tree_equal(dataclasses.replace(asked, errors=None), plain)
    assert eqx.tree_equal(asked, sweep([0.7, 0.8], **ESTIMATED, checkpoint=tmp_path))
    assert len(written) == 1


KILLED = """
import os, signal, threading
import jax, numpy
jax.config.update("jax_enable_x64", True)
from tests.sweep import runs
from tests.sweep.runs import sweep

# Pieces are written by several threads, and two may be ready at one time.
rename, one_at_a_time, pieces = os.rename, threading.Lock(), []
def killing(source, target):
    with one_at_a_time:
        if "lanes-" in target.name:
            pieces.append(target)
        if len(pieces) == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        rename(source, target)
os.rename = killing
sweep({arguments}, checkpoint={path!r})
"""


@pytest.mark.slow
@pytest.mark.parametrize("follow", [None, "up"])
def test_a_killed_sweep_goes_on_where_it_was(monkeypatch, tmp_path, follow):
    path = str(tmp_path / "checkpoint")
    values = np.linspace(0.6, 0.9, 200 if follow is None else 40)
    arguments = f"numpy.linspace(0.6, 0.9, {len(values)}), follow={follow!r}"
    killed = subprocess.run(
        [sys.executable, "-c", KILLED.format(arguments=arguments, path=path)],
        cwd=ROOT,
        check=False,
    )
    assert killed.returncode == -signal.SIGKILL
    (kept,) = Path(path).glob("lanes-*")
    partial = [name for name in os.listdir(path) if name.startswith(".")]
    assert partial, "the second piece was on its way"
    monkeypatch.setattr(execution, "_cores", lambda: 3)
    ran = []
    before = checkpoint.Checkpoint.write
    monkeypatch.setattr(
        checkpoint.Checkpoint, "write", lambda *args: (ran.append(args[1]), before(*args))
    )
    resumed = sweep(values, follow=follow, checkpoint=path)
    assert int(kept.name.split("-")[1]) not in ran and len(ran) in (2, 3)
    assert eqx.tree_equal(resumed, sweep(values, follow=follow))
    assert not [name for name in os.listdir(path) if name.startswith(".")]


def changed(**fields):
    return eqx.tree_at(
        lambda s: [getattr(s, name) for name in fields],
        jf.systems.SDOscillator(omega=0.7),
        [jnp.asarray(value) for value in fields.values()],
    )


class Other(jf.systems.SDOscillator):
    """Other equations under the same name."""

    def switching(self, t, x):
        return x[0] - 0.1


Other.__name__ = "SDOscillator"

CHANGES = {
    "system.f0 was 0.25 and is 0.26": {"system": changed(f0=0.26)},
    "system was SDOscillator and is BeltFriction": {"system": jf.systems.BeltFriction()},
    r"folder, or .*: equations was \w+ and is \w+\.$": {"system": Other(omega=0.7)},
    "parameter was omega and is zeta": {"parameter": "zeta"},
    "values of omega.1. was 0.8 and is 0.9": {"values": [0.7, 0.9]},
    r"points was \(2,\) and is \(3,\)": {"values": [0.7, 0.8, 0.9]},
    "x0.1. was 0.1 and is 0.2": {"x0": np.array([0.3, 0.2])},
    "x0 was of shape .* and dtype float64 and is .* float32": {"x0": X0.astype(np.float32)},
    "transient was 2 and is 3": {"transient": 3},
    "samples was 2 and is 3": {"samples": 3},
    "steps was 20 and is 21": {"steps": 21},
    "stepper was RK4 and is Dopri8": {"stepper": None},
    "follow was None and is up": {"follow": "up"},
}


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    path = tmp_path_factory.mktemp("begun")
    sweep([0.7, 0.8], checkpoint=path)
    return path


@pytest.mark.parametrize("message", CHANGES)
def test_a_checkpoint_of_other_arguments_is_refused(begun, message):
    with pytest.raises(ValueError, match=r"`checkpoint` must be") as error:
        sweep(**{"values": [0.7, 0.8], **CHANGES[message]}, checkpoint=begun)
    assert re.search(message, str(error.value)), error.value


class Gears(System):
    """A leaf that is no parameter, and a function."""

    omega: jnp.ndarray
    teeth: jnp.ndarray
    force: Callable

    def vector_field(self, t, x, side):
        return self.force(self.teeth * self.omega * t) - x


def test_equations_are_told_apart_by_what_they_compute():
    def equations(omega, teeth, scale):
        system = Gears(jnp.asarray(omega), jnp.asarray(teeth), lambda u: scale * jnp.cos(u))
        return identity.equations(system, X0)

    same = equations(1.0, 3, 0.1)
    assert equations(2.0, 3, 0.1) == same
    assert len({same, equations(1.0, 4, 0.1), equations(1.0, 3, 0.1 + 1e-16)}) == 3


class Geared(System):
    """An integer table of many entries, a Python integer, and a field that is no leaf."""

    table: jnp.ndarray
    count: int
    rule: str = eqx.field(static=True)

    period = 1.0

    def vector_field(self, t, x, side):
        pick = self.table[jnp.clip(jnp.floor(x[:1]).astype(int), 0, self.table.size - 1)]
        sign = {"pull": -1.0, "push": 1.0}[self.rule]
        return sign * (pick + self.count).astype(x.dtype) * x


def test_integers_and_static_fields_are_part_of_the_equations():
    def equations(entry=3, count=2, rule="pull"):
        table = jnp.arange(5000).at[2500].set(entry)
        return identity.equations(Geared(table, count, rule), X0)

    same = equations()
    assert equations() == same
    assert len({same, equations(entry=4), equations(count=3), equations(rule="push")}) == 4


def test_a_checkpoint_of_another_version_is_refused(begun, monkeypatch):
    monkeypatch.setattr("jaxfil.sweep.conditions.__version__", "9.9")
    with pytest.raises(ValueError, match=rf"jaxfil was {jf.__version__} and is 9\.9"):
        sweep([0.7, 0.8], checkpoint=begun)


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ValueError, match=r"must be a new folder.*holds thesis\.tex"):
        sweep([0.7], checkpoint=tmp_path)


def test_a_finished_checkpoint_is_only_read(begun, monkeypatch):
    monkeypatch.setattr(checkpoint.Checkpoint, "write", None)
    assert eqx.tree_equal(sweep([0.7, 0.8], checkpoint=begun), sweep([0.7, 0.8]))


def damage(path, how):
    """What happens to files: to one of a piece, or to two pieces."""
    piece = path / "lanes-0-64.zarr"
    samples = piece / "x/c/0/0/0"
    if how == "a bit":
        content = bytearray(samples.read_bytes())
        content[len(content) // 2] ^= 0x10
        samples.write_bytes(content)
    elif how == "a file lost":
        samples.unlink()
    elif how == "half a file":
        (piece / "zarr.json").write_text((piece / "zarr.json").read_text()[:40])
    elif how == "a bit of an outcome":
        text = (piece / "zarr.json").read_text()
        (piece / "zarr.json").write_text(text.replace('"checksum": "', '"checksum": "0'))
    elif how == "the record":
        text = (path / "sweep.zarr/zarr.json").read_text()
        (path / "sweep.zarr/zarr.json").write_text(text.replace('"transient": 2', '"transient": 6'))
        return "sweep.zarr"
    else:
        other = (
            path / "lanes-64-128.zarr" if how == "swapped" else path.parent / "b/lanes-0-64.zarr"
        )
        other.rename(path / "kept.zarr")
        piece.rename(other)
        (path / "kept.zarr").rename(piece)
        return "lanes-0-64.zarr, lanes-64-128.zarr" if how == "swapped" else "lanes-0-64.zarr"
    return "lanes-0-64.zarr"


HARM = ["a bit", "a file lost", "half a file", "a bit of an outcome", "the record", "swapped"]


@pytest.mark.slow
@pytest.mark.parametrize("how", [*HARM, "another sweep's"])
def test_what_is_damaged_is_named_and_computed_again(tmp_path, how):
    values = np.linspace(0.6, 0.9, 130)
    whole = sweep(values, checkpoint=tmp_path / "a")
    if how == "another sweep's":
        sweep(values + 0.01, checkpoint=tmp_path / "b")
    named = damage(tmp_path / "a", how)
    with pytest.warns(RuntimeWarning, match=rf"are damaged.*again: {named}\.$") as told:
        again = sweep(values, checkpoint=tmp_path / "a")
    assert len(told) == 1 and told[0].filename == runs.__file__
    assert eqx.tree_equal(again, whole)
    assert eqx.tree_equal(sweep(values, checkpoint=tmp_path / "a"), whole)  # without a warning
    assert not [name for name in os.listdir(tmp_path / "a") if name.startswith(".")]


def test_a_full_disk_is_told_in_a_line_and_finished_pieces_stay(monkeypatch, tmp_path):
    values = np.linspace(0.6, 0.9, 200)
    whole, before = sweep(values), checkpoint.dataset_io.write_zarr
    monkeypatch.setattr(execution, "_cores", lambda: 1)

    def full(data, path):
        before(data, path)
        if "lanes-128" in path.name:
            raise OSError(errno.ENOSPC, "No space left on device", str(path / "x/c/0"))

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.dataset_io, "write_zarr", full)
        with pytest.raises(OSError) as error:
            sweep(values, checkpoint=tmp_path)
    assert error.value.errno == errno.ENOSPC
    assert re.fullmatch(
        rf".*No space left on device; what was finished before is kept: '{tmp_path}/lanes-128-192"
        r"\.zarr'",
        str(error.value),
    )
    kept = {path.name for path in tmp_path.iterdir()}
    assert kept - {"lanes-192-200.zarr"} == {"lanes-0-64.zarr", "lanes-64-128.zarr", "sweep.zarr"}
    assert eqx.tree_equal(sweep(values, checkpoint=tmp_path), whole)


TWO = """
import sys
import jax, numpy
jax.config.update("jax_enable_x64", True)
from tests.sweep.runs import sweep
d = sweep(numpy.linspace(0.6, 0.9, 700), checkpoint={path!r})
print(d.xs.tobytes().hex())
"""


@pytest.mark.slow
def test_two_processes_at_one_checkpoint_agree(tmp_path):
    command = [sys.executable, "-c", TWO.format(path=str(tmp_path))]
    both = [subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) for _ in range(2)]
    first, second = (process.communicate()[0] for process in both)
    assert [process.returncode for process in both] == [0, 0]
    whole = sweep(np.linspace(0.6, 0.9, 700))
    assert first == second == f"{whole.xs.tobytes().hex()}\n".encode()


@pytest.mark.usefixtures("ctrl_c_interrupts")
@pytest.mark.parametrize("follow", [None, "up"])
def test_ctrl_c_while_a_sweep_compiles_is_heeded_when_it_is_compiled(monkeypatch, follow):
    before, compiled = execution._compiled_chunk, []

    def pressed(*args):
        signal.raise_signal(signal.SIGINT)
        compiled.append(before(*args))
        return compiled[-1]

    monkeypatch.setattr(execution, "_compiled_chunk", pressed)
    handler = signal.getsignal(signal.SIGINT)
    with pytest.warns(RuntimeWarning, match="0 of 3 lanes are finished"):
        part = sweep([0.6, 0.7, 0.8], follow=follow)
    assert len(compiled) == 1 and np.all(outcome_names(part.results) == "interrupted")
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_handler_of_the_users_own_and_other_threads_are_left_alone():
    pressed = []
    before = signal.signal(signal.SIGINT, lambda *args: pressed.append(args))
    try:
        with interrupt.counted() as interrupts:
            signal.raise_signal(signal.SIGINT)
        assert interrupts.count == 0 and len(pressed) == 1
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with ThreadPoolExecutor() as pool:
            d = pool.submit(sweep, [0.7, 0.8]).result()
        assert d.successful.all()
        with interrupt.counted() as outer, interrupt.counted() as inner:
            signal.raise_signal(signal.SIGINT)
            assert inner is outer and outer.count == 1
        with pytest.raises(RuntimeError), interrupt.counted():
            raise RuntimeError
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
