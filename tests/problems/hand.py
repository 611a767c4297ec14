"""Motions in fractions: constant and affine fields, worked out by hand."""

import numpy as np

from jaxfil import EventKind
from tests.problems.problem import Problem
from tests.problems.systems import LEVELS, NeverSliding, affine, corner, roots

CROSS, STICK, GRAZE = EventKind.crossing, EventKind.stick, EventKind.graze

HAND = {
    "starts on the surface": Problem(
        affine((1, 1), (-1, 2)), (0, 0), 1, 0.3, "crossing float32", end=(1, 1), ts=(), kinds=[]
    ),
    "starts sliding": Problem(
        affine((3, -1), (1, 3)), (0, 0), 1, 0.3, "sliding float32", end=(2.5, 0), mode=(0,)
    ),
    "contact on a grid point": Problem(
        affine((1, -1), (-1, -3)),
        (0, 1),
        1.5,
        0.25,
        "crossing float32",
        end=(0.5, -1.5),
        mode=(-1,),
        ts=(1,),
        kinds=[CROSS],
    ),
    "crosses as declared": Problem(
        affine((1, -1), (-1, -2), kind=NeverSliding), (0, 1), 2, 0.3, "declared", end=(0, -2)
    ),
    "two roots in a step": Problem(
        roots((0.3, 0.6)),
        (0, 0),
        1,
        1.0,
        "crossing float32",
        end=(1, 0.4),
        ts=(0.3, 0.6),
        kinds=[CROSS] * 2,
        atol=1e-11,
    ),
    "three roots in a step": Problem(
        roots((0.1, 0.4, 0.8)),
        (0, 0),
        1,
        1.0,
        "crossing float32",
        end=(1, 0),
        ts=(0.1, 0.4, 0.8),
        kinds=[CROSS] * 3,
        atol=1e-11,
    ),
    # x' = side_1 + 10 side_2: the order of the contacts is in x(1).
    "two surfaces in one step": Problem(
        corner(lambda s1, s2: (s1 + 10 * s2, 1), LEVELS, (0.9, 0.4)),
        (0, 0),
        1,
        1.0,
        "crossing float32",
        end=(1.2, 1),
        ts=(0.4, 0.9),
        kinds=[CROSS] * 2,
    ),
    "both surfaces at once": Problem(
        corner(lambda s1, s2: (1.5 + s1 / 2, 2 + s2)),
        (-1, -1),
        2,
        0.3,
        "crossing corner float32",
        end=(2, 3),
        mode=(1, 1),
        ts=(1, 1),
        kinds=[CROSS, CROSS],
    ),
    # Through y = 1/2 without a change of speed, then held at y = 1 for ever.
    "held surface": Problem(
        corner(lambda s1, s2: (s1, -s2), LEVELS, (0.5, 1)),
        (0, 0),
        10,
        0.3,
        "crossing sliding float32",
        end=(9, 1),
        ts=(0.5, 1),
        kinds=[CROSS, STICK],
    ),
    # y1' = -s1, y2' = -s2 + 1.5 + s1: when y1 sticks (s1 = 0), y2 can no longer be held.
    "one stick releases another": Problem(
        corner(lambda s1, s2: (-s1, -s2 + 1.5 + s1)),
        (-1, 0),
        2,
        0.3,
        "sliding intersection",
        end=(0, 0.5),
        mode=(0, 1),
    ),
    # x = t - 1, y = x² until the surface is crossed, which never happens.
    "grazing touch": Problem(
        affine((1, 0), (1, -5), b_plus=((0, 0), (2, 0))),
        (-1, 1),
        2,
        0.3,
        "graze",
        end=(1, 1),
        mode=(1,),
        ts=(1,),
        kinds=[GRAZE],
        atol=1e-6,
    ),
    "grazing touch of one field": Problem(
        affine((1, 0), (1, 0), ((0, 0), (2, 0)), ((0, 0), (2, 0))),
        (-1, 1),
        2,
        0.3,
        "graze float32",
        end=(1, 1),
    ),
    "chattering": Problem(
        affine((1, -1), (1, 1)),
        (0, 1),
        5,
        0.3,
        "sliding float32",
        end=(5, 0),
        mode=(0,),
        ts=(1,),
        kinds=[STICK],
    ),
    "repelling slide": Problem(
        affine((1, 1), (1, -1)),
        (2, 0),
        1,
        0.1,
        "sliding float32",
        end=(2, 0),
        outcome="nonunique",
        ends_at=0,
    ),
    # y' = x above and -x below: slides for x < 0, and at x = 0 both fields touch and part.
    "two-fold": Problem(
        affine((1, 0), (1, 0), ((0, 0), (1, 0)), ((0, 0), (-1, 0))),
        (-1, 0),
        2,
        0.3,
        "sliding",
        end=(0, 0),
        outcome="nonunique",
        ends_at=1,
        atol=1e-9,
    ),
    # The corner is reached at t = 1; the other three quadrants all lead away from it.
    "corner exit": Problem(
        corner(lambda s1, s2: (1, s2) if s1 > 0 else (-s2, 1)),
        (-1, -1),
        2,
        0.3,
        "corner float32",
        end=(0, 0),
        outcome="nonunique",
        ends_at=1,
    ),
    "undeclared slide": Problem(
        affine((1, -1), (1, 1), kind=NeverSliding),
        (0, 1),
        2,
        0.3,
        "undeclared",
        end=(1, 0),
        outcome="undeclared_sliding",
        ends_at=1,
    ),
    # Told within a step of where the field is no number.
    "nan field": Problem(
        affine((1, np.nan), (1, 1)),
        (0, -1),
        2,
        0.3,
        "float32",
        outcome="nonfinite",
        ends_at=1,
        atol=0.3,
    ),
}
