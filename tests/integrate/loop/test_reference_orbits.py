"""Orbits of the SD oscillator and of belt friction against the bank's reference numbers.

The systems are those of Santhosh, Narayanan and Padmanabhan, Procedia IUTAM 19 (2016) 219-227.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from tests.problems import PROBLEMS, closed_forms, tagged
from tests.problems.systems import belt, cubic_belt
from tests.problems.values import (
    BELT_ADDS,
    BELT_CHANGES,
    BELT_DAMPING,
    BELT_GRAZES,
    CUBIC_GRAZES,
    CUBIC_JUMPS,
    SD_AT_5,
    SD_DAMPING,
    SD_GRAZES,
)
from tests.results import by_imaginary_part

BELT_ORBITS = tagged("orbit belt", but="twice")

CROSS, STICK, SLIP = EventKind.crossing, EventKind.stick, EventKind.slip


@jax.jit
def flow(system, x0, t0, t1):
    """A run with 400 steps, of which events and end are asked."""
    return jf.solve(system, x0, t0, t1, (t1 - t0) / 400, max_events=16)


@jax.jit
def jacobian(system, x0, t0, t1):
    """The derivative of the end of `flow` by its start."""
    return jax.jacfwd(lambda x: flow(system, x, t0, t1).xs[-1])(x0)


def sd_oscillator(omega):
    return jf.systems.SDOscillator(f0=0.25, zeta=0.0141, omega=omega)


def one_sided(omega):
    return jnp.asarray(closed_forms.one_sided(omega))


def test_sd_oscillator_states_and_contacts():
    p = PROBLEMS["sd"]
    saveat = diffrax.SaveAt(ts=jnp.asarray([5.0, p.t1]))
    sol = jf.solve(p.system, jnp.asarray(p.x0), 0.0, p.t1, p.dt, saveat=saveat, max_events=16)
    assert_allclose(sol.xs, [SD_AT_5, p.end], rtol=0, atol=1e-11)
    assert sol.num_events == 9
    assert_array_equal(sol.events.kinds[:9], p.kinds)
    assert_allclose(sol.events.ts[0], p.ts[0], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_sd_oscillator_symmetric_orbit():
    p = PROBLEMS["symmetric sd"]
    x0 = jnp.asarray(p.x0)
    sol = flow(p.system, x0, 0.0, p.t1)
    assert_allclose(sol.xs[-1], x0, rtol=0, atol=1e-10)
    assert_array_equal(sol.events.kinds[: int(sol.num_events)], p.kinds)
    multipliers = np.linalg.eigvals(jacobian(p.system, x0, 0.0, p.t1))
    assert_allclose(by_imaginary_part(multipliers), p.multipliers, rtol=0, atol=p.digits)


@pytest.mark.parametrize("omega", [0.7, 0.866, 1.3])
def test_sd_oscillator_exponents_sum_to_minus_two_zeta(omega):
    # Crossings keep areas (both fields have the same dH/dt), so the determinant is exact.
    system = sd_oscillator(omega)
    determinant = np.linalg.det(jacobian(system, jnp.asarray([0.3, 0.1]), 0.0, 20.0))
    assert_allclose(np.log(determinant) / 20, SD_DAMPING, rtol=1e-10)


def test_sd_oscillator_one_sided_multipliers():
    # No contact: a damped rotation, both exponents -ζ.
    system, period = sd_oscillator(0.7), 2 * np.pi / 0.7
    multipliers = np.linalg.eigvals(jacobian(system, one_sided(0.7), 0.0, period))
    assert_allclose(np.log(abs(multipliers)) / period, SD_DAMPING / 2, rtol=1e-10)


@pytest.mark.parametrize(("omega", "inside"), [*zip(SD_GRAZES, (1, -1), strict=True)])
def test_sd_oscillator_one_sided_orbit_grazes(omega, inside):
    # Exact: f0 = √((1 - Ω²)² + (2ζΩ)²). The amplitude is above 1 between the two values.
    for side, met in ((-inside, False), (inside, True)):
        near = omega + 1e-8 * side
        sol = flow(sd_oscillator(near), one_sided(near), 0.0, 2 * np.pi / near)
        assert (sol.num_events > 0) == met


@pytest.mark.parametrize("name", BELT_ORBITS)
def test_belt_orbit_closes(name):
    p = PROBLEMS[name]
    sol = flow(p.system, jnp.asarray(p.x0, float), 0.0, p.t1)
    count = len(p.ts)
    assert sol.num_events == count
    assert_array_equal(sol.events.kinds[:count], p.kinds)
    assert_allclose(sol.events.ts[:count], p.ts, rtol=0, atol=1e-10)
    assert_allclose(sol.xs[-1], p.end, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", BELT_ORBITS)
def test_belt_orbit_modes_and_highest_speed(name):
    p = PROBLEMS[name]
    ts = np.linspace(0.0, p.t1, 1001)
    saveat = diffrax.SaveAt(ts=jnp.asarray(ts))
    sol = jf.solve(p.system, jnp.asarray(p.x0, float), 0.0, ts[-1], ts[-1] / 100, saveat=saveat)
    want = np.full(1001, p.orbit_modes[0])
    for t, after in zip(p.ts, p.orbit_modes[1:], strict=True):
        want[ts > t] = after
    assert_array_equal(sol.modes[:, 0], want)
    assert_allclose(peak(ts, np.asarray(sol.xs[:, 1])), p.highest, rtol=0, atol=1e-11)


def peak(ts, values):
    """The maximum, from a polynomial through the samples around the largest one."""
    k = int(np.argmax(values))
    if values[k - 1] == values[k] or values[k + 1] == values[k]:
        return values[k]
    near = slice(k - 4, k + 5)
    fit = np.polynomial.Polynomial.fit(ts[near], values[near], 8)
    roots = fit.deriv().roots()
    real = roots[abs(roots.imag) < 1e-9].real
    return fit(real[np.argmin(abs(real - ts[k]))])


@pytest.mark.parametrize("name", BELT_ORBITS)
def test_belt_multipliers(name):
    # From t = 1/2 on, when every orbit slips: the same multipliers as from t = 0.
    p = PROBLEMS[name]
    start = flow(p.system, jnp.asarray(p.x0, float), 0.0, 0.5).xs[-1]
    matrix = jacobian(p.system, start, 0.5, 0.5 + p.t1)
    got = by_imaginary_part(np.linalg.eigvals(matrix))
    assert_allclose(got, p.multipliers, rtol=0, atol=p.digits)
    if p.multipliers[0] == 0:
        assert min(abs(got)) < 1e-12
    # The trace of the damping; two crossings have their saltation besides.
    if not p.kinds:
        assert_allclose(np.linalg.det(matrix), np.exp(BELT_DAMPING * p.t1), rtol=1e-11)


def linear_orbit(omega):
    """Start of the belt's non-sliding orbit in case 1 (sgn = -1 throughout), by hand."""
    response = 10 / (10 - omega**2 + 0.4905j * omega)
    shift = (0.4905 + 0.6 * 9.81) / 10
    return jnp.asarray([shift + response.real, (1j * omega * response).real])


