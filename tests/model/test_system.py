"""What a system says of itself, and how one that wraps another says the same."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.integrate.run.observed import checked_observable, with_rate
from jaxfil.integrate.system.lowered import build
from jaxfil.model import check

BALL = jf.systems.BouncingBall(g=1.0, restitution=0.5)
COULOMB = jf.systems.CoulombOscillator()
X = jnp.array([3.0, 0.0])


class Scaled(jf.System):
    """Any system with its time run `rate` times as fast."""

    of: jf.System
    rate: jax.Array

    def vector_field(self, t, x, side):
        return self.rate * self.of.vector_field(self.rate * t, x, side)

    def switching(self, t, x):
        return self.of.switching(self.rate * t, x)

    def reset(self, t, x, surface):
        return self.of.reset(self.rate * t, x, surface)

    @property
    def slides(self):
        return self.of.slides

    @property
    def resets(self):
        return self.of.resets


class Floor(jf.System):
    """What a system with a floor, whichever it is, does there."""

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -x[1]])


class Falling(jf.System):
    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones(())])

    def switching(self, t, x):
        return x[0]


class Thrown(Floor, Falling):
    pass


class Again(Thrown):
    pass


def observed(system):
    return with_rate(system, checked_observable("observe", lambda t, x, side: x[0], system, X), X)


WRAPPERS = {
    "a user's": lambda system: Scaled(system, jnp.array(2.0)),
    "a pair": lambda system: jf.drive_response(system, 0.3),
    "observed": lambda system: observed(system)[0],
}


def test_a_class_has_resets_if_it_or_one_above_it_defines_them():
    systems = Falling(), Thrown(), Again(), BALL, COULOMB, jf.smoothed(COULOMB, 1e-2)
    assert [s.resets for s in systems] == [False, True, True, True, False, False]


@pytest.mark.parametrize("name", WRAPPERS)
def test_a_wrapper_has_the_resets_of_what_it_wraps(name):
    for system in (BALL, COULOMB):
        wrapper = WRAPPERS[name](system)
        x = jnp.zeros(len(X) * (1 + (name == "a pair")) + (name == "observed"))
        assert check.shapes(wrapper, x) == (() if name != "a pair" else (2,))
        built = build(wrapper, x, compact=True)
        assert wrapper.resets == built.resets == system.resets
        assert wrapper.slides == built.slides == system.slides


@pytest.mark.parametrize(
    "system", [pytest.param(BALL, marks=pytest.mark.release), COULOMB], ids=["impacts", "friction"]
)
def test_a_wrapped_system_moves_as_it_does_by_itself(system):
    """To the same states, at half the times."""
    options = dict(stepper=jf.RK4(), max_events=8)
    alone = jf.solve(system, X, 0.0, 4.0, 1 / 16, **options)
    twice = jf.solve(Scaled(system, jnp.array(2.0)), X, 0.0, 2.0, 1 / 32, **options)
    count = int(alone.num_events)
    assert count == twice.num_events > 0
    assert alone.events.kinds[:count].tolist() == twice.events.kinds[:count].tolist()
    eps = np.finfo(float).eps
    np.testing.assert_allclose(2 * twice.events.ts[:count], alone.events.ts[:count], rtol=64 * eps)
    np.testing.assert_allclose(twice.x_final, alone.x_final, rtol=0, atol=64 * eps)


def test_without_impacts_the_reset_of_a_wrapper_is_not_asked():
    """Its own is that of `System`, which moves nothing: each contact would be undecided."""
    wrapper = Scaled(COULOMB, jnp.array(2.0))
    assert type(wrapper).reset is not jf.System.reset
    assert not jf.smoothed(wrapper, 1e-2).resets
    with pytest.raises(ValueError, match="must have no `reset`"):
        jf.smoothed(Scaled(BALL, jnp.array(2.0)), 1e-2)


class Pulsed(jf.System):
    """x' = -r x + cos(2 pi t/T), with the period as a field before another one."""

    period: jax.Array
    rate: jax.Array = eqx.field(converter=jnp.asarray)
    slides: bool = False

    def vector_field(self, t, x, side):
        return -self.rate * x + jnp.cos(2 * jnp.pi * t / self.period)


class Ticked(Pulsed):
    """The same with a dose of 1 at the ticks of a clock that is a field too."""

    clocks: tuple = ()

    def tick(self, t, x, clock):
        return x + 1


def test_a_field_may_have_the_name_of_a_property():
    """With w = 2 pi/T the orbit begins at r/(r² + w²), and its derivatives are those of that."""

    def start(period, rate):
        return jf.periodic_orbit(Pulsed(period, rate), jnp.array([0.1])).x0[0]

    exact = lambda period, rate: rate / (rate**2 + (2 * jnp.pi / period) ** 2)  # noqa: E731
    found, wanted = (jax.value_and_grad(f, (0, 1))(2.0, 1.0) for f in (start, exact))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)
    once = Ticked(2.0, jnp.array(0.0), clocks=(jf.Clock(10.0, 0.25),))
    end = jf.solve(once, jnp.zeros(1), 0.0, 0.5, 0.125, stepper=jf.RK4()).x_final[0]
    np.testing.assert_allclose(end, 1 + np.sin(np.pi / 2) / np.pi, rtol=1e-4)
    assert Pulsed(2.0, 1.0).clocks == () and not Pulsed(2.0, 1.0).slides
    with pytest.raises(TypeError, match=r"missing .* 'rate'"):
        Pulsed(2.0)


@dataclasses.dataclass
class Plain:
    rate: float


def test_a_field_by_which_programs_cannot_be_told_apart_is_refused_by_name():
    class Decay(jf.System):
        given: object
        law: object = eqx.field(static=True, default=None)

        def vector_field(self, t, x, side):
            return -self.given.rate * x

    for name, made in (("given", lambda: Decay(Plain(2.0))), ("law", lambda: Decay(1.0, ["soft"]))):
        with pytest.raises(ValueError, match=f"`{name}` of Decay must hold .*hashed"):
            made()
    frozen = dataclasses.make_dataclass("Frozen", [("rate", float)], frozen=True)
    end = jf.solve(Decay(frozen(2.0)), jnp.ones(1), 0.0, 1.0, 0.05).x_final[0]
    np.testing.assert_allclose(end, np.exp(-2), rtol=1e-10)


def test_a_whole_number_is_a_parameter_of_a_system_of_the_library():
    """Of its textbook systems, of a drive and its response, and of a smoothed one."""
    coulomb = jf.systems.CoulombOscillator(friction=1)
    many = jf.systems.CoulombOscillator(friction=np.array([1, 2]))
    pair, smooth = jf.drive_response(coulomb, 1), jf.smoothed(coulomb, 2)
    for number in (coulomb.friction, many.friction, pair.coupling, smooth.width):
        assert jnp.issubdtype(number.dtype, jnp.floating)
    slope = jax.grad(lambda pair: pair.coupling * pair.system.friction)(pair)
    assert (slope.coupling, slope.system.friction) == (1.0, 1.0)
