"""Diagrams that are kept: named arrays, files, Ctrl-C, and checkpoints after a kill."""

import dataclasses
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import jaxfil as jf
from jaxfil.model.outcomes import outcome_codes, outcome_names
from jaxfil.model.system import System
from jaxfil.sweep import checkpoint, execution
from tests import ROOT

X0 = np.array([0.3, 0.1])


def sweep(values, parameter="omega", x0=X0, **kwargs):
    run = {"transient": 2, "samples": 2, "steps": 20, "stepper": jf.RK4(), "progress": False}
    system = kwargs.pop("system", jf.systems.SDOscillator(omega=0.7))
    return jf.bifurcation_diagram(system, parameter, values, x0, **run | kwargs)


class Named(System):
    """Parameters with the names of other things, and of every shape."""

    x: jnp.ndarray
    steps: jnp.ndarray
    matrix: jnp.ndarray

    def vector_field(self, t, x, side):
        return -self.matrix @ x + self.x * jnp.cos(self.steps * t)

    @property
    def period(self):
        return 2 * jnp.pi / self.steps


def named():
    return Named(jnp.asarray(0.1), jnp.asarray(2.0), jnp.asarray([[1.0, 0.5], [-0.0, 1.5]]))


def test_the_dataset_says_what_it_is():
    data = sweep([0.7, np.nan], follow="up").to_xarray()
    assert data["x"].dims == ("omega", "sample", "component")
    assert data["outcome"].values.tolist() == ["successful", "nonfinite"]
    np.testing.assert_array_equal(data["omega"], [0.7, np.nan])
    np.testing.assert_array_equal(data.attrs.pop("x0"), X0)
    assert data.attrs == {
        "system": "SDOscillator",
        "swept": "omega",
        "f0": 0.25,
        "zeta": 0.0141,
        "transient": 2,
        "steps": 20,
        "stepper": "RK4",
        "follow": "up",
        "jaxfil_version": jf.__version__,
    }


ESTIMATED = {"estimate_error": True, "steps": 10}
DIAGRAMS = {
    "a line": lambda: sweep([0.7, np.nan, 0.8]),
    "a line in float32": lambda: sweep([0.7, 0.8], x0=X0.astype(np.float32)),
    "following": lambda: sweep([0.7, 0.8], follow="down"),
    "a state for each lane": lambda: sweep([0.7, 0.8], x0=np.stack([X0, -X0])),
    "names of other things": lambda: sweep([0.1, 0.0], "x", system=named()),
    "a grid": lambda: sweep(([0.7, 0.8, 0.9], [0.2, 0.25]), ("omega", "f0")),
    "errors of a line": lambda: sweep([0.7, np.nan, 0.8], **ESTIMATED),
    "errors of a grid": lambda: sweep(([0.7, 0.8, 0.9], [0.2]), ("omega", "f0"), **ESTIMATED),
    "points": lambda: sweep(np.array([[0.7, 0.2], [0.8, 0.3]]), ("omega", "f0")),
}


@pytest.mark.parametrize("make", DIAGRAMS.values(), ids=DIAGRAMS)
def test_what_is_saved_comes_back(make, tmp_path):
    diagram = make()
    for path in (tmp_path / "sweep.nc", str(tmp_path / "sweep.zarr")):
        diagram.save(path)
        back = jf.load(path)
        assert eqx.tree_equal(
            *(dataclasses.replace(d, values=0, xs=0, errors=0) for d in (diagram, back))
        )
        for a, b in zip(arrays(diagram), arrays(back), strict=True):
            assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        back.save(path)


def arrays(diagram):
    values = diagram.values if isinstance(diagram.values, tuple) else (diagram.values,)
    return *values, diagram.xs, np.zeros(0) if diagram.errors is None else diagram.errors


def test_the_dataset_has_the_errors_of_each_lane():
    d = sweep([0.7, 0.8], **ESTIMATED)
    data = d.to_xarray()
    assert data["error"].dims == ("omega", "component")
    np.testing.assert_array_equal(data["error"].sel(omega=0.8), d.errors[1])
    assert "error" not in sweep([0.7]).to_xarray()


