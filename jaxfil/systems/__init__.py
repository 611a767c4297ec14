"""Textbook systems with known answers.

Parameters are float leaves with defaults. `TEXTBOOK` lists the systems for the command line, each
with an initial state that shows its typical motion.

Terms of this room:

- forced: with a field or a surface that depends on time. All forced systems but `MovingBelt`, whose
  two frequencies have only a long common period, have a `period` and can be sampled once per
  period.
- autonomous: without such a field or surface.
- dimensionless: in units in which unnamed constants, a mass or a stiffness, are one.
"""

from jaxfil.model.system import System
from jaxfil.systems.autonomous import (
    BouncingBall as BouncingBall,
    CoulombOscillator as CoulombOscillator,
    FilippovSpiral as FilippovSpiral,
    RotatingOscillator as RotatingOscillator,
    SlipStick as SlipStick,
    TwoRelays as TwoRelays,
    VisibleFold as VisibleFold,
)
from jaxfil.systems.forced import (
    BeltFriction as BeltFriction,
    DenHartog as DenHartog,
    ImpactOscillator as ImpactOscillator,
    MovingBelt as MovingBelt,
    SDOscillator as SDOscillator,
)

TEXTBOOK: dict[str, tuple[type[System], tuple[float, ...]]] = {
    "sd-oscillator": (SDOscillator, (1.995, 0.085)),
    "belt-friction": (BeltFriction, (0.0, 0.0)),
    "coulomb-oscillator": (CoulombOscillator, (3.0, 0.0)),
    "moving-belt": (MovingBelt, (3.0, 0.0)),
    "rotating-oscillator": (RotatingOscillator, (0.36787944117144233, 0.0)),
    "slip-stick": (SlipStick, (1.0, 0.2)),
    "den-hartog": (DenHartog, (0.0, 0.0)),
    "impact-oscillator": (ImpactOscillator, (0.0, 0.0)),
    "bouncing-ball": (BouncingBall, (10.0, 0.0)),
    "filippov-spiral": (FilippovSpiral, (0.0, 1.0)),
    "visible-fold": (VisibleFold, (-1.0, 0.1)),
    "two-relays": (TwoRelays, (1.5, 1.0)),
}
"""Each system and its initial state, by its name on the command line."""
