"""Bifurcation diagrams: lanes against single runs, outcomes, following, chunks."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names
from jaxfil.model.system import System
from jaxfil.sweep import execution
from tests.problems.values import CUBIC_JUMPS

BELT = jf.systems.BeltFriction()


@pytest.fixture
def chunks(monkeypatch):
    """The chunks of sweeps, but for their numbers, from this test's begin on."""
    found = []
    before = execution._finished

    def finished(chunk, lanes):
        found.append(chunk)
        return before(chunk, lanes)

    monkeypatch.setattr(execution, "_finished", finished)
    return found


@pytest.mark.slow
def test_a_lane_equals_its_single_run(chunks):
    values = np.linspace(4.25, 4.55, 5)
    d = jf.bifurcation_diagram(
        BELT, "omega", values, jnp.zeros(2), transient=3, samples=2, steps=40, progress=False
    )
    for value, xs in zip(values, d.xs, strict=True):
        belt = jf.systems.BeltFriction(omega=value)
        sol = jf.solve(belt, jnp.zeros(2), 0.0, 5 * belt.period, belt.period / 40)
        np.testing.assert_allclose(xs[-1], sol.xs[-1], rtol=1e-11)
    assert chunks[0].in_kernels, "its loop is not one kernel"


def test_the_jump_from_rest_is_between_its_neighbours():
    # Motion at rest leads to the sticking attractor above the jump (x < 0.1 at the section) and to
    # the non-sticking orbit below.
    near = [CUBIC_JUMPS - 3e-4, CUBIC_JUMPS + 3e-4]
    d = jf.bifurcation_diagram(
        BELT, "omega", near, jnp.zeros(2), transient=150, samples=10, progress=False
    )
    assert np.all(d.xs[0, :, 0] > 0.14)
    assert np.all(d.xs[1, :, 0] < 0.1)


def test_following_the_one_sided_orbit_up():
    # One-sided about x = 1 with amplitude f0/(1 - Ω²) below its grazing at 0.8667; crossing
    # both wells at 0.9.
    d = jf.bifurcation_diagram(
        jf.systems.SDOscillator(),
        "omega",
        [0.9, 0.8, 0.805],
        jnp.array([1.69, 0.03]),
        transient=100,
        samples=20,
        follow="up",
        progress=False,
    )
    np.testing.assert_allclose(d.xs[1, :, 0], 1 + 0.25 / (1 - 0.8**2), rtol=0.02)
    np.testing.assert_allclose(d.xs[2, :, 0], 1 + 0.25 / (1 - 0.805**2), rtol=0.02)
    assert np.any(d.xs[0, :, 0] < 0)


def test_a_bad_lane_harms_no_other():
    values = np.array([4.3, np.nan, 4.4])
    good = jf.bifurcation_diagram(
        BELT, "omega", values[[0, 2]], jnp.zeros(2), transient=5, samples=3, progress=False
    )
    mixed = jf.bifurcation_diagram(
        BELT, "omega", values, jnp.zeros(2), transient=5, samples=3, progress=False
    )
    np.testing.assert_array_equal(mixed.successful, [True, False, True])
    assert np.all(np.isnan(mixed.xs[1]))
    np.testing.assert_allclose(mixed.xs[[0, 2]], good.xs, rtol=1e-12)


@pytest.mark.slow
def test_chunks_and_cores_and_other_lanes_make_no_difference(monkeypatch, chunks):
    values = np.linspace(4.2, 4.7, 200)
    run = {"transient": 5, "samples": 3, "progress": False, "compact": False}
    one_block = jf.bifurcation_diagram(BELT, "omega", values, jnp.zeros(2), **run)
    assert [len(chunk.end) for chunk in chunks] == [64] * 4, "a chunk is a kernel"
    few = jf.bifurcation_diagram(BELT, "omega", values[90:97], jnp.zeros(2), **run)
    np.testing.assert_array_equal(few.xs, one_block.xs[90:97])
    monkeypatch.setattr(execution, "_CHUNKS", 2)
    monkeypatch.setattr(execution, "_cores", lambda: 3)
    two_blocks = jf.bifurcation_diagram(BELT, "omega", values, jnp.zeros(2), **run)
    np.testing.assert_array_equal(two_blocks.xs, one_block.xs)
    assert two_blocks.xs.shape == (200, 3, 2)


