"""Periodic orbits, started on them: contacts, multipliers, highest speeds."""

import itertools

import numpy as np

import jaxfil as jf
from jaxfil import EventKind
from tests.problems import closed_forms as exact
from tests.problems.problem import Problem
from tests.problems.systems import belt, cubic_belt

CROSS, STICK, SLIP = EventKind.crossing, EventKind.stick, EventKind.slip
PER_PIECE = "closed forms per piece, 60-digit Newton"


def _period(omega):
    return 2 * np.pi / omega


def _belt_orbit(omega, x0, ts, modes, multipliers, digits, highest=None):
    """An orbit of the belt: kinds of its contacts are told by the modes between which they are."""
    pairs = itertools.pairwise(modes)
    kinds = [CROSS if a and b else SLIP if b else STICK for a, b in pairs]
    tags = "sliding" if 0 in modes else "crossing" if kinds else ""
    tags += " twice" if len(kinds) > 2 else ""
    return Problem(
        belt(omega),
        x0,
        _period(omega),
        _period(omega) / 400,
        f"forced belt {tags}",
        PER_PIECE,
        end=x0,
        ts=ts,
        kinds=kinds,
        atol=1e-10,
        multipliers=multipliers,
        digits=digits,
        highest=highest,
        orbit_modes=modes,
    )


def _pair(real, imaginary):
    return [real - 1j * imaginary, real + 1j * imaginary]


_AMPLITUDE, _DEN_HARTOG_MULTIPLIERS = exact.den_hartog()
_DEN_HARTOG_T, _DEN_HARTOG_X = exact.den_hartog_start(1.5)

ORBITS = {
    "belt 1.3": _belt_orbit(
        1.3,
        (1.562680507274925516, 1),
        (0.02537543579827, 3.38825895300931),
        [0, -1, 0],
        [0, -0.199459730884038],
        1e-11,
        1,
    ),
    "belt 2.44": _belt_orbit(
        2.44,
        (0.893154126723387260, 3.181072481841881173),
        (0.24043386276687, 1.73126530991045),
        [1, -1, 1],
        _pair(0.0025495, 0.0145254),
        1e-7,
        3.781163696487915,
    ),
    "belt 9.1": _belt_orbit(
        9.1,
        (0.431566227111474261, 0.285460370360303195),
        (0.06500878225883, 0.17328503134631),
        [-1, 0, -1],
        [0, -0.161706955546901],
        1e-11,
        1,
    ),
    "belt 17": _belt_orbit(
        17.0,
        (0.601839693239804056, 0.018194523762144070),
        (),
        [-1],
        _pair(0.360329, 0.839260),
        1e-6,
        0.609047044980828,
    ),
    # Two slips in a period, of which one is shorter than a step.
    "belt 1.4": _belt_orbit(
        1.4,
        (1.5670473725058692029, 1),
        (0.021115703825789773, 2.61911511215335305, 2.74881294392022106, 2.9398327291587959),
        [0, -1, 0, -1, 0],
        None,
        None,
    ),
    "belt 1.54892": _belt_orbit(
        1.54892,
        (0.62813535977215724309, 1),
        (0.581512870137695392, 2.26965284989511371, 3.5971186797855341, 3.61587613681139833),
        [0, -1, 0, 1, 0],
        None,
        None,
    ),
    "cubic belt 4.56": Problem(
        cubic_belt(4.56),
        (0.1483395597000811859, 0.3581899498626866293),
        _period(4.56),
        _period(4.56) / 400,
        "forced cubic",
        "Taylor series in mpmath",
        end=(0.1483395597000811859, 0.3581899498626866293),
        ts=(),
        kinds=[],
        atol=1e-10,
        multipliers=_pair(-0.31062397377592, 0.64205422198867),
        digits=1e-10,
        highest=0.91797746369765,
    ),
    # x(t + T/2) = -x(t).
    "symmetric sd": Problem(
        jf.systems.SDOscillator(omega=0.7),
        (2.972909733962379342, 0.618617859127108525),
        _period(0.7),
        _period(0.7) / 400,
        "forced crossing sd",
        PER_PIECE,
        end=(2.972909733962379342, 0.618617859127108525),
        kinds=[CROSS] * 2,
        atol=1e-10,
        multipliers=_pair(0.35398, 0.80689),
        digits=5e-6,
    ),
    # Started half-way down, so that no contact is at the start. Two periods.
    "den hartog": Problem(
        jf.systems.DenHartog(friction=0.3, omega=0.8),
        tuple(_DEN_HARTOG_X),
        _DEN_HARTOG_T + 2 * _period(0.8),
        0.05,
        "forced crossing",
        "Den Hartog (1931), in closed form",
        t0=_DEN_HARTOG_T,
        end=tuple(_DEN_HARTOG_X),
        ts=_DEN_HARTOG_T - 1.5 + np.pi / 0.8 * np.arange(1, 5),
        kinds=[CROSS] * 4,
        before=[(_AMPLITUDE * sign, 0) for sign in (-1, 1, -1, 1)],
        multipliers=sorted(_DEN_HARTOG_MULTIPLIERS, key=np.imag),
        digits=1e-12,
    ),
}
