"""Files of all kinds are written from one description of the data."""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import jaxfil as jf
from jaxfil.model import dataset_io
from jaxfil.model.dataset_io import NamedArrays
from jaxfil.model.outcomes import outcome_names

X0 = jnp.array([0.3, 0.1])
RUN = {"transient": 2, "samples": 2, "steps": 20, "stepper": jf.RK4(), "progress": False}


class Clashing(jf.System):
    """Parameters with the names that an .npz has for other things."""

    omega: jax.Array
    values: jax.Array
    xs: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.cos(self.omega * t) - self.values * x[0] - self.xs * x[1]])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def saved(diagram, path):
    diagram.save(path)
    with np.load(path) as data:  # without pickles
        return dict(data)


class Matrix(jf.System):
    """x' = a x + (cos t, 0)."""

    a: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return self.a @ x + jnp.stack([jnp.cos(t), 0.0])


@pytest.mark.parametrize("estimate_error", [False, True])
def test_an_npz_has_the_names_of_the_fields(tmp_path, estimate_error):
    diagram = jf.bifurcation_diagram(
        jf.systems.SDOscillator(), "omega", [0.7, 0.8], X0, **RUN, estimate_error=estimate_error
    )
    data = saved(diagram, tmp_path / "a.npz")
    assert_array_equal(data["values"], diagram.values)
    assert_array_equal(data["xs"], diagram.xs)
    assert_array_equal(data["results"], outcome_names(diagram.results))
    assert_array_equal(data["x0"], X0)
    assert (data["parameter"], data["system"], data["steps"]) == ("omega", "SDOscillator", 20)
    assert ("errors" in data) == estimate_error
    assert data["component"].tolist() == ["x", "x'"]


def test_an_npz_of_a_grid_has_an_array_for_each_parameter(tmp_path):
    diagram = jf.bifurcation_diagram(
        jf.systems.SDOscillator(), ("omega", "f0"), ([0.7, 0.8, 0.9], [0.2, 0.25]), X0, **RUN
    )
    data = saved(diagram, tmp_path / "a.npz")
    assert data["xs"].shape == (3, 2, 2, 2) and "values" not in data
    assert_array_equal(data["omega"], diagram.values[0])
    assert_array_equal(data["f0"], diagram.values[1])


def test_a_parameter_with_the_name_of_something_else_is_not_lost(tmp_path):
    system = Clashing(jnp.array(1.3), jnp.array(0.4), jnp.array(0.1))
    diagram = jf.bifurcation_diagram(system, "omega", [1.2, 1.3], X0, **RUN)
    data = saved(diagram, tmp_path / "a.npz")
    assert_array_equal(data["values"], diagram.values)
    assert (data["values_"], data["xs_"]) == (0.4, 0.1)
    diagram = jf.bifurcation_diagram(system, "values", [0.4, 0.5], X0, **RUN)
    assert_array_equal(saved(diagram, tmp_path / "a.npz")["values"], [0.4, 0.5])


def test_all_kinds_of_files_hold_the_same(tmp_path):
    data = NamedArrays(
        {"x": (("t", "component"), np.array([[1.0, -0.0], [np.nan, np.inf]]))},
        {"component": ("component", np.array(["q", "v"]))},
        {"steps": 20},
    )
    for suffix in (".nc", ".zarr", ".npz"):
        dataset_io.save(data, tmp_path / f"a{suffix}")
    for suffix in (".nc", ".zarr", ".npz"):
        back = dataset_io.load(tmp_path / f"a{suffix}")
        assert back.array("x").tobytes() == data.array("x").tobytes()
        assert back.array("component").tolist() == ["q", "v"]
        assert [*back.variables["x"][0]] == ["t", "component"] and back.attributes == {"steps": 20}


def test_an_npz_is_loaded_without_xarray(tmp_path, monkeypatch):
    system = Clashing(jnp.array(1.3), jnp.array(0.4), jnp.array(0.1))
    diagram = jf.bifurcation_diagram(system, "omega", [1.2, 1.3], X0, **RUN)
    diagram.save(tmp_path / "a.npz")
    monkeypatch.setitem(sys.modules, "xarray", None)
    assert eqx.tree_equal(jf.load(tmp_path / "a.npz"), diagram)


def test_an_entry_of_an_array_may_be_named_with_spaces(tmp_path):
    system = Matrix(jnp.array([[-0.5, 0.8], [-1.2, -0.7]]))
    diagram = jf.bifurcation_diagram(system, "a[1, 0]", [-1.2, -0.3], X0, **RUN)
    diagram.save(tmp_path / "a.npz")
    back = jf.load(tmp_path / "a.npz")
    assert back.parameter == "a[1, 0]"
    assert_array_equal(back.xs, diagram.xs)
