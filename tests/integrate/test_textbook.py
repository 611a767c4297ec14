"""Problems of the event-driven and Filippov literature with known answers.

"Exact" is by hand; the other numbers come from an event-driven DOP853 at 1e-13 that shares nothing
with this library, and are right to the digits given. The default stepper throughout.
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


def table(sol):
    """Times and kinds of the events that happened."""
    count = int(sol.num_events)
    return np.asarray(sol.events.ts[:count]), sol.events.kinds[:count].tolist()


def test_coulomb_oscillator():
    # x'' = -x - F sgn x' from (3, 0). Exact: turns at π, 2π, 3π, sticks at 4π at 3 - 8F.
    ts = jnp.concatenate([np.pi * jnp.arange(1.0, 5.0) + 1e-3, jnp.asarray([20.0])])
    sol = jf.solve(
        jf.systems.CoulombOscillator(friction=0.4),
        jnp.asarray([3.0, 0.0]),
        0.0,
        20.0,
        0.1,
        saveat=diffrax.SaveAt(ts=ts),
    )
    times, kinds = table(sol)
    assert kinds == [CROSS, CROSS, CROSS, STICK]
    assert_allclose(times, np.pi * np.arange(1, 5), rtol=1e-12)
    assert_allclose(sol.events.xs[:4, 0], [-2.2, 1.4, -0.6, -0.2], atol=1e-12)
    rows = repr(sol.events).splitlines()
    assert rows[0].split() == ["t", "kind", "surface", "x", "just", "before"]
    assert rows[4].split()[:4] == ["12.5663706143592", "stick", "0", "[-0.2,"] and len(rows) == 5
    assert "5 states saved (room for 5)" in repr(sol)
    assert_allclose(sol.xs[-1], [-0.2, 0], atol=1e-12)
    assert_array_equal(sol.modes[:, 0], [1, -1, 1, 0, 0])


def test_coulomb_oscillator_derivatives():
    # Exact: ∂x(20)/∂(x0, v0, F) = (1, 0, -8); the velocity is 0 whatever they are.
    def end(x0, friction):
        system = jf.systems.CoulombOscillator(friction=friction)
        return jf.solve(system, x0, 0.0, 20.0, 0.1).xs[-1]

    d_x0, d_friction = jax.jacfwd(end, (0, 1))(jnp.asarray([3.0, 0.0]), jnp.asarray(0.4))
    assert_allclose(d_x0, [[1, 0], [0, 0]], atol=1e-12)
    assert_allclose(d_friction, [-8, 0], atol=1e-12)


def test_moving_belt():
    # DISODE45 (Calvo, Montijano, Rández 2016): a surface that depends on time.
    sol = jf.solve(
        jf.systems.MovingBelt(friction=0.4), jnp.asarray([3.0, 0.0]), 0.0, 28.0, 0.05, max_events=9
    )
    times, kinds = table(sol)
    want = [
        7.60556996475,
        9.48337857886,
        9.76525875446,
        14.80510568909,
        17.45893964391,
        26.13168182465,
        27.29115689348,
    ]
    assert kinds == [CROSS, STICK, SLIP, CROSS, CROSS, STICK, SLIP]
    assert_allclose(times, want, atol=1e-11)


@pytest.mark.parametrize("end", [0.5, 1.7, 2.0])
def test_rotating_oscillator(end):
    # nosnoc (Nurkanović et al.). Exact: switches at t = 1, ends at e^(T-1) at angle -2π(T-1).
    sol = jf.solve(jf.systems.RotatingOscillator(), jnp.asarray([np.exp(-1), 0.0]), 0.0, end, 0.02)
    times, _ = table(sol)
    assert_allclose(times, [1.0] if end > 1 else [], rtol=1e-12)
    angle = 2 * np.pi * (end - 1) * (1 if end > 1 else -1)
    want = np.exp(end - 1) * np.asarray([np.cos(angle), -np.sin(angle)])
    assert_allclose(sol.xs[-1], want, atol=1e-11)


def test_rotating_oscillator_between_its_steps():
    # The dense output keeps the order, across the contact at t = 1 too.
    saveat = diffrax.SaveAt(dense=True)
    x0 = jnp.asarray([np.exp(-1), 0.0])
    sol = jf.solve(jf.systems.RotatingOscillator(), x0, 0.0, 2.0, 0.02, saveat=saveat)
    ts = np.asarray([0.0, 0.333, 0.9999, 1.0001, 1.011, 1.777, 2.0])
    angle = 2 * np.pi * abs(ts - 1)
    want = np.exp(ts - 1)[:, None] * np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    assert_allclose(jax.vmap(sol.evaluate)(jnp.asarray(ts)), want, atol=1e-11)
    assert np.isnan(sol.evaluate(2.1)).all()


def test_smoothed_field_by_hand():
    # sgn x' becomes (2/π) arctan(x'/width).
    smooth = jf.smoothed(jf.systems.CoulombOscillator(friction=0.4), 0.1)
    field = smooth.vector_field(jnp.zeros(()), jnp.asarray([0.5, 0.2]), jnp.zeros((0,)))
    assert_allclose(field, [0.2, -0.5 - 0.4 * 2 / np.pi * np.arctan(2)], rtol=1e-14)


def test_smoothed_coulomb_oscillator_comes_close():
    smooth = jf.smoothed(jf.systems.CoulombOscillator(friction=0.4), 1e-3)
    sol = jf.solve(smooth, jnp.asarray([3.0, 0.0]), 0.0, 4 * np.pi, 1e-4)
    assert sol.num_events == 0
    # Where it should stick it creeps, at the speed width·tan(π/2 · 0.2/0.4).
    assert_allclose(sol.xs[-1], [-0.2, 1e-3], atol=1e-2)


PERIOD = 9.230770458083


def test_slip_stick():
    # From the exit of the stick, exactly at (1, 0.2), once round.
    sol = jf.solve(
        jf.systems.SlipStick(), jnp.asarray([1.0, 0.2]), 0.0, PERIOD + 1.0, 0.02, max_events=4
    )
    times, kinds = table(sol)
    assert kinds == [STICK, SLIP]
    assert_allclose(sol.events.xs[:2, 0], [0.094518907972, 1.0], atol=1e-12)
    assert_allclose(sol.events.xs[:2, 1], 0.2, rtol=1e-13)
    assert_allclose(times[1], PERIOD, atol=1e-12)
    assert_allclose(times[0], PERIOD - (1 - 0.094518907972) / 0.2, atol=5e-11)


def test_slip_stick_multipliers():
    # Autonomous: 1 along the orbit; an orbit that sticks: 0 across it.
    def end(x0, t1):
        return jf.solve(jf.systems.SlipStick(), x0, 0.0, t1, 0.02).xs[-1]

    x0 = end(jnp.asarray([1.0, 0.2]), 2.0)
    multipliers = np.linalg.eigvals(jax.jacfwd(end)(x0, PERIOD))
    assert_allclose(sorted(abs(multipliers)), [0, 1], atol=1e-11)
    assert abs(np.linalg.det(jax.jacfwd(end)(x0, PERIOD))) < 1e-12


def den_hartog(t, omega=0.8, s=0.3):
    """Time and state on the exact symmetric orbit, t after a maximum of x.

    x = V cos(Ωt + φ) + S - S cos t - S tan(π/2Ω) sin t until the minimum.
    """
    v = 1 / (1 - omega**2)
    u = np.tan(np.pi / 2 / omega) / omega
    amplitude = np.sqrt(v**2 - s**2 * u**2)
    phase = np.arctan2(-s * u / v, amplitude / v)
    phi = omega * t + phase
    b = -s * omega * u
    x = v * np.cos(phi) + s - s * np.cos(t) + b * np.sin(t)
    dx = -omega * v * np.sin(phi) + s * np.sin(t) + b * np.cos(t)
    return amplitude, phi / omega, jnp.asarray([x, dx])


def test_den_hartog():
    # Exact amplitude √(V² - S²U²); started half-way down, so that no contact is at the start.
    amplitude, t0, x0 = den_hartog(1.5)
    assert_allclose(amplitude, 2.6261048757, atol=1e-10)
    period = 2 * np.pi / 0.8
    sol = jf.solve(
        jf.systems.DenHartog(friction=0.3, omega=0.8), x0, t0, t0 + 2 * period, 0.05, max_events=9
    )
    times, kinds = table(sol)
    assert kinds == [CROSS] * 4
    assert_allclose(times - t0, period / 2 * np.arange(1, 5) - 1.5, rtol=1e-12)
    assert_allclose(sol.events.xs[:4, 0], amplitude * np.asarray([-1, 1, -1, 1]), rtol=1e-12)
    assert_allclose(sol.xs[-1], x0, atol=1e-12)


def test_den_hartog_multipliers():
    def end(x0):
        system = jf.systems.DenHartog(friction=0.3, omega=0.8)
        return jf.solve(system, x0, t0, t0 + 2 * np.pi / 0.8, 0.05).xs[-1]

    amplitude, t0, x0 = den_hartog(1.5)
    multipliers = np.linalg.eigvals(jax.jacfwd(end)(x0))
    want = 0.022940452694 + 0.696700298863j
    assert_allclose(sorted(multipliers, key=np.imag), [want.conjugate(), want], atol=1e-11)
    half = np.pi / 0.8
    rho = (0.64 * amplitude - 0.3) / (0.64 * amplitude + 0.3)
    rotation = np.asarray([[np.cos(half), np.sin(half)], [-np.sin(half), np.cos(half)]])
    exact = np.linalg.eigvals(np.linalg.matrix_power(rotation @ np.diag([1, rho]), 2))
    assert_allclose(sorted(multipliers, key=np.imag), sorted(exact, key=np.imag), atol=1e-12)


def test_den_hartog_sticks_beyond_its_crossing_sliding():
    # Exact S* = Ω²|V|/√(1 + Ω⁴U²) = 0.8174063857, where ρ = 0: transients die at once.
    omega = 0.8
    v, u = 1 / (1 - omega**2), np.tan(np.pi / 2 / omega) / omega
    s_star = omega**2 * abs(v) / np.sqrt(1 + omega**4 * u**2)
    assert_allclose(s_star, 0.8174063857, atol=1e-10)
    period = 2 * np.pi / omega

    def slides(s):
        system = jf.systems.DenHartog(friction=s, omega=omega)
        x0 = jnp.asarray([0.5, 0.5])
        start = jf.solve(system, x0, 0.0, 60 * period, 0.1, max_events=None).xs[-1]
        sol = jf.solve(system, start, 0.0, 4 * period, 0.1, max_events=16)
        return jnp.sum(sol.events.kinds == STICK), jnp.sum(sol.events.kinds == CROSS)

    sticks, crossings = jax.jit(jax.vmap(slides))(s_star + jnp.asarray([-1e-5, 1e-5]))
    assert_array_equal(sticks, [0, 8])
    assert_array_equal(crossings, [8, 0])


@pytest.mark.parametrize(("omega", "amplitude"), [(1.0, 0.1), (1.2, 0.4560701704)])
def test_impact_oscillator(omega, amplitude):
    # Exact grazing amplitude √((k - ω²)² + c²ω²) d. On the steady orbit just below it the wall is
    # not reached; just above it is, in the first period.
    exact = np.sqrt((1 - omega**2) ** 2 + 0.01 * omega**2)
    assert_allclose(exact, amplitude, atol=1e-10)

    # x = A cos(ωt - δ)/exact on the steady orbit.
    delta = np.arctan2(0.1 * omega, 1 - omega**2)
    unit = jnp.asarray([np.cos(delta), omega * np.sin(delta)])

    def impacts(scale):
        system = jf.systems.ImpactOscillator(amplitude=exact * scale, omega=omega)
        sol = jf.solve(system, scale * unit, 0.0, system.period, 0.05)
        return sol.num_events, sol.events.kinds[0], sol.xs[-1] - scale * unit

    scales = 1 + jnp.asarray([-1e-3, -1e-9, 1e-9, 1e-3])
    counts, kinds, gaps = jax.jit(jax.vmap(impacts))(scales)
    assert_array_equal(counts[:2], 0)
    assert np.all(np.asarray(counts[2:]) >= 1)
    assert_array_equal(kinds[2:], EventKind.impact)
    assert_allclose(gaps[:2], 0, atol=1e-11)


def test_bouncing_ball():
    # Exact: 10/7, 4, 6.3142857..., accumulating at 190/7 = 27.142857...
    ball = jf.systems.BouncingBall(g=9.8, restitution=0.9)
    sol = jf.solve(ball, jnp.asarray([10.0, 0.0]), 0.0, 40.0, 0.25, throw=False)
    times, kinds = table(sol)
    assert sol.result == RESULTS.zeno
    assert set(kinds) == {EventKind.impact}
    assert_allclose(times[:3], [10 / 7, 4, 6.3142857142857143], rtol=1e-13)
    assert_allclose(times[:100], 10 / 7 * (2 * np.cumsum(0.9 ** np.arange(100)) - 1), rtol=1e-11)
    assert_allclose(sol.t_final, 190 / 7, rtol=1e-10)
    with pytest.raises(RuntimeError, match="Zeno"):
        jf.solve(ball, jnp.asarray([10.0, 0.0]), 0.0, 40.0, 0.25)


def test_filippov_spiral():
    # Exact: at the origin at t = 1/2 after infinitely many crossings, each leg a third of the
    # last; rests there.
    sol = jf.solve(
        jf.systems.FilippovSpiral(),
        jnp.asarray([0.0, 1.0]),
        0.0,
        2.0,
        0.1,
        saveat=diffrax.SaveAt(ts=jnp.asarray([1 / 6, 0.50001, 2.0])),
    )
    assert sol.result == RESULTS.successful
    times, kinds = table(sol)
    assert_allclose(times[:8], 0.5 - 0.5 * 3.0 ** -np.arange(1, 9), rtol=1e-12)
    assert_allclose(times[-1], 0.5, rtol=1e-12)
    assert kinds[:8] == [CROSS] * 8
    assert kinds[-1] == STICK
    assert_allclose(sol.xs, [[1 / 6, 0.5], [0, 0], [0, 0]], atol=1e-13)
    assert_array_equal(sol.modes[1:], 0)


def test_visible_fold():
    # Slides on the circle |x|² = 2 and leaves it at the fold (-1, -1).
    sol = jf.solve(jf.systems.VisibleFold(), jnp.asarray([-1.0, 0.1]), 0.0, 3.0, 0.02, max_events=4)
    times, kinds = table(sol)
    assert kinds == [STICK, SLIP]
    assert_allclose(times, [0.34159842485, 1.82862978083], atol=1e-11)
    assert_allclose(sol.events.xs[1], [-1, -1], atol=1e-11)
    left = 3 - 1.82862978083
    assert_allclose(sol.xs[-1], [-1 + left, -1 - left], atol=1e-11)


def test_two_relays():
    # Exact: on x = y from t = 1/7, at 15.5/17 at t = 1.
    sol = jf.solve(jf.systems.TwoRelays(), jnp.asarray([1.5, 1.0]), 0.0, 1.0, 0.1)
    times, kinds = table(sol)
    assert kinds == [STICK]
    assert_allclose(times, [1 / 7], rtol=1e-13)
    assert_allclose(sol.xs[-1], [15.5 / 17, 15.5 / 17], rtol=1e-13)
    assert_array_equal(sol.modes[-1], [0])


def test_tables_without_contacts_and_of_many_lanes_are_printed_too():
    def events(x):
        return jf.solve(jf.systems.TwoRelays(), x, 0.0, 0.1, 0.1, max_events=4).events

    assert repr(events(jnp.asarray([1.5, 1.0]))) == "Events: no contacts"
    assert repr(jax.vmap(events)(jnp.ones((3, 2)) * 1.5)) == "Events: tables of shape (3, 4)"