@pytest.mark.parametrize(("omega", "inside"), [*zip(BELT_GRAZES, (1, -1), strict=True)])
def test_belt_non_sliding_orbit_grazes(omega, inside):
    for side, met in ((-inside, False), (inside, True)):
        near = omega + 1e-8 * side
        sol = flow(belt(near), linear_orbit(near), 0.0, 2 * np.pi / near)
        assert (sol.num_events > 0) == met


@pytest.fixture(scope="module")
def censuses():
    """Numbers of crossings, sticks and slips in four periods after sixty, by omega."""

    @jax.jit
    @jax.vmap
    def census(omega):
        system = belt(omega)
        period, dt = system.period, system.period / 40
        x0 = jnp.asarray([1.0, 0.5])
        x1 = jf.solve(system, x0, 0.0, 60 * period, dt, max_events=None, throw=False).xs[-1]
        sol = jf.solve(system, x1, 0.0, 4 * period, dt, max_events=64, throw=False)
        good = sol.result == RESULTS.successful
        return good, jnp.stack([jnp.sum(sol.events.kinds == k) for k in (CROSS, STICK, SLIP)])

    omegas = [w + d for w in BELT_CHANGES for d in (-1e-3, 1e-3)]
    adding = [BELT_ADDS + d for d in (-1e-7, 1e-7)]
    good, counts = census(jnp.asarray(omegas + adding))
    assert good.all()
    return np.asarray(counts).reshape(10, 2, 3)