def test_an_initial_state_for_each_lane():
    x0 = np.array([[0.0, 0.0], [0.1, 1.0]])
    d = jf.bifurcation_diagram(
        BELT, "omega", [4.6, 4.6], x0, transient=40, samples=5, progress=False
    )
    assert not np.allclose(d.xs[0], d.xs[1])


def test_new_values_trace_nothing():
    count = 0

    class Counted(System):
        omega: jnp.ndarray

        def vector_field(self, t, x, side):
            nonlocal count
            count += 1
            return jnp.stack([x[1], jnp.cos(self.omega * t) - x[0] - side])

        def switching(self, t, x):
            return x[1]

        @property
        def period(self):
            return 2 * jnp.pi / self.omega

    def run(values, transient):
        system = Counted(jnp.asarray(1.0))
        return jf.bifurcation_diagram(
            system, "omega", values, jnp.zeros(2), transient=transient, samples=2, progress=False
        )

    run([0.5, 0.6], 2)
    before = count
    run([0.7, 0.9], 5)
    assert count == before


def test_an_accelerator_is_given_many_lanes_at_a_time(monkeypatch):
    """A CPU without single kernels, and where an iteration takes as long for thousands as for
    one."""
    assert [execution._lanes(p, False) for p in (100, 1000, 10**6)] == [128, 1024, 1024]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert [execution._lanes(p, False) for p in (100, 1000, 10**6)] == [128, 1024, 131_072]


@pytest.mark.parametrize(
    "change, message",
    [
        ({"parameter": "omegaa"}, "`parameter` must be a parameter of BeltFriction, one of f0"),
        ({"values": np.zeros((2, 2))}, r"`values` must be real numbers of shape \(p,\)"),
        ({"x0": np.zeros((3, 2))}, "`x0` must be of shape"),
        ({"transient": -1}, "`transient` must be an integer of at least 0"),
        ({"samples": 0}, "`samples` must be an integer of at least 1"),
        ({"steps": 2.5}, "`steps` must be an integer of at least 1"),
        ({"follow": "sideways"}, '`follow` must be "up", "down" or None'),
        ({"system": jf.systems.CoulombOscillator(), "parameter": "friction"}, "must be forced"),
    ],
)
def test_bad_calls(change, message):
    call = {"system": BELT, "parameter": "omega", "values": [4.3, 4.4], "x0": np.zeros(2), **change}
    with pytest.raises(ValueError, match=message):
        jf.bifurcation_diagram(**call, progress=False)


def test_the_card_says_what_it_holds():
    d = jf.bifurcation_diagram(
        BELT, "omega", [4.3, 4.4], np.zeros(2), transient=1, samples=3, progress=False
    )
    assert "omega: 2 values from 4.3 to 4.4" in repr(d) and "2 of 2 lanes" in repr(d)


class Sorted(System):
    """A field that XLA cannot compile into one kernel with the loop."""

    omega: jnp.ndarray

    def vector_field(self, t, x, side):
        return jnp.cos(self.omega * t) - jnp.sort(x)[::-1] - side * jnp.ones_like(x)

    def switching(self, t, x):
        return x[0] + x[1] - 0.25

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


@pytest.mark.slow
def test_a_field_with_a_sort_is_swept_as_it_is_solved(chunks):
    values, x0 = np.array([0.9, 1.1]), jnp.array([0.3, 0.1])
    stepper, options = jf.RK4(), {"transient": 1, "samples": 2, "progress": False}
    d = jf.bifurcation_diagram(
        Sorted(jnp.asarray(1.0)), "omega", values, x0, stepper=stepper, **options
    )
    for value, xs in zip(values, d.xs, strict=True):
        system = Sorted(jnp.asarray(value))
        sol = jf.solve(system, x0, 0.0, 3 * system.period, system.period / 40, stepper=stepper)
        np.testing.assert_allclose(xs[-1], sol.xs[-1], rtol=1e-11)
    assert not chunks[0].in_kernels


class Bent(Sorted):
    """The same with an arctangent."""

    def vector_field(self, t, x, side):
        return super().vector_field(t, x, side) + jnp.arctan(3 * x)


