"""Averages of lanes that are sampled at a section, and of those whose events are counted."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from tests.problems.systems import Turn


@pytest.mark.release
def test_at_a_section_it_is_from_the_first_sample_to_the_last(tmp_path):
    """Of a half turn of time π and one of π/r: whole turns, from one maximum of x + y to another,
    with two contacts in each."""
    rate = np.array([0.5, 0.8])
    d = jf.bifurcation_diagram(
        Turn(jnp.array(1.0)),
        "rate",
        rate,
        jnp.array([1.0, -0.1]) / np.sqrt(1.01),
        transient=2,
        samples=4,
        steps=20,
        section=jf.maxima(lambda t, x: jnp.sum(x)),
        max_return=14.0,
        compact=True,
        progress=False,
        average={
            "above": lambda t, x, side: 0.5 * (1 + side),
            "y": lambda t, x, side: x[1],
            "sum": jf.Maximum(lambda t, x, side: jnp.sum(x)),
            "left": jf.Minimum(lambda t, x, side: x[0]),
            "contacts": jf.EventSum(lambda t, before, after, surfaces: surfaces),
        },
    )
    turn = np.pi + np.pi / rate
    np.testing.assert_allclose(d.averages["above"], np.pi / turn, rtol=1e-10)
    np.testing.assert_allclose(d.averages["y"], (2 - 2 / rate) / turn, rtol=1e-9)
    np.testing.assert_allclose(d.averages["sum"], np.sqrt(2), rtol=1e-10)
    np.testing.assert_allclose(d.averages["left"], -1, rtol=1e-10)
    np.testing.assert_array_equal(d.averages["contacts"], 6)
    for name in ("d.nc", "d.npz"):
        d.save(tmp_path / name)
        back = jf.load(tmp_path / name)
        assert back.averages.keys() == d.averages.keys() and back.conditions == d.conditions
        for key, own in d.averages.items():
            np.testing.assert_array_equal(back.averages[key], own)


class Kicked(jf.System):
    """Between two walls a time of 1/v apart, and on a line a decay that is kicked once a period."""

    speed: jax.Array
    slides: ClassVar[bool] = False
    period = 1.0

    @property
    def clocks(self):
        return (jf.Clock(1.0, 0.5),)

    def vector_field(self, t, x, side):
        return jnp.stack([x[1] * self.speed, jnp.zeros(()), -x[2]])

    def switching(self, t, x):
        return jnp.stack([x[0], 1 - x[0]])

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -x[1], x[2]])

    def tick(self, t, x, clock):
        return x.at[2].add(1.0)


class Decay(jf.System):
    """The decay alone, without surfaces."""

    kick: jax.Array
    period = 1.0

    @property
    def clocks(self):
        return (jf.Clock(1.0, 0.5),)

    def vector_field(self, t, x, side):
        return -x

    def tick(self, t, x, clock):
        return x + self.kick


def gain(t, before, after, surfaces):
    return after[-1] - before[-1]


@pytest.mark.release
def test_events_are_counted_by_surface_and_ticks_are_events():
    """At v = 2 each wall is met once a period, at v = 4 twice; what decays by e⁻¹ in a period is
    kicked up to 1/(1 − e⁻¹) each time."""
    run = dict(transient=40, samples=3, steps=8, compact=True, progress=False)
    average = {
        "walls": jf.EventSum(lambda t, before, after, surfaces: surfaces),
        "gain": jf.EventSum(gain),
        "top": jf.Maximum(lambda t, x, side: x[-1]),
        "low": jf.Minimum(lambda t, x, side: x[-1]),
    }
    top = 1 / (1 - np.exp(-1))
    start = jnp.array([0.3, 1.0, 1.0])
    speeds = np.array([2.0, 4.0])
    found = jf.bifurcation_diagram(
        Kicked(jnp.array(2.0)), "speed", speeds, start, average=average, **run
    ).averages
    np.testing.assert_array_equal(found["walls"], [[3, 3], [6, 6]])
    kicks = np.array([1.0, 2.0])
    del average["walls"]
    alone = jf.bifurcation_diagram(
        Decay(jnp.array(1.0)), "kick", kicks, jnp.ones(1), average=average, **run
    ).averages
    for own, size in ((found, np.ones(2)), (alone, kicks)):
        np.testing.assert_allclose(own["gain"], 3 * size, rtol=1e-12)
        np.testing.assert_allclose(own["top"], size * top, rtol=1e-12)
        np.testing.assert_allclose(own["low"], size * (top - 1), rtol=1e-12)


class Latched(Decay):
    """The decay beside a distant surface, with a kick by one clock and an idle tick of another."""

    slides: ClassVar[bool] = False

    @property
    def clocks(self):
        return jf.Clock(1.0, 0.5), jf.Clock(0.5, 0.2)

    def switching(self, t, x):
        return x[0] + 50.0

    def tick(self, t, x, clock):
        return x + jnp.where(clock == 0, self.kick, 0.0)


@pytest.mark.parametrize("kind", [Decay, pytest.param(Latched, marks=pytest.mark.slow)])
def test_a_kick_of_zero_is_no_event_and_its_sum_has_the_derivatives_of_the_map(kind):
    """From x = 1 the kicks at 1/2, 3/2 and 5/2 meet b, of which the last two are summed. A distance
    has no derivative where it is zero."""
    average = {
        "gain": jf.EventSum(gain),
        "energy": jf.EventSum(lambda t, before, after, surfaces: after[-1] ** 2 - before[-1] ** 2),
        "count": jf.EventSum(lambda t, before, after, surfaces: t / t),
        "far": jf.EventSum(lambda t, before, after, surfaces: jnp.linalg.norm(after - before)),
        "pole": jf.EventSum(lambda t, before, after, surfaces: 1 / (after - before)[0]),
    }

    def sums(kick):
        run = dict(transient=1, samples=2, steps=8, compact=True)
        return jf.settled_average(kind(kick), average, jnp.ones(1), **run).averages

    def exact(kick):
        first = (np.exp(-0.5) + kick) * np.exp(-1)
        second = (first + kick) * np.exp(-1)
        energy = 2 * (first + second) * kick + 2 * kick**2
        return {"gain": 2 * kick, "energy": energy}

    def with_slopes(f):
        return lambda kick: (f(kick), jax.jacfwd(f)(kick), jax.jacfwd(jax.jacfwd(f))(kick))

    kicks = jnp.array([0.0, 0.3])
    found, wanted = (jax.jit(jax.vmap(with_slopes(f)))(kicks) for f in (sums, exact))
    for own, right in zip(found, wanted, strict=True):
        for name in right:
            np.testing.assert_allclose(own[name], right[name], rtol=1e-9, atol=1e-12, err_msg=name)
    values, slopes, _ = found
    np.testing.assert_array_equal(values["count"], [0, 2])
    np.testing.assert_allclose(values["far"], [0, 0.6], rtol=1e-12)
    np.testing.assert_allclose(values["pole"], [0, 2 / 0.3], rtol=1e-12)
    for name, right in {"count": [0, 0], "far": [0, 2], "pole": [0, -2 / 0.09]}.items():
        np.testing.assert_allclose(slopes[name], right, rtol=1e-9, atol=1e-12, err_msg=name)


def test_one_sample_at_a_section_is_no_span_of_time():
    with pytest.raises(ValueError, match="`samples` must be 2 or more with `average`"):
        jf.settled_average(
            Turn(jnp.array(1.0)),
            lambda t, x, side: x,
            jnp.ones(2),
            samples=1,
            section=jf.Section(lambda t, x: x[0]),
            max_return=9.0,
        )
