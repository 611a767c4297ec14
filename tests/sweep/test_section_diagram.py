"""Diagrams sampled at a section: of autonomous systems, and whatever else is made of diagrams.

Against `scipy.integrate.solve_ivp`, and for Chua's circuit against what is known of it.
"""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxfil as jf

TOPS = jf.maxima(lambda t, x: x[0])
MUS = np.array([0.5, 1.0])


class VanDerPol(jf.System):
    mu: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.mu * (1 - x[0] ** 2) * x[1] - x[0]])


def sweep(mus=MUS, section=TOPS, **options):
    given = {"transient": 12, "samples": 6, "steps": 16, "max_return": 12.0, "progress": False}
    return jf.bifurcation_diagram(
        VanDerPol(jnp.array(0.0)),
        "mu",
        mus,
        jnp.array([1.0, 0.0]),
        stepper=jf.RK4(),
        section=section,
        compact=True,
        **given | options,
    )


def amplitude(mu):
    """The maximum of x on the limit cycle, by another program."""

    def top(t, x):
        return x[1]

    top.direction = -1
    run = solve_ivp(
        lambda t, x: [x[1], mu * (1 - x[0] ** 2) * x[1] - x[0]],
        (0, 100),
        [1.0, 0.0],
        "DOP853",
        events=top,
        rtol=1e-12,
        atol=1e-12,
    )
    return run.y_events[0][-1][0]


@pytest.fixture(scope="module")
def plain():
    return sweep()


def test_the_limit_cycle_of_an_autonomous_system_is_sampled_at_its_maxima(plain):
    assert plain.successful.all() and plain.periods().tolist() == [1, 1]
    exact = [amplitude(mu) for mu in MUS]
    # Of the fourth order, at a step of 1/16.
    np.testing.assert_allclose(plain.xs[:, -1, 0], exact, rtol=0, atol=1e-5)
    np.testing.assert_allclose(plain.xs[..., 1], 0, rtol=0, atol=1e-12)


def test_a_diagram_at_a_section_is_kept_drawn_and_told_as_any_other(plain, tmp_path):
    plain.save(tmp_path / "diagram.nc")
    back = jf.load(tmp_path / "diagram.nc")
    assert np.array_equal(back.xs, plain.xs) and back.conditions.max_return == 12.0
    assert np.array_equal(back.times, plain.times) and np.isfinite(back.times).all()
    assert back.conditions.section == plain.conditions.section
    assert plain.to_xarray().attrs["section"].endswith("of its rate, direction -1")
    assert plain.plot().get_ylabel() == "x[0] at the section"


def test_a_checkpoint_knows_its_section(plain, tmp_path):
    kept = sweep(checkpoint=tmp_path / "kept")
    again = sweep(checkpoint=tmp_path / "kept")
    assert np.array_equal(kept.xs, plain.xs) and np.array_equal(again.xs, plain.xs)
    with pytest.raises(ValueError, match="section"):
        sweep(checkpoint=tmp_path / "kept", section=jf.minima(lambda t, x: x[0]))


