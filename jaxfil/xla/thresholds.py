"""Thresholds of rounding, in eps of the numbers that a value is made of.

What is below one of them is zero, equal or singular to rounding.
"""

# Compared with numbers of order one, after division by the size of a row, column or diagonal.
PIVOT = 64
"""A pivot of a matrix with rows of order one, and an eigenvalue of one."""

COMPLEMENTARITY = 4096
"""The residual of a complementarity problem, after some tens of pivots."""

EQUATIONS = 64
"""H, and the margin of an equilibrium."""

RESIDUAL = 4
"""A residual of Newton's method that does not decrease further."""

CONVERGED = 256
"""A full step of Newton's method, whose error is the square of that."""

SAME_STATE = 1024
"""The distance of equal states of a motion, of the largest component."""

SEPARATION = 64
"""The distance of drive and response that has few correct bits."""

LOST_DIRECTION = 1e4
"""The part of a tangent vector outside of the others."""

SAME_END = 1e4
"""The change of the end of a run at twice as many steps."""
