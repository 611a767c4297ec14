"""What a result has saved comes back bit for bit, from files of all kinds."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf

BELT = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=12.0)
# Of the same class, with other numbers.
OTHER = jf.systems.BeltFriction(f0=3.0, gamma2=1.0)


class Circles(jf.System):
    """A rotation, without a surface."""

    rates: jax.Array | None
    steps: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([self.rates[0] * x[1], -self.rates[0] * x[0]]) * self.steps


def circles(rate=1.0):
    return Circles(jnp.array([rate]), jnp.array(2.0))


def solved(saveat):
    tops = jf.maxima(lambda t, x: x[0])
    x0 = jnp.array([0.0, 0.0])
    run = {"stepper": diffrax.Tsit5(), "max_events": 8, "compact": True, "sections": tops}
    return jf.solve(BELT, x0, 0.0, 1.0, 0.01, saveat=saveat, **run)


def twice(result):
    """Two lanes of the same."""
    return jax.tree.map(lambda v: jnp.stack([v, v]) if eqx.is_array(v) else v, result)


@pytest.fixture(scope="module")
def sol():
    return solved(diffrax.SaveAt(ts=jnp.linspace(0.0, 1.0, 5)))


@pytest.fixture(scope="module")
def dense():
    return solved(diffrax.SaveAt(dense=True))


@pytest.fixture(scope="module")
def orbit():
    return jf.periodic_orbit(BELT, jnp.array([0.1, 0.0]), stepper=diffrax.Tsit5())


@pytest.fixture(scope="module")
def branch(orbit):
    return jf.continue_orbit(BELT, "omega", orbit, stop=10.5)


def kept(result, folder, system=None, suffixes=(".npz", ".nc", ".zarr")):
    """The result as it comes back, after a look that it is the same from files of all kinds."""
    for suffix in suffixes:
        result.save(folder / f"a{suffix}")
        back = jf.load(folder / f"a{suffix}", system=system)
        assert jax.tree.structure(back) == jax.tree.structure(result)
        for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(back), strict=True):
            a, b = np.asarray(a), np.asarray(b)
            assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    return back


@pytest.mark.slow
def test_a_solution_with_its_events_crossings_and_errors(sol, tmp_path):
    seen = jnp.stack([sol.xs, 2 * sol.xs], axis=-1)
    sol = dataclasses.replace(sol, errors=1e-9 * sol.xs, observed=seen)
    assert np.isinf(sol.events.ts[-1]) and np.isinf(sol.crossings.ts[-1]), "there is padding"
    back = kept(sol, tmp_path)
    assert repr(back) == repr(sol) and repr(back.events) == repr(sol.events)
    data = sol.to_xarray()
    assert data["observed"].dims == ("time", "observed_0", "observed_1")
    assert data["x"].dims == ("time", "component") and data["t"].dims == ("time",)
    np.testing.assert_array_equal(data["x"].sel(component="x'"), sol.xs[:, 1])
    assert data["event_kind"].values.tolist()[:3] == ["crossing", "stick", "slip"]
    assert data["event_kind"].values[-1] == "none" and data["outcome"].item() == "successful"
    assert data["outcome_code"].dtype == np.int32 and data["unit"].values.tolist() == ["m", "m/s"]


def test_solutions_of_a_batch(sol, tmp_path):
    kept(twice(sol), tmp_path)
    data = twice(sol).to_xarray()
    assert data["event_t"].dims == ("lane", "event")
    assert data["outcome"].values.tolist() == ["successful"] * 2


@pytest.mark.slow
def test_a_dense_solution_goes_on_with_its_system(dense, tmp_path):
    back = kept(dense, tmp_path, OTHER)
    np.testing.assert_array_equal(back.evaluate(0.37), dense.evaluate(0.37))


def test_a_solution_in_float32(dense, tmp_path):
    single = jax.tree.map(lambda v: v.astype(jnp.float32) if v.dtype == jnp.float64 else v, dense)
    assert kept(single, tmp_path, OTHER, [".nc"]).t_final.dtype == jnp.float32


@pytest.mark.slow
def test_an_orbit(orbit, tmp_path):
    back = kept(orbit, tmp_path, OTHER)
    assert repr(back) == repr(orbit)
    np.testing.assert_array_equal(back.states(jnp.array([0.2])), orbit.states(jnp.array([0.2])))
    data = orbit.to_xarray()
    pair = data["multiplier_real"].values + 1j * data["multiplier_imag"].values
    np.testing.assert_array_equal(pair, orbit.multipliers)
    assert data.attrs["omega"] == 12.0 and data.attrs["system"] == "BeltFriction"
    assert data.attrs["stepper"] == "Tsit5" and bool(data["stable"])


def test_orbits_of_a_batch(orbit, tmp_path):
    found = eqx.tree_at(lambda o: o.system.omega, twice(orbit), jnp.array([12.0, 11.5]))
    kept(found, tmp_path, OTHER, [".nc"])
    np.testing.assert_array_equal(found.to_xarray()["omega"], [12.0, 11.5])


@pytest.mark.slow
def test_a_branch_with_its_special_points(branch, tmp_path):
    back = kept(branch, tmp_path, OTHER)
    assert repr(back) == repr(branch) and back.sequences == branch.sequences
    (point,) = back.points
    assert point.kind == "contacts" and point.before == () and len(point.after) == 2
    data = branch.to_xarray()
    assert data["omega"].dims == ("orbit",) and data["omega"].attrs["units"] == "rad/s"
    assert data["special_kind"].values.tolist() == ["contacts"]
    np.testing.assert_array_equal(data["stable"], branch.stable)


def test_a_branch_without_special_points(branch, tmp_path):
    kept(eqx.tree_at(lambda b: b.points, branch, []), tmp_path, OTHER, [".nc"])


def test_basins(tmp_path):
    found = jf.basins_of_attraction(
        jf.systems.SDOscillator(omega=0.6, zeta=0.1),
        ([-1.0, 0.0, 1.0], [0.0, 0.1]),
        transient=20,
        samples=8,
        steps=20,
        stepper=jf.RK4(),
        progress=False,
    )
    kept(found, tmp_path)
    data = found.to_xarray()
    assert data["label"].dims == ("axis_0", "axis_1")
    assert data["axis_1"].attrs["long_name"] == "x'"
    assert data.attrs["omega"] == 0.6 and data.attrs["transient"] == 20
    assert data["period"].values.tolist() == [len(points) for points in found.attractors]
    single = jax.tree.map(lambda v: v.astype("float32") if v.dtype == float else v, found)
    kept(single, tmp_path)
    kept(dataclasses.replace(single, attractors=()), tmp_path)
    chaos = eqx.tree_at(lambda b: b.attractors, found, ())
    kept(chaos, tmp_path, suffixes=[".nc"])


def test_the_system_of_a_file_is_asked_for_by_name(orbit, tmp_path):
    path = tmp_path / "a.npz"
    orbit.save(path)
    with pytest.raises(ValueError, match=r"`system` must be a BeltFriction.*, got None\."):
        jf.load(path)
    with pytest.raises(ValueError, match=r"`system` must be a BeltFriction.*got SDOscillator"):
        jf.load(path, system=jf.systems.SDOscillator())


def test_a_system_without_surfaces_whose_parameters_are_an_array_and_a_name_of_other_things(
    tmp_path,
):
    every = diffrax.SaveAt(dense=True)
    run = {"saveat": every, "stepper": diffrax.Tsit5(), "compact": True}
    sol = jf.solve(circles(), jnp.array([1.0, 0.0]), 0.0, 1.0, 0.1, **run)
    assert sol.events is None and sol.mode_final.shape == (0,)
    kept(sol, tmp_path, circles(3.0))
    with pytest.raises(ValueError, match=r"`system` must have the parameters.*differ in rates"):
        jf.load(tmp_path / "a.npz", system=Circles(None, jnp.array(2.0)))


class Named(jf.System):
    """x'' = -k x with what no float says: a whole number, a word, a function, an array."""

    gear: int
    law: str = eqx.field(static=True)
    force: object = jnp.tanh
    table: jax.Array = eqx.field(default_factory=lambda: jnp.arange(2))

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.gear * x[0]])


@pytest.mark.parametrize(
    "other, name",
    [
        (Named(1, "soft"), "`gear` is 4, got 1"),
        (Named(4, "hard"), '`law` is "soft", got "hard"'),
        (Named(4, "soft", jnp.sin), '`force` is "tanh", got "sin"'),
        (Named(4, "soft", table=jnp.arange(3)), r"`table` is \[0, 1\], got \[0, 1, 2\]"),
    ],
)
def test_a_system_that_differs_in_what_is_no_parameter_is_refused(other, name, tmp_path):
    """x(1/8) = cos 1/4 for k = 4, and not cos 1/8."""
    every = diffrax.SaveAt(dense=True)
    run = {"saveat": every, "stepper": diffrax.Tsit5(), "compact": True}
    one = jf.solve(Named(4, "soft"), jnp.array([1.0, 0.0]), 0.0, 1.0, 0.1, **run)
    for i, sol in enumerate((one, twice(one))):
        sol.save(tmp_path / f"{i}.npz")
        back = jf.load(tmp_path / f"{i}.npz", system=Named(4, "soft"))
        with pytest.raises(ValueError, match=f"`system` must be the system of .*{name}"):
            jf.load(tmp_path / f"{i}.npz", system=other)
        jax.tree.map(np.testing.assert_array_equal, back._dense.xs, sol._dense.xs)
    assert abs(float(one.evaluate(0.125)[0]) - np.cos(0.25)) < 1e-6


def test_what_jax_cannot_hold_is_said(sol, tmp_path):
    sol.save(tmp_path / "a.npz")
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        jf.load(tmp_path / "a.npz")
