"""Orbits of the SD oscillator and of belt friction against independent reference numbers.

The systems are those of Santhosh, Narayanan and Padmanabhan, Procedia IUTAM 19 (2016) 219-227. The
numbers are not the paper's, some of which are misprinted, but a corrected reference: closed forms
per piece with 60-digit Newton for the piecewise-linear systems, Taylor series in mpmath for the
cubic one, cross-checked with an event-driven DOP853 at 1e-13.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind

CROSS, STICK, SLIP = EventKind.crossing, EventKind.stick, EventKind.slip


@jax.jit
def flow(system, x0, t0, t1):
    """A run with 400 steps, of which events and end are asked."""
    return jf.solve(system, x0, t0, t1, (t1 - t0) / 400, max_events=16)


@jax.jit
def jacobian(system, x0, t0, t1):
    """The derivative of the end of `flow` by its start."""
    return jax.jacfwd(lambda x: flow(system, x, t0, t1).xs[-1])(x0)


def by_imaginary_part(values):
    return sorted(values, key=lambda z: (np.imag(z), np.real(z)))


def sd_oscillator(omega):
    return jf.systems.SDOscillator(f0=0.25, zeta=0.0141, omega=omega)


def one_sided(omega):
    """Start of the SD oscillator's orbit about +1, by hand."""
    response = 0.25 / (1 - omega**2 + 2j * 0.0141 * omega)
    return jnp.asarray([1 + response.real, (1j * omega * response).real])


def belt(omega, case=1):
    gamma1, gamma2 = (10.0, 0.0) if case == 1 else (0.0, 10000.0)
    return jf.systems.BeltFriction(
        f0=10.0,
        g=9.81,
        mu=0.6,
        alpha=-0.05,
        beta=0.0,
        gamma1=gamma1,
        gamma2=gamma2,
        v=1.0,
        omega=omega,
    )


def test_sd_oscillator_states_and_contacts():
    saveat = diffrax.SaveAt(ts=jnp.asarray([5.0, 40.0]))
    sol = jf.solve(
        sd_oscillator(0.7), jnp.asarray([0.3, 0.1]), 0.0, 40.0, 0.025, saveat=saveat, max_events=16
    )
    assert_allclose(
        sol.xs,
        [
            [0.15854311422638651592, -0.93147098153906364592],
            [-3.61547391145097192825, 0.61719527603447126335],
        ],
        rtol=0,
        atol=1e-11,
    )
    assert sol.num_events == 9
    assert_array_equal(sol.events.kinds[:9], CROSS)
    assert_allclose(sol.events.ts[0], 5.18257758628244488158, rtol=0, atol=1e-12)


def test_sd_oscillator_symmetric_orbit():
    system, period = sd_oscillator(0.7), 2 * np.pi / 0.7
    x0 = jnp.asarray([2.972909733962379342, 0.618617859127108525])
    sol = flow(system, x0, 0.0, period)
    assert_allclose(sol.xs[-1], x0, rtol=0, atol=1e-10)
    assert_array_equal(sol.events.kinds[: int(sol.num_events)], [CROSS, CROSS])
    multipliers = np.linalg.eigvals(jacobian(system, x0, 0.0, period))
    want = [0.35398 - 0.80689j, 0.35398 + 0.80689j]
    assert_allclose(by_imaginary_part(multipliers), want, rtol=0, atol=1e-5)


@pytest.mark.parametrize("omega", [0.7, 0.866, 1.3])
def test_sd_oscillator_exponents_sum_to_minus_two_zeta(omega):
    # Crossings keep areas (both fields have the same dH/dt), so the determinant is exact.
    system = sd_oscillator(omega)
    determinant = np.linalg.det(jacobian(system, jnp.asarray([0.3, 0.1]), 0.0, 20.0))
    assert_allclose(np.log(determinant) / 20, -0.0282, rtol=1e-10)


def test_sd_oscillator_one_sided_multipliers():
    # No contact: a damped rotation, both exponents -ζ.
    system, period = sd_oscillator(0.7), 2 * np.pi / 0.7
    multipliers = np.linalg.eigvals(jacobian(system, one_sided(0.7), 0.0, period))
    assert_allclose(np.log(abs(multipliers)) / period, -0.0141, rtol=1e-10)


