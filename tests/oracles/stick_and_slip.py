"""The belt with a linear spring, exact: it sticks with the belt and slips once a period.

x'' + c x' + k x = f0 cos ωt + c + μ g in a slip to below the belt's speed of 1.
"""

import numpy as np

from tests.oracles.linear_flow import Flow

FRICTION, DAMPING, STIFFNESS, FORCE = 0.6 * 9.81, 0.05 * 9.81, 10.0, 10.0


def least_gap(omega, periods=30):
    """What the belt is faster by on the periodic motion where the mass, in its slip, is fastest."""
    # The state is (x, x', 1, cos ωt, sin ωt).
    turning = [0, 0, 0, 0, -omega], [0, 0, 0, omega, 0]
    push = np.array([-STIFFNESS, -DAMPING, DAMPING + FRICTION, FORCE, 0])
    slip = np.array([[0, 1, 0, 0, 0], push, np.zeros(5), *turning])
    stick = np.array([[0, 1, 0, 0, 0], np.zeros(5), np.zeros(5), *turning])

    def end(matrix, guard, z, order=0):
        return Flow(matrix, np.array([guard], float)).fly(z, 0.0, 10.0, [order]).z

    arrived = np.array([1.5, 1.0, 1.0, 1.0, 0.0])
    for _ in range(periods):
        let_go = end(stick, [-STIFFNESS, 0, FRICTION, FORCE, 0], arrived)
        arrived = end(slip, [0, -1, 1, 0, 0], let_go, 2)
    # The velocity falls, and rises to its largest value below that of the belt.
    lowest = end(slip, -push, let_go, 1)
    return 1 - end(slip, push, lowest, 1)[1]