def test_every_bit_is_kept(tmp_path):
    strange = np.array([-0.0, np.inf, -np.inf, np.nan, 5e-324, 0.1]).reshape(1, 3, 2)
    diagram = dataclasses.replace(sweep([0.7]), xs=strange)
    zeros = dataclasses.replace(diagram, xs=np.full((1, 3, 2), -0.0))
    for suffix in (".nc", ".zarr"):
        for d in (diagram, zeros):
            d.save(tmp_path / f"a{suffix}")
            assert jf.load(tmp_path / f"a{suffix}").xs.tobytes() == d.xs.tobytes()


def test_files_are_xarrays_own(tmp_path):
    d = sweep([0.7, 0.8])
    d.save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc") as data:
        np.testing.assert_array_equal(data["x"].sel(omega=0.8, component="x'"), d.xs[1, :, 1])


def test_bad_paths(tmp_path, monkeypatch):
    d = sweep([0.7, 0.8])
    with pytest.raises(ValueError, match=r"`path` must end in \.nc, \.zarr or \.npz, got .*a\.h5'"):
        d.save(tmp_path / "a.h5")
    with pytest.raises(FileNotFoundError, match=r"a file that `save` has written, got .*nowhere"):
        jf.load(tmp_path / "nowhere.nc")
    xarray.Dataset({"x": ("omega", [1.0])}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(ValueError, match=r"other\.nc' has no jaxfil_version, outcome, stepper"):
        jf.load(tmp_path / "other.nc")
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r"need the package zarr: pip install 'jaxfil\[xarray\]'"):
        d.save(tmp_path / "a.zarr")


def test_an_outcome_of_another_version_is_named():
    with pytest.raises(ValueError, match=r"An outcome must be one of successful, .*got 'tired'"):
        outcome_codes(np.array(["successful", "tired"]))


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


@pytest.fixture
def ctrl_c_interrupts():
    """It does not in what a shell has started in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c_interrupts")
@pytest.mark.parametrize("follow", [None, "down"])
def test_what_is_done_comes_back_after_ctrl_c(monkeypatch, tmp_path, follow):
    values = np.linspace(0.6, 0.9, 200 if follow is None else 40)
    whole = sweep(values, follow=follow)
    with monkeypatch.context() as patch:
        interrupt_after(patch, 2)
        with pytest.warns(RuntimeWarning, match="of [24]0+ lanes are finished.*goes on from") as w:
            part = sweep(values, follow=follow, checkpoint=tmp_path)
    assert w[0].filename == __file__
    done = outcome_names(part.results) != "interrupted"
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
import os, signal
import jax, numpy
jax.config.update("jax_enable_x64", True)
from tests.sweep.test_checkpoint import sweep

rename, pieces = os.rename, []
def killing(source, target):
    if "lanes-" in target.name:
        pieces.append(target)
    if len(pieces) == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    rename(source, target)
os.rename = killing
sweep({arguments}, checkpoint={path!r})
"""


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
        return checkpoint.equations(system, X0)

    same = equations(1.0, 3, 0.1)
    assert equations(2.0, 3, 0.1) == same
    assert len({same, equations(1.0, 4, 0.1), equations(1.0, 3, 0.1 + 1e-16)}) == 3


def test_a_checkpoint_of_another_version_is_refused(begun, monkeypatch):
    monkeypatch.setattr("jaxfil.sweep.sweep.__version__", "9.9")
    with pytest.raises(ValueError, match=rf"jaxfil was {jf.__version__} and is 9\.9"):
        sweep([0.7, 0.8], checkpoint=begun)


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ValueError, match=r"must be a new folder.*holds thesis\.tex"):
        sweep([0.7], checkpoint=tmp_path)


def test_a_finished_checkpoint_is_only_read(begun, monkeypatch):
    monkeypatch.setattr(checkpoint.Checkpoint, "write", None)
    assert eqx.tree_equal(sweep([0.7, 0.8], checkpoint=begun), sweep([0.7, 0.8]))
