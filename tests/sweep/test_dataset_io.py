"""Diagrams as named arrays and as files: every bit comes back."""

import dataclasses
import shutil
import sys
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from jax import Array

import jaxfil as jf
from jaxfil.model.outcomes import outcome_codes
from jaxfil.model.system import System
from tests.sweep.runs import ESTIMATED, X0, sweep


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
    assert data["outcome_code"].dims == data["outcome"].dims == ("omega",)
    assert data.attrs == {
        "jaxfil_type": "BifurcationDiagram",
        "system": "SDOscillator",
        "swept": "omega",
        "f0": 0.25,
        "zeta": 0.0141,
        "transient": 2,
        "steps": 20,
        "stepper": "RK4",
        "follow": "up",
        "jaxfil_version": jf.__version__,
        "compact": 1,
        "symbols": '{"alpha": "α", "f0": "f₀", "omega": "Ω", "zeta": "ζ"}',
    }


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


@pytest.mark.slow
@pytest.mark.parametrize("make", DIAGRAMS.values(), ids=DIAGRAMS)
def test_what_is_saved_comes_back(make, tmp_path):
    diagram = make()
    for path in (tmp_path / "sweep.nc", str(tmp_path / "sweep.zarr"), tmp_path / "sweep.npz"):
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
    for suffix in (".nc", ".zarr", ".npz"):
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
    for name in ("foreign.nc", "foreign.npz"):
        (tmp_path / name).write_bytes(b"no archive")
        with pytest.raises(ValueError, match=r"foreign\.np?[cz]' is not one, or is damaged"):
            jf.load(tmp_path / name)
    xarray.Dataset({"x": ("omega", [1.0])}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(ValueError, match=r"other\.nc' has no jaxfil_version, outcome, stepper"):
        jf.load(tmp_path / "other.nc")
    xarray.Dataset(attrs={"jaxfil_type": "Ring"}).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with pytest.raises(ValueError, match=r"a\.nc' is a Ring"):
        jf.load(tmp_path / "a.nc")
    np.savez(tmp_path / "other.npz", x=1.0)
    with pytest.raises(ValueError, match=r"other\.npz' has no jaxfil_contents"):
        jf.load(tmp_path / "other.npz")
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r"need the package zarr: pip install 'jaxfil\[xarray\]'"):
        d.save(tmp_path / "a.zarr")


def is_read(path, diagram):
    """Whether a file is read, as the diagram, and not refused."""
    try:
        found = jf.load(path)
    except ValueError as error:
        assert "is not one, or is damaged" in str(error)
        return False
    assert eqx.tree_equal(found, diagram)
    return True


def test_a_damaged_file_is_refused_or_holds_the_same(tmp_path):
    """Every 25th byte of an archive in turn, or a byte in the middle of each number of a netCDF
    file, and files that are cut off."""
    d = sweep([0.7, 0.8])
    for suffix in (".npz", ".nc"):
        path = tmp_path / f"a{suffix}"
        d.save(path)
        content = path.read_bytes()
        places = range(0, len(content), 25)
        if suffix == ".nc":
            places = [content.index(x.tobytes()) + 4 for x in d.xs.ravel()]
        damaged = [content[:i] + bytes([content[i] ^ 255]) + content[i + 1 :] for i in places]
        cut = [content[: len(content) * part // 100] for part in (0, 10, 50, 90, 99)]
        counts = np.zeros(2, int)
        for data in (*damaged, *cut):
            path.write_bytes(data)
            counts[int(is_read(path, d))] += 1
        assert counts[0] > 0 and (suffix == ".npz" or counts[1] == 0)


@pytest.mark.parametrize("array", ["x", "omega", "outcome"])
def test_a_store_that_has_lost_a_part_of_an_array_is_refused(array, tmp_path):
    d, path = sweep([0.7, 0.8]), tmp_path / "a.zarr"
    d.save(path)
    assert is_read(path, d)
    chunk = next(v for v in (path / array / "c").rglob("*") if v.is_file())
    chunk.write_bytes(chunk.read_bytes()[:-3])
    assert not is_read(path, d)
    shutil.rmtree(path / array / "c")
    assert not is_read(path, d)


def test_an_outcome_of_another_version_is_named():
    with pytest.raises(ValueError, match=r"An outcome must be one of successful, .*got 'tired'"):
        outcome_codes(np.array(["successful", "tired"]))


class Fourier(System):
    """x' = −c x + a_0 + a[0] cos t + a[1] cos 2t."""

    c: Array
    a_0: Array
    a: Array
    period = 2 * np.pi
    units: ClassVar = {"c": "c", "a_0": "seconds"}

    def vector_field(self, t, x, side):
        waves = self.a[0] * jnp.cos(t) + self.a[1] * jnp.cos(2 * t)
        return jnp.stack([-self.c * x[0] + self.a_0 + waves])


@pytest.mark.parametrize("name, ending", [("a_0", "nc"), ("c", "npz")])
def test_names_and_units_of_parameters_are_no_names_of_the_dataset(name, ending, tmp_path):
    """A dimension of `a` is not called a_0, a unit may be equal to its parameter, and a quantity in
    seconds is no time of a calendar."""
    system = Fourier(jnp.array(1.0), jnp.array(0.5), jnp.array([1.0, 0.2]))
    run = {"transient": 2, "samples": 2, "steps": 20, "stepper": jf.RK4(), "progress": False}
    diagram = jf.bifurcation_diagram(
        system, name, np.array([0.5, 1.0, 1.5]), jnp.zeros(1), checkpoint=tmp_path / "kept", **run
    )
    diagram.save(tmp_path / f"diagram.{ending}")
    back = jf.load(tmp_path / f"diagram.{ending}")
    np.testing.assert_array_equal(back.values, diagram.values, strict=True)
    np.testing.assert_array_equal(back.xs, diagram.xs, strict=True)
    parameters = back.conditions.parameters
    np.testing.assert_array_equal(parameters["a"], [1.0, 0.2], strict=True)
    assert back.labels == diagram.labels