@pytest.mark.parametrize(("omega", "inside"), [(0.866716581971234, 1), (1.117142393133526, -1)])
def test_sd_oscillator_one_sided_orbit_grazes(omega, inside):
    # Exact: f0 = √((1 - Ω²)² + (2ζΩ)²). The amplitude is above 1 between the two values.
    for side, met in ((-inside, False), (inside, True)):
        near = omega + 1e-8 * side
        sol = flow(sd_oscillator(near), one_sided(near), 0.0, 2 * np.pi / near)
        assert (sol.num_events > 0) == met


# omega: x(0), switches in a period as (time, mode before, mode after), max x', multipliers.
ORBITS = {
    1.3: (
        (1.562680507274925516, 1),
        [(0.02537543579827, 0, -1), (3.38825895300931, -1, 0)],
        1,
        [-0.199459730884038, 0],
    ),
    2.44: (
        (0.893154126723387260, 3.181072481841881173),
        [(0.24043386276687, 1, -1), (1.73126530991045, -1, 1)],
        3.781163696487915,
        [0.0025495 - 0.0145254j, 0.0025495 + 0.0145254j],
    ),
    9.1: (
        (0.431566227111474261, 0.285460370360303195),
        [(0.06500878225883, -1, 0), (0.17328503134631, 0, -1)],
        1,
        [-0.161706955546901, 0],
    ),
    17.0: (
        (0.601839693239804056, 0.018194523762144070),
        [],
        0.609047044980828,
        [0.360329 - 0.839260j, 0.360329 + 0.839260j],
    ),
}


def kind(before, after):
    return CROSS if before * after != 0 else STICK if after == 0 else SLIP


@pytest.mark.parametrize("omega", ORBITS)
def test_belt_orbit_closes(omega):
    x0, switches, _, _ = ORBITS[omega]
    sol = flow(belt(omega), jnp.asarray(x0, float), 0.0, 2 * np.pi / omega)
    count = len(switches)
    assert sol.num_events == count
    assert_array_equal(sol.events.kinds[:count], [kind(*switch[1:]) for switch in switches])
    assert_allclose(sol.events.ts[:count], [s[0] for s in switches], rtol=0, atol=1e-10)
    assert_allclose(sol.xs[-1], x0, rtol=0, atol=1e-10)


@pytest.mark.parametrize("omega", ORBITS)
def test_belt_orbit_modes_and_highest_speed(omega):
    x0, switches, highest, _ = ORBITS[omega]
    ts = np.linspace(0.0, 2 * np.pi / omega, 1001)
    saveat = diffrax.SaveAt(ts=jnp.asarray(ts))
    sol = jf.solve(belt(omega), jnp.asarray(x0, float), 0.0, ts[-1], ts[-1] / 100, saveat=saveat)
    want = np.full(1001, switches[0][1] if switches else -1)
    for t, _, after in switches:
        want[ts > t] = after
    assert_array_equal(sol.modes[:, 0], want)
    assert_allclose(peak(ts, np.asarray(sol.xs[:, 1])), highest, rtol=0, atol=1e-11)


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


@pytest.mark.parametrize("omega", ORBITS)
def test_belt_multipliers(omega):
    # From t = 1/2 on, when every orbit slips: the same multipliers as from t = 0.
    x0, _, _, multipliers = ORBITS[omega]
    system, period = belt(omega), 2 * np.pi / omega
    start = flow(system, jnp.asarray(x0, float), 0.0, 0.5).xs[-1]
    matrix = jacobian(system, start, 0.5, 0.5 + period)
    got = np.linalg.eigvals(matrix)
    if multipliers[1] == 0:
        assert_allclose(sorted(got, key=abs), [0, multipliers[0]], rtol=0, atol=1e-11)
        assert min(abs(got)) < 1e-12
    else:
        digits = {2.44: 1e-7, 17.0: 1e-6}[omega]
        assert_allclose(by_imaginary_part(got), multipliers, rtol=0, atol=digits)
        # The trace of the damping, αg = -0.4905, and for two crossings their saltation.
        if omega == 17.0:
            assert_allclose(np.linalg.det(matrix), np.exp(-0.4905 * period), rtol=1e-11)