@pytest.mark.slow
def test_belt_case_1_changes_its_event_sequence_at_nine_values(censuses):
    for omega, (below, above) in zip(BELT_CHANGES, censuses[:9], strict=True):
        assert tuple(below) != tuple(above), omega


@pytest.mark.slow
def test_belt_case_1_adds_a_slide(censuses):
    # A slip of 2 ms splits the stick.
    assert_array_equal(censuses[-1], [[0, 4, 4], [0, 8, 8]])


def test_belt_case_2_orbit():
    p = PROBLEMS["cubic belt 4.56"]
    x0 = jnp.asarray(p.x0)
    saveat = diffrax.SaveAt(ts=jnp.linspace(0.0, p.t1, 1001))
    sol = jf.solve(p.system, x0, 0.0, p.t1, p.t1 / 400, saveat=saveat)
    assert sol.num_events == 0
    assert_allclose(sol.xs[-1], x0, rtol=0, atol=1e-10)
    highest = peak(np.asarray(sol.ts), np.asarray(sol.xs[:, 1]))
    assert_allclose(highest, p.highest, rtol=0, atol=1e-11)
    multipliers = np.linalg.eigvals(jacobian(p.system, x0, 0.0, p.t1))
    assert_allclose(by_imaginary_part(multipliers), p.multipliers, rtol=0, atol=p.digits)
    assert_allclose(np.log(abs(multipliers)) / p.t1, BELT_DAMPING / 2, rtol=1e-9)


@pytest.mark.slow
def test_belt_case_2_orbit_grazes():
    def newton(omega, x):
        system, period = cubic_belt(omega), 2 * np.pi / omega
        for _ in range(6):
            gap = flow(system, x, 0.0, period).xs[-1] - x
            x = x - jnp.linalg.solve(jacobian(system, x, 0.0, period) - jnp.eye(2), gap)
        return x

    x = jnp.asarray(PROBLEMS["cubic belt 4.56"].x0)
    for omega in np.linspace(4.58, 4.65, 8):
        x = newton(omega, x)
    omega = CUBIC_GRAZES - 1e-9
    x = newton(omega, x)
    ts = jnp.linspace(0.0, 2 * np.pi / omega, 1001)
    saveat = diffrax.SaveAt(ts=ts)
    sol = jf.solve(cubic_belt(omega), x, 0.0, ts[-1], ts[-1] / 400, saveat=saveat)
    assert sol.num_events == 0
    gap = 1 - peak(np.asarray(ts), np.asarray(sol.xs[:, 1]))
    # d(max x')/d(omega) is about 0.9 between 4.56 and the graze: (1 - 0.918)/0.0926.
    assert 0 < gap < 3e-9


def test_diagram_of_the_sd_oscillator_jumps_where_the_orbit_grazes():
    def spread(omega):
        diagram = jf.bifurcation_diagram(
            sd_oscillator(0.7),
            "omega",
            np.asarray([omega]),
            one_sided(omega),
            transient=200,
            samples=50,
            progress=False,
        )
        assert (diagram.results == RESULTS.successful).all()
        return np.ptp(np.asarray(diagram.xs)[0, :, 0])

    assert spread(SD_GRAZES[0] - 1e-6) < 1e-8
    assert spread(SD_GRAZES[0] + 1e-6) > 1.0


@pytest.mark.slow
def test_diagram_of_the_belt_jumps_from_rest():
    omegas = np.asarray([4.5600, 4.5633, 4.5644, 4.5700])
    assert np.argmax(omegas > CUBIC_JUMPS) == 2
    diagram = jf.bifurcation_diagram(
        cubic_belt(4.6),
        "omega",
        omegas,
        jnp.zeros(2),
        transient=200,
        samples=50,
        progress=False,
    )
    spread = np.ptp(np.asarray(diagram.xs)[:, :, 1], axis=1)
    x0 = PROBLEMS["cubic belt 4.56"].x0
    assert_allclose(diagram.xs[0, :, 0], x0[0], rtol=0, atol=1e-6)
    assert np.all(spread[:2] < 1e-6)
    assert np.all(spread[2:] > 0.1)