def test_times_of_return_and_a_transient_in_time():
    """Circles x = (cos ωt, −sin ωt) have their maxima of x at 2πk/ω, k ≥ 1: from t = 20 on the
    first is number ⌈20 ω/2π⌉, which is another one in each lane."""
    rates = np.array([1.0, 2.0, 5.0])
    options = {"section": TOPS, "max_return": 8.0, "samples": 3, "steps": 40, "progress": False}
    d = jf.bifurcation_diagram(
        Circles(jnp.array(1.0)),
        "omega",
        rates,
        jnp.array([1.0, 0.0]),
        transient_time=20.0,
        stepper=diffrax.Tsit5(),
        compact=True,
        **options,
    )
    assert d.successful.all() and d.conditions.transient == 0
    first = np.ceil(20 * rates / (2 * np.pi))
    exact = 2 * np.pi / rates[:, None] * (first[:, None] + np.arange(3))
    assert d.times.shape == (3, 3)
    np.testing.assert_allclose(d.times, exact, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(d.to_xarray()["t"].sel(omega=2.0), d.times[1])


class Circles(jf.System):
    omega: jax.Array

    def vector_field(self, t, x, side):
        return self.omega * jnp.stack([x[1], -x[0]])


def test_following_and_the_estimate_of_errors_work_at_a_section(plain, tmp_path):
    followed = sweep(follow="up", estimate_error=True, checkpoint=tmp_path / "kept")
    assert followed.successful.all() and followed.errors.shape == (2, 2)
    away = abs(followed.xs[:, -1, 0] - [amplitude(mu) for mu in MUS])
    assert (away < 2 * followed.errors[:, 0]).all() and followed.errors.max() < 1e-3
    # The second value starts at a maximum, which is no crossing, on the first one's cycle.
    np.testing.assert_allclose(followed.xs[1, -1], plain.xs[1, -1], rtol=0, atol=1e-6)
    again = sweep(follow="up", estimate_error=True, checkpoint=tmp_path / "kept")
    assert eqx.tree_equal(again, followed)


def test_the_basin_of_a_limit_cycle_is_that_of_its_section():
    found = jf.basins_of_attraction(
        VanDerPol(jnp.array(1.0)),
        ([0.5, 3.0], [0.0]),
        transient=12,
        samples=4,
        steps=16,
        stepper=jf.RK4(),
        section=TOPS,
        max_return=12.0,
        compact=True,
        progress=False,
    )
    assert found.labels.ravel().tolist() == [1, 1]
    np.testing.assert_allclose(found.attractors[0][:, 0], [amplitude(1.0)], rtol=0, atol=1e-4)
    assert found.conditions.parameters == {"mu": 1.0}


def test_a_lane_that_does_not_come_back_says_so():
    lost = sweep(max_return=1.0)
    assert (lost.results == jf.RESULTS.section_not_reached).all()
    # A span of 18 units of time has three maxima, all of them within the transient.
    assert np.isnan(lost.xs).all()


def test_what_a_diagram_at_a_section_needs_is_asked_for_by_name():
    with pytest.raises(ValueError, match="`max_return` must be a positive number, got None"):
        sweep(max_return=None)
    with pytest.raises(ValueError, match="`section` must be a jaxfil"):
        sweep(section=3)
    with pytest.raises(ValueError, match="`transient_time` must be None without a `section`"):
        jf.bifurcation_diagram(
            jf.systems.SDOscillator(), "omega", MUS, jnp.zeros(2), transient_time=3.0
        )
    with pytest.raises(ValueError, match="`transient_time` must be a positive number, got -1"):
        sweep(transient_time=-1.0)
    with pytest.raises(ValueError, match="Give a `section` to sample at"):
        sweep(section=None, max_return=None)


class Chua(jf.System):
    """Chua's circuit in Matsumoto's numbers, β = 100/7, m₀ = −8/7, m₁ = −5/7."""

    alpha: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        bend = 0.5 * (side[1] * (x[0] + 1) - side[0] * (x[0] - 1))
        diode = (-5 * x[0] - 3 * bend) / 7
        flow = self.alpha * (x[1] - x[0] - diode)
        return jnp.stack([flow, x[0] - x[1] + x[2], -100 / 7 * x[1]])

    def switching(self, t, x):
        return jnp.stack([x[0] - 1, x[0] + 1])


@pytest.mark.slow
def test_chuas_circuit_doubles_its_period_and_comes_to_the_double_scroll():
    """Matsumoto, Chua and Komuro, IEEE Transactions on Circuits and Systems 32 (1985) 798–818: the
    double scroll at α = 9."""
    d = jf.bifurcation_diagram(
        Chua(jnp.array(9.0)),
        "alpha",
        jnp.array([8.0, 8.3, 9.0]),
        jnp.array([0.7, 0.1, -0.1]),
        transient=100,
        samples=60,
        steps=20,
        stepper=diffrax.Tsit5(),
        section=jf.maxima(lambda t, x: x[2]),
        max_return=5.0,
        compact=True,
        progress=False,
    )
    assert d.successful.all() and d.periods().tolist() == [1, 2, 0]
    # Before it the motion keeps to one side of the origin, on the double scroll it visits both.
    assert (d.xs[:2, :, 0] > 0).all()
    assert d.xs[2, :, 0].min() < -1 and d.xs[2, :, 0].max() > 1


class Driven(jf.System):
    """x'' = −x − 0.02 x' + cos ωt: what a kick excites decays in hundreds of periods."""

    omega: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - 0.02 * x[1] + jnp.cos(self.omega * t)])

    def switching(self, t, x):
        return x[:0]

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Counting(jf.System):
    """A rotation of frequency one, and the ticks of two clocks counted."""

    rate: jax.Array
    first: jax.Array
    second: jax.Array

    def vector_field(self, t, x, side):
        none = jnp.zeros_like(t)
        return jnp.stack([self.rate * x[1], -self.rate * x[0], none, none])

    def tick(self, t, x, clock):
        return x.at[2 + clock].add(1.0)

    @property
    def clocks(self):
        return jf.Clock(self.first), jf.Clock(self.second)


@pytest.mark.slow
@pytest.mark.parametrize("second", [4.6, 1.7], ids=["which return", "which never return"])
def test_following_at_a_section_goes_on_at_the_phases_of_clocks(second):
    run = dict(transient=0, samples=3, follow="up", max_return=10.0, progress=False, steps=20)
    d = jf.bifurcation_diagram(
        Counting(*map(jnp.asarray, (1.0, 2.3, second))),
        "rate",
        np.ones(4),
        np.array([1.0, 0.0, 0.0, 0.0]),
        section=jf.Section(lambda t, x: x[1], direction=-1),
        **run,
    )
    # Turns end at 2πk, by when there were as many ticks as there are whole periods in it.
    turns = 2 * np.pi * np.arange(1, 13)
    ticks = np.floor(turns[:, None] / np.array([2.3, second]))
    np.testing.assert_array_equal(d.xs.reshape(12, 4)[:, 2:], ticks)


@pytest.mark.slow
@pytest.mark.parametrize("observe", [None, lambda t, x, side: x[0]], ids=["states", "observed"])
def test_following_at_a_section_goes_on_at_the_phase_of_the_force(observe):
    omegas = 2.0 + 1e-9 * np.arange(4)
    z = 1 / (1 - 4.0 + 0.04j)
    x0 = np.array([z.real, (2j * z).real])
    run = dict(transient=0, samples=4, follow="up", max_return=10.0, progress=False)
    top = jf.maxima(lambda t, x: x[0])
    d = jf.bifurcation_diagram(
        Driven(2.0), "omega", omegas, x0, section=top, observe=observe, **run
    )
    assert d.successful.all()
    np.testing.assert_allclose(d.xs[..., 0], abs(z), rtol=1e-8)
    # Maxima at cos(ωt + arg z) = 1; a lane starts at a time of its first period.
    phases = d.times * omegas[:, None] + np.angle(z)
    np.testing.assert_allclose(np.exp(1j * phases), 1.0, rtol=0, atol=1e-7)
    assert (d.times[:, 0] < 2 * np.pi).all() and (d.times[1:, 0] > np.pi).all()
