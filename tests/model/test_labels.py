"""Names, symbols and units of a system: in every picture, in named arrays and in files."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.labels import Labels, labels_of
from tests.pictures import made

matplotlib.use("Agg")

X0 = jnp.array([0.3, 0.1])


class Named(jf.System):
    """A forced, damped oscillator with dry friction, all in SI units."""

    omega: jax.Array
    force: jax.Array

    state_names = "q", "v"
    symbols = {"force": "F₀", "omega": "Ω"}
    units = {"q": "m", "v": "m/s", "omega": "rad/s", "t": "s"}

    def vector_field(self, t, x, side):
        push = self.force * jnp.cos(self.omega * t)
        return jnp.stack([x[1], push - x[0] - 0.4 * x[1] - 0.1 * side])

    def switching(self, t, x):
        return x[1]

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


NAMED = Named(jnp.array(1.3), jnp.array(0.5))


class Plain(Named):
    state_names = ()
    symbols = {}
    units = {}


def labels(ax):
    return ax.get_xlabel(), ax.get_ylabel()


def axes():
    return jf.plot.page().add_subplot()


def conditions(diagram):
    """The title of new axes."""
    ax = diagram.plot()
    plt.close(ax.figure)
    return ax.texts[-1].get_text()


def swept(system, name="omega", values=(1.2, 1.3)):
    run = {"transient": 2, "samples": 2, "steps": 20, "stepper": jf.RK4(), "progress": False}
    return jf.bifurcation_diagram(system, name, values, X0, **run)


@pytest.fixture(scope="module")
def orbits():
    """The same orbit of the named system and of the one without names."""
    return [
        jf.periodic_orbit(system, X0, steps=20, stepper=jf.RK4(), transient=20)
        for system in (NAMED, Plain(NAMED.omega, NAMED.force))
    ]


@pytest.mark.release
def test_pictures_of_an_orbit_and_its_branch_say_what_the_system_calls_things(orbits):
    named, plain = orbits
    assert labels(named.plot(axes())) == ("q, m", "v, m/s")
    assert labels(plain.plot(axes())) == ("x[0]", "x[1]")
    path = named.trajectory()
    assert labels(jf.plot.time_history(path, axes(), components=1)) == ("t, s", "v, m/s")
    branch = made(
        jf.Branch,
        parameter="omega",
        values=np.arange(2.0),
        orbits=SimpleNamespace(x0=np.zeros((2, 2)), system=NAMED),
        extremes=lambda self: (np.zeros((2, 2)), np.ones((2, 2))),
        stable=np.ones(2, bool),
        points=[],
    )
    assert labels(jf.plot.branch(branch, axes())) == ("Ω, rad/s", "q at t0, m")
    extremes = jf.plot.branch(branch, axes(), component=1, extremes=True)
    assert labels(extremes) == ("Ω, rad/s", "least and largest v, m/s")


@pytest.mark.slow
def test_pictures_of_sweeps_say_what_the_system_calls_things():
    diagram = swept(NAMED)
    assert labels(diagram.plot(axes())) == ("Ω, rad/s", "q once a period, m")
    assert conditions(diagram).startswith("Named: F₀ = 0.5; ")
    plain = swept(Plain(NAMED.omega, NAMED.force))
    assert labels(plain.plot(axes(), component=1)) == ("omega", "x[1] once a period")
    section = jf.plot.poincare_section(diagram.xs, axes(), system=NAMED)
    assert labels(section) == ("q, m", "v, m/s")
    assert labels(jf.plot.poincare_section(diagram.xs, axes())) == ("x[0]", "x[1]")
    plane = swept(NAMED, ("omega", "force"), ([1.2, 1.3], [0.4, 0.5]))
    assert labels(plane.plot(axes())) == ("Ω, rad/s", "F₀")
    run = {"transient": 2, "samples": 2, "steps": 20, "stepper": jf.RK4(), "progress": False}
    found = jf.basins_of_attraction(NAMED, ([0.0, 0.1], [0.0, 0.1]), **run)
    assert found.attractors == (), "no attractor: the legend has no name of one"
    assert labels(found.plot(axes())) == ("q at t = 0, m", "v at t = 0, m/s")


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_named_arrays_have_the_names_and_keep_them(tmp_path, suffix):
    diagram = swept(NAMED)
    data = diagram.to_xarray()
    np.testing.assert_array_equal(data["x"].sel(component="v"), diagram.xs[..., 1])
    assert data["unit"].values.tolist() == ["m", "m/s"]
    assert data["omega"].attrs == {"long_name": "Ω", "units": "rad/s"}
    diagram.save(tmp_path / f"named{suffix}")
    back = jf.load(tmp_path / f"named{suffix}")
    assert eqx.tree_equal(diagram, back) and back.labels == diagram.labels
    assert labels(back.plot(axes())) == ("Ω, rad/s", "q once a period, m")
    assert conditions(back) == conditions(diagram)


def test_a_smoothed_system_with_a_field_that_is_no_number():
    smooth = labels_of(jf.smoothed(jf.systems.SDOscillator(), 0.1), 2)  # its alpha is None
    assert ("system.omega", "Ω") in smooth.symbols


def test_a_smoothed_system_has_the_names_of_its_own():
    smooth = labels_of(jf.smoothed(NAMED, 0.1), 2)
    assert smooth.component(1) == "v, m/s" and smooth.time == "t, s"
    assert smooth.parameter("system.omega") == "Ω, rad/s"
    assert smooth.parameter("width") == "width"


def test_every_textbook_system_names_its_state_and_only_that_in_si_has_units():
    for system, x0 in jf.systems.TEXTBOOK.values():
        told = labels_of(system(), len(x0))
        assert len(told.state) == len(x0)
        assert bool(told.units) == (system is jf.systems.BeltFriction)


def wrong(**attributes):
    return type("Wrong", (Named,), attributes)(NAMED.omega, NAMED.force)


BAD = {
    "too few names": ({"state_names": ("q",)}, r"for each of the 2 components .* got \('q',\)"),
    "one string": ({"state_names": "qv"}, "`state_names` of Wrong must be a tuple .* got 'qv'"),
    "twice the same": ({"state_names": ("q", "q")}, "different strings"),
    "unit of nothing": ({"units": {"w": "m"}}, "among q, v, t, force, omega; got 'w'"),
    "unit of a component's number": ({"units": {"q": 1}}, "of strings, got 1 for 'q'"),
    "symbols in a row": ({"symbols": ("Ω",)}, r"`symbols` of Wrong must be a dictionary"),
}


@pytest.mark.parametrize("name", list(BAD))
def test_bad_names_are_refused(name):
    attributes, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        jf.solve(wrong(**attributes), X0, 0.0, 1.0, 0.1)


def test_a_state_of_the_wrong_length_is_not_blamed_on_its_names():
    with pytest.raises(ValueError, match="`vector_field` of Named must return"):
        jf.solve(NAMED, jnp.zeros(3), 0.0, 1.0, 0.1)


def test_labels_are_hashable():
    assert hash(labels_of(NAMED, 2)) == hash(labels_of(NAMED, 2)) and Labels() == Labels()
