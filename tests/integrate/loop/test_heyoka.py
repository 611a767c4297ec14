"""Contacts and crossings of the double scroll, against heyoka.

heyoka 7.13.2 integrates Chua's circuit by Taylor's method at a tolerance of 1e-18, of order 25 and
more, with the contacts as terminal events that set the side, and the maxima of z as non-terminal
ones: another method, another way to find an event, another compiler. Derivatives are those of its
variational equations, of first order.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf

CONTACTS = [
    0.13199451647937988,
    1.5375241226965954,
    2.437211463685276,
    3.7605738249238008,
    5.3226559170707946,
    7.010970145756122,
    7.420772559239446,
    8.956879125050877,
    10.311032583180685,
    11.681105153723712,
]
# Time, x and z.
MAXIMA = [
    (2.125784404677422, 0.43084413081797995, 0.31793138847287816),
    (4.557375499597493, -0.602940804425979, 1.0874791095569583),
    (6.367442789039002, -1.8603328907143952, 2.545327687963229),
    (8.45636000695944, -2.0294541205274634, 3.0255089130948307),
    (11.070230654563746, -1.850636851940882, 2.582365708792746),
]
# Of the first and the last maximum, by the initial state: its time, and x there.
SLOPES = {
    0: [
        [0.13619717761494268, -1.207250898916802, 0.44907062917394586],
        [-2.9515512379982405, 0.48507577167019866, -3.5491780397932087],
    ],
    4: [
        [57.74598925051906, -10.286644999423471, 69.85962070585535],
        [30.254889985070417, -4.765664675757698, 36.45317874467333],
    ],
}


class Chua(jf.System):
    """Matsumoto's numbers, α = 9, β = 100/7, m₀ = −8/7, m₁ = −5/7."""

    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        bend = 0.5 * (side[1] * (x[0] + 1) - side[0] * (x[0] - 1))
        diode = (-5 * x[0] - 3 * bend) / 7
        flow = 9 * (x[1] - x[0] - diode)
        return jnp.stack([flow, x[0] - x[1] + x[2], -100 / 7 * x[1]])

    def switching(self, t, x):
        return jnp.stack([x[0] - 1, x[0] + 1])


def run(x0):
    sol = jf.solve(
        Chua(),
        x0,
        0.0,
        12.0,
        0.01,
        max_events=16,
        compact=True,
        sections=jf.maxima(lambda t, x: x[2]),
    )
    return jnp.stack([sol.crossings.ts, sol.crossings.xs[:, 0]], axis=1), sol


@pytest.mark.release
def test_the_double_scroll_is_that_of_heyoka():
    slopes, sol = jax.jacfwd(run, has_aux=True)(jnp.array([0.7, 0.1, -0.1]))
    np.testing.assert_allclose(sol.events.ts[: len(CONTACTS)], CONTACTS, rtol=0, atol=1e-10)
    assert int(sol.num_events) == len(CONTACTS)
    found = np.stack([sol.crossings.ts, sol.crossings.xs[:, 0], sol.crossings.xs[:, 2]], axis=1)
    np.testing.assert_allclose(found[: len(MAXIMA)], MAXIMA, rtol=0, atol=1e-10)
    assert int(sol.num_crossings) == len(MAXIMA)
    for number, expected in SLOPES.items():
        np.testing.assert_allclose(slopes[number], expected, rtol=1e-10)
