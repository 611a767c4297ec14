"""Formulas for motions and orbits, written apart from the library.

Parameters, a start and times enter; states, amplitudes and multipliers leave. What is to be
differentiated is in `jax.numpy` and takes (system, x0, t0, t1); the rest is in NumPy.
"""

import jax.numpy as jnp
import numpy as np

F0, ZETA = 0.25, 0.0141


def response(omega):
    """The complex amplitude of the SD oscillator's motion about +1, x = 1 + Re(r e^(iΩt))."""
    return F0 / (1 - omega**2 + 2j * ZETA * omega)


def one_sided(omega):
    """The start of the SD oscillator's orbit about +1, which never meets x = 0."""
    return np.asarray([1 + response(omega).real, (1j * omega * response(omega)).real])


def wall_amplitude(omega):
    """The force at which the impact oscillator's steady motion touches the wall at 1."""
    return np.sqrt((1 - omega**2) ** 2 + 0.01 * omega**2)


def bounces(restitution, count):
    """Times of a ball's impacts, from 10 at rest with g = 9.8: each flight lasts e times the last.
    They accumulate at 10/7 (1 + e)/(1 - e)."""
    return 10 / 7 * (2 * np.cumsum(restitution ** np.arange(count)) - 1)


def den_hartog(omega=0.8, friction=0.3):
    """Amplitude and multipliers of Den Hartog's orbit (1931), two stops a period.

    √(V² - S²U²), V = 1/(1 - Ω²), U = tan(π/2Ω)/Ω; multipliers of [R(π/Ω) diag(1, ρ)]², ρ the ratio
    of the accelerations around a turn, R a rotation.
    """
    v, u = den_hartog_response(omega)
    amplitude = np.sqrt(v**2 - (friction * u) ** 2)
    rho = (omega**2 * amplitude - friction) / (omega**2 * amplitude + friction)
    c, s = np.cos(np.pi / omega), np.sin(np.pi / omega)
    half = np.asarray([[c, s], [-s, c]]) @ np.diag([1, rho])
    return amplitude, np.linalg.eigvals(half @ half)


def den_hartog_response(omega):
    """V and U of Den Hartog's formulas."""
    return 1 / (1 - omega**2), np.tan(np.pi / 2 / omega) / omega


def den_hartog_sticks(omega):
    """S* = Ω²|V|/√(1 + Ω⁴U²), the friction beyond which Den Hartog's orbit sticks at its turns."""
    v, u = den_hartog_response(omega)
    return omega**2 * abs(v) / np.sqrt(1 + omega**4 * u**2)


def den_hartog_start(t, omega=0.8, friction=0.3):
    """Time and state on Den Hartog's orbit, t after a maximum of x.

    x = V cos(Ωt + φ) + S - S cos t - S tan(π/2Ω) sin t until the minimum.
    """
    v, u = den_hartog_response(omega)
    amplitude, _ = den_hartog(omega, friction)
    phi = omega * t + np.arctan2(-friction * u / v, amplitude / v)
    b = -friction * omega * u
    x = v * np.cos(phi) + friction - friction * np.cos(t) + b * np.sin(t)
    dx = -omega * v * np.sin(phi) + friction * np.sin(t) + b * np.cos(t)
    return phi / omega, np.asarray([x, dx])


def rotating(system, x0, t0, t1):
    """|x| = r0 e^(t - t0); the rotation turns round where it is 1."""
    radius, angle = jnp.hypot(x0[0], x0[1]), jnp.arctan2(x0[1], x0[0])
    angle = angle + system.omega * (t1 - t0 + 2 * jnp.log(radius))
    return jnp.exp(t1 - t0) * radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def ball(system, x0, t0, t1):
    """After two impacts."""
    g, e = system.g, system.restitution
    speed = jnp.sqrt(x0[1] ** 2 + 2 * g * x0[0])
    first = (x0[1] + speed) / g
    rest = t1 - t0 - first - 2 * e * speed / g
    speed = e**2 * speed
    return jnp.stack([speed * rest - g * rest**2 / 2, speed - g * rest])


def relays(system, x0, t0, t1):
    """x = y is reached at the rate 3.5, and then followed at the speed -6/17."""
    meet = (x0[0] - x0[1]) / 3.5
    end = x0[0] - 2 * meet - 6 / 17 * (t1 - t0 - meet)
    return jnp.stack([end, end])


def box(system, x0, t0, t1):
    """Both sides positive, then x1 held (s1 = p/2), then x2 too (s2 = p q/4)."""
    p, q = system.p, system.q
    first = x0[0] / (2 - p)
    x2 = x0[1] + (q - 2) * first
    second = first + x2 / (2 - p * q / 2)
    s1, s2 = p / 2, p * q / 4
    end = x0[2] + 4 * first + (2 * s1 + 2) * (second - first)
    end = end + (s1 + 2 * s2 + s1 * s2) * (t1 - t0 - second)
    return jnp.stack([0 * t0, 0 * t0, end])


def leave(system, x0, t0, t1):
    """Meets y = 0 from above while t < friction; side = t/friction while held."""
    f = system.friction
    meet = f - jnp.sqrt((f - t0) ** 2 - 2 * x0[1])
    x = x0[0] + (meet - t0) + (f**2 - meet**2) / (2 * f) + (t1 - f)
    return jnp.stack([x, (t1 - f) ** 2 / 2])


def coulomb(system, x0, t0, t1):
    """A quarter-turn or less about -F to the first maximum; each of the next four half-turns takes
    2 F of the excursion, then it sticks."""
    amplitude = jnp.hypot(x0[0] + system.friction, x0[1])
    return jnp.stack([amplitude - 9 * system.friction, 0 * t0])
