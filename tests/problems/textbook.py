"""Problems of the event-driven and Filippov literature, and the SD oscillator from two states.

"By hand" is exact; the other numbers are right to the digits given.
"""

import numpy as np

import jaxfil as jf
from jaxfil import EventKind
from tests.problems import closed_forms as exact
from tests.problems.problem import Problem
from tests.problems.values import SLIP_STICK_PERIOD

CROSS, STICK, SLIP = EventKind.crossing, EventKind.stick, EventKind.slip
IMPACT = EventKind.impact
S = jf.systems

TEXTBOOK = {
    # Turns at π, 2π, 3π, sticks at 4π with x = 3 - 8 F.
    "coulomb": Problem(
        S.CoulombOscillator(friction=0.4),
        (3, 0),
        20.0,
        0.1,
        "autonomous crossing sliding float32",
        end=(-0.2, 0),
        mode=(0,),
        ts=np.pi * np.arange(1, 5),
        kinds=[CROSS] * 3 + [STICK],
        before=[(-2.2, 0), (1.4, 0), (-0.6, 0), (-0.2, 0)],
    ),
    # A surface that depends on time.
    "moving belt": Problem(
        S.MovingBelt(friction=0.4),
        (3, 0),
        28.0,
        0.05,
        "forced crossing sliding",
        "event-driven DOP853 at 1e-13; DISODE45 (Calvo, Montijano, Rández 2016)",
        ts=(
            7.60556996475,
            9.48337857886,
            9.76525875446,
            14.80510568909,
            17.45893964391,
            26.13168182465,
            27.29115689348,
        ),
        kinds=[CROSS, STICK, SLIP, CROSS, CROSS, STICK, SLIP],
        atol=1e-11,
    ),
    "rotating": Problem(
        S.RotatingOscillator(),
        (np.exp(-1), 0),
        2.0,
        0.02,
        "autonomous crossing",
        "nosnoc (Nurkanović et al. 2022)",
        end=(np.exp(1), 0),
        ts=(1,),
        kinds=[CROSS],
        t_atol=1e-12,
        atol=1e-11,
    ),
    # From the exit of the stick, exactly at (1, 0.2), once round and on to 1 later.
    "slip-stick": Problem(
        S.SlipStick(),
        (1, 0.2),
        SLIP_STICK_PERIOD + 1,
        0.02,
        "autonomous sliding",
        "event-driven DOP853 at 1e-13",
        ts=(SLIP_STICK_PERIOD - (1 - 0.094518907972) / 0.2, SLIP_STICK_PERIOD),
        kinds=[STICK, SLIP],
        before=[(0.094518907972, 0.2), (1, 0.2)],
        t_atol=(5e-11, 1e-12),
        atol=(1e-12, 2e-14),
    ),
    # Slides on the circle |x|² = 2 and leaves it at the fold (-1, -1).
    "visible fold": Problem(
        S.VisibleFold(),
        (-1, 0.1),
        3.0,
        0.02,
        "autonomous sliding float32",
        end=(-1 + 3 - 1.82862978083, -1 - 3 + 1.82862978083),
        ts=(0.34159842485, 1.82862978083),
        kinds=[STICK, SLIP],
        before=[np.sqrt(2 / 1.01) * np.asarray([-1, 0.1]), (-1, -1)],
        atol=1e-11,
    ),
    "two relays": Problem(
        S.TwoRelays(),
        (1.5, 1),
        1.0,
        0.1,
        "autonomous sliding",
        end=(15.5 / 17, 15.5 / 17),
        mode=(0,),
        ts=(1 / 7,),
        kinds=[STICK],
        t_atol=1e-14,
        atol=9e-14,
    ),
    # At the origin at t = 1/2 after infinitely many crossings, each leg a third of the last.
    "filippov spiral": Problem(
        S.FilippovSpiral(),
        (0, 1),
        2.0,
        0.1,
        "autonomous crossing intersection zeno float32",
        end=(0, 0),
        mode=(0, 0),
        ts=0.5 - 0.5 * 3.0 ** -np.arange(1, 9),
        kinds=[CROSS] * 8,
        atol=1e-13,
    ),
    "bouncing ball": Problem(
        S.BouncingBall(g=9.8, restitution=0.9),
        (10, 0),
        12.5,
        0.2,
        "autonomous impact float32",
        ts=exact.bounces(0.9, 6),
        kinds=[IMPACT] * 6,
        atol=1e-11,
    ),
    "ball that comes to rest": Problem(
        S.BouncingBall(g=9.8, restitution=0.5),
        (10, 0),
        20.0,
        0.3,
        "autonomous impact zeno float32",
        end=(0, 0),
        ts=exact.bounces(0.5, 5),
        kinds=[IMPACT] * 5,
        mode=(2,),
        atol=1e-13,
    ),
    # Not unique where it starts.
    "sd from the origin": Problem(
        S.SDOscillator(omega=0.7),
        (0, 0),
        1.0,
        0.1,
        "forced sd",
        end=(0, 0),
        outcome="nonunique",
        ends_at=0,
    ),
    "sd": Problem(
        S.SDOscillator(omega=0.7),
        (0.3, 0.1),
        40.0,
        0.025,
        "forced crossing sd",
        "closed forms per piece, 60-digit Newton",
        end=(-3.61547391145097192825, 0.61719527603447126335),
        ts=(5.18257758628244488158,),
        kinds=[CROSS] * 9,
        atol=1e-11,
    ),
}
