"""The clock of a forced system starts anew each period, so that no phase is lost in long runs."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.integrate.lane.forcing_phase import repeats
from jaxfil.model.parameter import cast

X0 = np.array([0.1, 0.0], np.float32)
PERIODS = 5000  # a time of 2e4, which float32 knows to 2e-3
RUN = {"transient": PERIODS, "steps": 60, "stepper": diffrax.Tsit5()}


def linear(dtype):
    """A wall too far away to be met."""
    return jf.systems.ImpactOscillator(
        stiffness=dtype(2.0), damping=dtype(0.1), omega=dtype(1.6), wall=dtype(9.0)
    )


def settled() -> np.ndarray:
    """(x, x') at whole periods, of x'' + c x' + k x = A cos ωt: Re(z), Re(iωz)."""
    system = linear(np.float32)
    names = "stiffness", "damping", "amplitude", "omega"
    k, c, a, omega = (float(getattr(system, name)) for name in names)
    z = a / (k - omega**2 + 1j * c * omega)
    return np.array([z.real, (1j * omega * z).real])


def diagram():
    omega = np.float32([1.6])
    one = jf.bifurcation_diagram(
        linear(np.float32), "omega", omega, X0, samples=1, progress=False, **RUN
    )
    return one.xs[0, 0], one.results


def spectrum():
    one = jf.lyapunov_spectrum(linear(np.float32), X0, periods=1, **RUN)
    return one.x_final, one.result


def drive():
    one = jf.transverse_exponent(linear(np.float32), X0, periods=1, **RUN)
    return one.x_final, one.result


@pytest.mark.release
@pytest.mark.parametrize("run", [diagram, spectrum, pytest.param(drive, marks=pytest.mark.release)])
def test_a_phase_does_not_age(run):
    x, result = run()
    assert x.dtype == np.float32
    assert bool(jnp.all(result == jf.RESULTS.successful))
    exact = settled()
    # A sample is the sum of what a few hundred steps have rounded before damping forgets it.
    bound = 32 * np.finfo(np.float32).eps * np.linalg.norm(exact)
    np.testing.assert_allclose(x, exact, rtol=0, atol=bound)


@pytest.mark.slow
def test_contacts_of_a_long_run_are_where_those_of_float64_are():
    omegas = np.linspace(0.7, 0.9, 8).astype(np.float32)
    ends = [
        jf.bifurcation_diagram(
            jf.systems.DenHartog(),
            "omega",
            omegas.astype(dtype),
            np.zeros(2, dtype),
            transient=300,
            samples=1,
            steps=60,
            stepper=diffrax.Tsit5(),
            progress=False,
        ).xs[:, 0]
        for dtype in (np.float32, np.float64)
    ]
    size = np.linalg.norm(ends[1], axis=-1)
    apart = np.linalg.norm(ends[0] - ends[1], axis=-1)
    assert np.all(apart <= 32 * np.finfo(np.float32).eps * size)


class TwoForces(jf.System):
    """x' = −x + cos ωt + a cos νt, sampled by the period of the first force."""

    omega: jax.Array
    other: jax.Array
    nu = 0.5 * (5**0.5 - 1)

    def vector_field(self, t, x, side):
        forces = jnp.cos(self.omega * t) + self.other * jnp.cos(self.nu * t)
        return jnp.stack([forces - x[0]])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


@pytest.mark.parametrize("other", [0.0, 0.7])
def test_a_clock_goes_on_where_forces_of_two_frequencies_never_repeat(other):
    system, x0 = TwoForces(jnp.asarray(1.0), jnp.asarray(other)), jnp.zeros(1)
    omegas = np.array([1.0, 1.7])
    run = {"transient": 40, "steps": 60}
    found = jf.bifurcation_diagram(
        system, "omega", omegas, x0, samples=2, progress=False, compact=True, **run
    )
    spectrum = jf.lyapunov_spectrum(system, x0, periods=1, **run)

    def settled(omega, t):
        parts = [(1.0, omega), (other, TwoForces.nu)]
        return sum(a * (np.cos(w * t) + w * np.sin(w * t)) / (1 + w * w) for a, w in parts)

    ends = 2 * np.pi / omegas[:, None] * np.array([41, 42])
    np.testing.assert_allclose(found.xs[..., 0], settled(omegas[:, None], ends), rtol=0, atol=1e-12)
    np.testing.assert_allclose(spectrum.x_final[0], settled(1.0, 82 * np.pi), rtol=0, atol=1e-12)


class Parametric(jf.System):
    """A stiffness and a coupling of frictions with a frequency of their own, beside the forcing."""

    omega: jax.Array
    nu: jax.Array
    hold: jax.Array

    def vector_field(self, t, x, side):
        second = jnp.cos(self.nu * t)
        force = -(1 + 0.5 * second) * x[0] - 0.2 * x[1] + jnp.cos(self.omega * t)
        between = self.hold * second * (side[0] - side[1])
        return jnp.stack([x[1], force, -x[2] + between])

    def switching(self, t, x):
        return jnp.stack([x[0] - 30, x[1] + 30])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def test_a_second_frequency_is_seen_from_rest_too():
    """Its factor is zero in the initial state, or between sides that are equal."""
    system = Parametric(*map(jnp.asarray, (1.3, 0.618, 0.0)))
    assert not bool(repeats(system, system.period, jnp.zeros(3), 600))
    held = Parametric(*map(jnp.asarray, (1.3, 2.6, 1.0)))
    assert bool(repeats(held, held.period, jnp.zeros(3), 600))
    apart = dataclasses.replace(held, nu=jnp.asarray(0.618))
    assert not bool(repeats(apart, apart.period, jnp.zeros(3), 600))


class BehindAGap(jf.System):
    """x'' = cos t − (2 + cos νt) max(x − 1, 0)², a contact whose stiffness has a frequency."""

    nu: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        contact = (2 + jnp.cos(self.nu * t)) * jnp.maximum(x[0] - 1, 0) ** 2
        return jnp.stack([x[1], jnp.cos(t) - contact])


def test_a_second_frequency_is_seen_beyond_a_gap():
    for nu, same in ((0.618, False), (2.0, True)):
        system = BehindAGap(jnp.asarray(nu))
        assert bool(repeats(system, jnp.asarray(2 * jnp.pi), jnp.zeros(2), 600)) == same


@pytest.mark.release
def test_samples_of_two_frequencies_from_rest_are_those_of_a_run():
    system = Parametric(*map(jnp.asarray, (1.3, 0.618, 0.0)))
    period = float(system.period)
    ts = jnp.asarray(period * np.arange(11, 15))
    run = jf.solve(system, jnp.zeros(3), 0.0, ts[-1], period / 40, saveat=diffrax.SaveAt(ts=ts))
    found = jf.bifurcation_diagram(
        system, "omega", [1.3], np.zeros(3), transient=10, samples=4, progress=False
    )
    np.testing.assert_allclose(found.xs[0], run.xs, rtol=0, atol=1e-8)


def test_a_field_that_is_not_defined_elsewhere_still_repeats():
    flat = jf.piecewise(
        lambda t, x: jnp.sqrt(x) * 0 + jnp.cos(t) / x,
        lambda t, x: jnp.log(x),
        lambda t, x: x[0],
        period=2 * np.pi,
    )
    assert bool(repeats(flat, jnp.asarray(2 * jnp.pi), jnp.asarray([0.1]), 600))


class Late(jf.System):
    """x' = −x + r(t) cos t, whose factor r sets in at `begin`, or is a pulse about it."""

    begin: jax.Array
    pulse: jax.Array
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        after = jax.nn.sigmoid(4 * (t - self.begin))
        ends = jax.nn.sigmoid(4 * (self.begin + 40.0 - t))
        return (jnp.cos(t) * after * (1 - self.pulse + self.pulse * ends) - x[0])[None]


@pytest.mark.parametrize("pulse, end", [(0.0, 0.5), (1.0, 0.0)])
def test_a_force_that_sets_in_late_is_seen(pulse, end):
    """x ends as r (cos t + sin t)/2, a power of 1/4 on average."""
    system, x0 = Late(jnp.asarray(60.0), jnp.asarray(pulse)), jnp.array([0.5])
    assert not bool(repeats(system, jnp.asarray(2 * np.pi), x0, 30))
    assert bool(repeats(system, jnp.asarray(2 * np.pi), x0, 3))
    run = {"transient": 28, "samples": 2, "progress": False}
    found = jf.bifurcation_diagram(system, "pulse", [pulse], x0, **run)
    np.testing.assert_allclose(found.xs[0, :, 0], end, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_fast_forcing_repeats_over_long_runs_in_each_precision(dtype):
    forced = jf.piecewise(
        lambda t, x: jnp.cos(7 * t) - x, lambda t, x: jnp.cos(2 * t) - x, lambda t, x: x[0]
    )
    x0 = jnp.zeros(1, dtype)
    assert bool(repeats(cast(forced, dtype), jnp.asarray(2 * np.pi, dtype), x0, 3000))


class Doses(jf.System):
    """A dose of 1 at each tick, and decay at rate 1."""

    every: jax.Array

    def vector_field(self, t, x, side):
        return -x

    def tick(self, t, x, clock):
        return x + 1.0

    @property
    def clocks(self):
        return (jf.Clock(self.every),)


def test_lanes_that_follow_each_other_have_each_tick_once():
    """Each ends at a tick, whose time in periods is rounded; the next one begins after it."""
    periods, samples = np.linspace(0.54, 0.78, 16), 15
    level = jf.Section(lambda t, x: x[0] - 1.6, direction=1)
    found = jf.bifurcation_diagram(
        Doses(jnp.array(0.6)),
        "every",
        periods,
        jnp.array([2.0]),
        section=level,
        max_return=2.0,
        transient=0,
        samples=samples,
        follow="up",
        progress=False,
    )
    x, want = 2.0, []
    for period in np.repeat(periods, samples):
        x = x * np.exp(-period) + 1.0
        want.append(x)
    np.testing.assert_allclose(found.xs[..., 0].ravel(), want, rtol=0, atol=1e-12)
