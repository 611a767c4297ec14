"""Eight problems as plain formulas, the same for every program but jaxfil, which has its own.

Nothing enters. A `Problem` leaves: fields, surface, sliding and what follows a contact, written
with an array module `xp` (`math`, `jax.numpy` or `heyoka`: all they need of it is `cos` and
`sin`), an initial state, a time, and the state then, from elsewhere.

A mode is +1 or −1, a side of the surface H = 0, or 0, a slide on it. On the surface dH/dt is
push ∓ grip on the two sides: the state slides while |push| < grip, and else goes where push points.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

LONG = "heyoka in long double at 1e-18; SciPy's DOP853 at 1e-13 agrees to 1e-11"


class Problem(NamedTuple):
    """`field(t, x, side, xp)`, `slide`, `height`, `push` and `place`, all of (t, x, xp).

    `place` puts a state that has met the surface exactly on it, or through its impact. `pace` is a
    time in which no slide begins and ends: sliding states have no error that would bound a step.
    `reference` is the state at `t1`, and `source` where it comes from.
    """

    name: str
    title: str
    x0: tuple[float, float]
    t1: float
    contacts: int
    field: Callable
    height: Callable
    push: Callable
    place: Callable
    reference: tuple[float, float]
    source: str
    grip: float = 0.0
    slide: Callable | None = None
    pace: float = 0.1
    impacts: bool = False

    def first_mode(self):
        """The side on which it begins; no problem here begins on the surface."""
        return 1 if self.height(0.0, self.x0, math) > 0 else -1

    def guard(self, mode, t, x, xp):
        """Positive while the mode lasts; its fall through zero is a contact."""
        if mode == 0:
            return 1 - (self.push(t, x, xp) / self.grip) ** 2
        return mode * self.height(t, x, xp)

    def rate(self, mode, t, x, xp):
        """dx/dt in a mode, a tuple."""
        return self.slide(t, x, xp) if mode == 0 else self.field(t, x, mode, xp)

    def after(self, mode, t, x):
        """Mode and state after a contact, in plain numbers."""
        x = self.place(t, x, math)
        push = self.push(t, x, math)
        if mode != 0 and abs(push) < self.grip:
            return 0, x
        return (1 if push > 0 else -1), x


def sd_oscillator(omega=0.7, f0=0.25, zeta=0.0141):
    """The discontinuous SD oscillator, which crosses and never slides."""

    def field(t, x, side, xp):
        return x[1], f0 * xp.cos(omega * t) - 2 * zeta * x[1] - x[0] + side

    return Problem(
        name="sd",
        title="SD oscillator, Ω = 0.7",
        x0=(0.3, 0.1),
        t1=40.0,
        contacts=9,
        field=field,
        height=lambda t, x, xp: x[0],
        push=lambda t, x, xp: x[1],
        place=lambda t, x, xp: (0.0, x[1]),
        reference=(-3.61547391145097192825, 0.61719527603447126335),
        source="Taylor series in long double",
    )


def belt(name, title, omega, gamma1, gamma2, x0, periods, contacts, reference, source):
    """The belt friction oscillator with α = −0.05, β = 0."""
    f0, g, mu, alpha, v = 10.0, 9.81, 0.6, -0.05, 1.0

    def spring(x):
        return x[0] * (gamma1 + gamma2 * x[0] * x[0])

    def field(t, x, side, xp):
        friction = g * (alpha * (x[1] - v) - mu * side)
        return x[1], f0 * xp.cos(omega * t) + friction - spring(x)

    return Problem(
        name=name,
        title=title,
        x0=x0,
        t1=periods * 2 * math.pi / omega,
        contacts=contacts,
        field=field,
        height=lambda t, x, xp: x[1] - v,
        push=lambda t, x, xp: f0 * xp.cos(omega * t) - spring(x),
        place=lambda t, x, xp: (x[0], v),
        grip=mu * g,
        slide=lambda t, x, xp: (v, 0.0),
        pace=2 * math.pi / omega / 50,
        reference=reference,
        source=source,
    )


def rotating_oscillator(omega=-2 * math.pi):
    """A spiral that turns the other way outside of the unit circle."""

    def field(t, x, side, xp):
        spin = -side * omega
        return x[0] + spin * x[1], x[1] - spin * x[0]

    def place(t, x, xp):
        # Along the normal, one step of Newton's method: the landing is that near.
        scale = 1 - (x[0] * x[0] + x[1] * x[1] - 1) / 2
        return scale * x[0], scale * x[1]

    return Problem(
        name="rotating",
        title="Rotating oscillator (a curved surface)",
        x0=(math.exp(-1), 0.0),
        t1=2.0,
        contacts=1,
        field=field,
        height=lambda t, x, xp: x[0] * x[0] + x[1] * x[1] - 1,
        push=lambda t, x, xp: x[0] * x[0] + x[1] * x[1],
        place=place,
        reference=(math.e, 0.0),
        source="the exact solution",
    )


def moving_belt(friction=0.4):
    """A mass on a belt of speed cos t + 0.7."""

    def force(t, x, xp):
        return xp.cos(0.7 * t) - x[0] - 0.4 * x[1]

    return Problem(
        name="moving_belt",
        title="Moving belt (a surface that depends on time)",
        x0=(3.0, 0.0),
        t1=28.0,
        contacts=7,
        field=lambda t, x, side, xp: (x[1], force(t, x, xp) - friction * side),
        height=lambda t, x, xp: x[1] - xp.cos(t) - 0.7,
        push=lambda t, x, xp: force(t, x, xp) + xp.sin(t),
        place=lambda t, x, xp: (x[0], xp.cos(t) + 0.7),
        grip=friction,
        slide=lambda t, x, xp: (x[1], -xp.sin(t)),
        reference=(2.040268931054126, -0.421349603596297),
        source=LONG,
    )


def slip_stick():
    """A mass on a steady belt with friction that falls with speed."""

    def field(t, x, side, xp):
        below, above = (1 - side) / 2, (1 + side) / 2
        return x[1], below / (1.2 - x[1]) - above / (0.8 + x[1]) - x[0]

    return Problem(
        name="slip_stick",
        title="Slip–stick (autonomous)",
        x0=(1.5, 0.0),
        t1=20.0,
        contacts=4,
        field=field,
        height=lambda t, x, xp: x[1] - 0.2,
        push=lambda t, x, xp: -x[0],
        place=lambda t, x, xp: (x[0], 0.2),
        grip=1.0,
        slide=lambda t, x, xp: (0.2, 0.0),
        reference=(1.0328306492688717, 0.19713068183944593),
        source=LONG,
    )


def impact_oscillator(amplitude=0.5, omega=1.2, damping=0.1, wall=1.0, restitution=0.8):
    """A forced mass beside a wall."""

    def field(t, x, side, xp):
        return x[1], amplitude * xp.cos(omega * t) - damping * x[1] - x[0]

    return Problem(
        name="impact",
        title="Impact oscillator",
        x0=(0.0, 0.0),
        t1=40.0,
        contacts=7,
        field=field,
        height=lambda t, x, xp: wall - x[0],
        push=lambda t, x, xp: 1.0,
        place=lambda t, x, xp: (wall, -restitution * x[1]),
        reference=(-1.2880440747076236, 0.23884312119178072),
        source=LONG,
        impacts=True,
    )


CASE_1 = (0.893154126723387260, 3.181072481841881173)
PROBLEMS = {
    problem.name: problem
    for problem in (
        sd_oscillator(),
        belt(
            "belt_1",
            "Belt, case 1, ω = 2.44: a periodic orbit",
            2.44,
            10.0,
            0.0,
            CASE_1,
            5,
            10,
            CASE_1,
            "closed forms per piece: the orbit closes",
        ),
        belt(
            "belt_2",
            "Belt, case 2, ω = 4.7: a stick in every period",
            4.7,
            0.0,
            1e4,
            (0.0, 0.0),
            5,
            13,
            (0.07065964827401156, -0.05483054717536199),
            LONG,
        ),
        belt(
            "belt_2_chaos",
            "Belt, case 2, ω = 4.6: chaos",
            4.6,
            0.0,
            1e4,
            (0.0, 0.0),
            5,
            13,
            (0.07152553665924455, -0.19231342457552494),
            LONG,
        ),
        rotating_oscillator(),
        moving_belt(),
        slip_stick(),
        impact_oscillator(),
    )
}