def linear_orbit(omega):
    """Start of the belt's non-sliding orbit in case 1 (sgn = -1 throughout), by hand."""
    response = 10 / (10 - omega**2 + 0.4905j * omega)
    shift = (0.4905 + 0.6 * 9.81) / 10
    return jnp.asarray([shift + response.real, (1j * omega * response).real])


@pytest.mark.parametrize(("omega", "inside"), [(0.917012578766336, 1), (10.904975822090772, -1)])
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

    near = [0.917, 1.398, 1.403, 1.549, 1.914, 2.438, 4.217, 7.952, 10.905]
    omegas = [w + d for w in near for d in (-1e-3, 1e-3)]
    adding = [1.548910479930516 + d for d in (-1e-7, 1e-7)]
    good, counts = census(jnp.asarray(omegas + adding))
    assert good.all()
    return near, np.asarray(counts).reshape(10, 2, 3)


def test_belt_case_1_changes_its_event_sequence_at_nine_values(censuses):
    near, counts = censuses
    for omega, (below, above) in zip(near, counts, strict=False):
        assert tuple(below) != tuple(above), omega


def test_belt_case_1_adds_a_slide(censuses):
    # Adding-sliding at 1.548910479930516: a slip of 2 ms splits the stick.
    _, counts = censuses
    assert_array_equal(counts[-1], [[0, 4, 4], [0, 8, 8]])


def test_belt_case_2_orbit():
    system, period = belt(4.56, case=2), 2 * np.pi / 4.56
    x0 = jnp.asarray([0.1483395597000811859, 0.3581899498626866293])
    saveat = diffrax.SaveAt(ts=jnp.linspace(0.0, period, 1001))
    sol = jf.solve(system, x0, 0.0, period, period / 400, saveat=saveat)
    assert sol.num_events == 0
    assert_allclose(sol.xs[-1], x0, rtol=0, atol=1e-10)
    highest = peak(np.asarray(sol.ts), np.asarray(sol.xs[:, 1]))
    assert_allclose(highest, 0.91797746369765, rtol=0, atol=1e-11)
    multipliers = np.linalg.eigvals(jacobian(system, x0, 0.0, period))
    want = [-0.31062397377592 - 0.64205422198867j, -0.31062397377592 + 0.64205422198867j]
    assert_allclose(by_imaginary_part(multipliers), want, rtol=0, atol=1e-10)
    assert_allclose(np.log(abs(multipliers)) / period, -0.24525, rtol=1e-9)


def test_belt_case_2_orbit_grazes():
    # At omega = 4.652570419201206, not at the paper's 4.565.
    def newton(omega, x):
        system, period = belt(omega, case=2), 2 * np.pi / omega
        for _ in range(6):
            gap = flow(system, x, 0.0, period).xs[-1] - x
            x = x - jnp.linalg.solve(jacobian(system, x, 0.0, period) - jnp.eye(2), gap)
        return x

    x = jnp.asarray([0.1483395597000811859, 0.3581899498626866293])
    for omega in np.linspace(4.58, 4.65, 8):
        x = newton(omega, x)
    omega = 4.652570419201206 - 1e-9
    x = newton(omega, x)
    ts = jnp.linspace(0.0, 2 * np.pi / omega, 1001)
    saveat = diffrax.SaveAt(ts=ts)
    sol = jf.solve(belt(omega, case=2), x, 0.0, ts[-1], ts[-1] / 400, saveat=saveat)
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

    assert spread(0.866716581971234 - 1e-6) < 1e-8
    assert spread(0.866716581971234 + 1e-6) > 1.0


def test_diagram_of_the_belt_jumps_from_rest():
    # From (0, 0) the long-term motion jumps to the sticking attractor at 4.56382205.
    omegas = np.asarray([4.5600, 4.5633, 4.5644, 4.5700])
    diagram = jf.bifurcation_diagram(
        belt(4.6, case=2),
        "omega",
        omegas,
        jnp.zeros(2),
        transient=200,
        samples=50,
        progress=False,
    )
    spread = np.ptp(np.asarray(diagram.xs)[:, :, 1], axis=1)
    assert_allclose(diagram.xs[0, :, 0], 0.1483395597000811859, atol=1e-6)
    assert np.all(spread[:2] < 1e-6)
    assert np.all(spread[2:] > 0.1)