@pytest.mark.release
def test_an_arctangent_is_in_its_quadrant(chunks):
    # XLA's own is in wrong quadrants in 512-bit vectors, when there are lanes enough: a field's is
    # replaced.
    values, x0 = np.linspace(0.9, 1.1, 256), jnp.array([0.3, 0.1])
    stepper, options = jf.RK4(), {"transient": 1, "samples": 1, "progress": False}
    d = jf.bifurcation_diagram(
        Bent(jnp.asarray(1.0)), "omega", values, x0, stepper=stepper, **options
    )
    (chunk,) = chunks
    assert not chunk.in_kernels and len(chunk.end) == 256, "many lanes make up for many kernels"
    for value, xs in zip(values[::85], d.xs[::85], strict=True):
        system = Bent(jnp.asarray(value))
        sol = jf.solve(system, x0, 0.0, 2 * system.period, system.period / 40, stepper=stepper)
        np.testing.assert_allclose(xs[-1], sol.xs[-1], rtol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("follow", [None, "up"])
def test_a_lane_without_a_forcing_period_is_told(follow):
    """omega through zero: cos(-ωt) is the same force, but its period is negative."""
    sd, x0 = jf.systems.SDOscillator(), jnp.array([0.3, 0.1])
    values, options = [-0.7, 0.0, 0.7], {"transient": 2, "samples": 2, "progress": False}
    d = jf.bifurcation_diagram(sd, "omega", values, x0, follow=follow, **options)
    alone = jf.bifurcation_diagram(sd, "omega", [0.7], x0, **options)
    assert outcome_names(d.results).tolist() == ["invalid_period"] * 2 + ["successful"]
    assert np.isnan(d.xs[:2]).all()
    np.testing.assert_array_equal(d.xs[2], alone.xs[0])


class Checked(System):
    """x'' + x = 0, which looks at itself before each step."""

    omega: jnp.ndarray
    left: str = eqx.field(static=True, default="left the model's range")

    def vector_field(self, t, x, side):
        out = ~(jnp.abs(x[0]) < 1e3) | ~(self.omega < 5)
        return jnp.stack([x[1], -eqx.error_if(x[0], out, self.left)])

    def switching(self, t, x):
        return x[0] - 0.5

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def cosines(omegas, samples):
    times = 2 * np.pi / np.asarray(omegas)[:, None] * np.arange(1, samples + 1)
    return np.stack([np.cos(times), -np.sin(times)], axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("nans", [False, True], ids=["plain", "jax_debug_nans"])
def test_a_field_that_checks_itself_is_swept(nans):
    omegas = [0.7, 0.9, 1.1]
    with jax.debug_nans(nans):
        d = jf.bifurcation_diagram(
            Checked(jnp.asarray(1.0)), "omega", omegas, jnp.array([1.0, 0.0]),
            transient=0, samples=2, steps=200, progress=False,
        )  # fmt: skip
    np.testing.assert_allclose(d.xs, cosines(omegas, 2), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_field_that_checks_itself_is_followed_and_says_what_fails():
    def run(omegas, follow=None):
        return jf.bifurcation_diagram(
            Checked(jnp.asarray(1.0)), "omega", omegas, jnp.array([1.0, 0.0]),
            transient=0, samples=1, steps=200, follow=follow, progress=False,
        )  # fmt: skip

    np.testing.assert_allclose(
        run([0.9], "up").xs[:, 0], cosines([0.9], 1)[:, 0], rtol=0, atol=1e-12
    )
    with pytest.raises(eqx.EquinoxRuntimeError, match="left the model's range"):
        run([0.9, 6.0])


@pytest.mark.parametrize("nans", [False, True], ids=["plain", "jax_debug_nans"])
@pytest.mark.parametrize("follow", [None, "up"])
def test_a_sweep_fills_up_with_nothing_that_is_not_a_number(nans, follow):
    values = np.linspace(4.2, 4.7, 3)
    with jax.debug_nans(nans):
        d = jf.bifurcation_diagram(
            BELT, "omega", values, jnp.zeros(2), transient=1, samples=2, follow=follow,
            progress=False,
        )  # fmt: skip
    assert d.successful.all() and np.isfinite(d.xs).all()
