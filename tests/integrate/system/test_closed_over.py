"""Traced numbers that the functions of a system close over are leaves of an opened one."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from jaxfil.integrate.system.closed_over import with_closed_numbers
from jaxfil.xla.known import is_known

X = jnp.array([0.3, 0.7])


def closing(k):
    class Closing(jf.System):
        own: jax.Array
        state_names = "x", "x'"

        def vector_field(self, t, x, side, reaction):
            return jnp.stack([x[1] + t, k * reaction - self.own * side])

        def switching(self, t, x):
            return x[0] - k

        def reset(self, t, x, surface):
            return jnp.stack([x[0], -k * x[1]])

        def tick(self, t, x, clock):
            return x + k

        @property
        def clocks(self):
            return (jf.Clock(k, 0.1),)

        @property
        def period(self):
            return 2 * k

    return Closing(jnp.array(5.0))


def everything(system):
    t, one, (clock,) = jnp.array(2.0), jnp.int32(0), system.clocks
    field = system.vector_field(t, X, jnp.array(-1.0), jnp.array(3.0))
    maps = system.reset(t, X, one), system.tick(t, X, one)
    rest = system.switching(t, X), clock.period, clock.phase, system.period, system.own
    return jnp.concatenate([field, *maps, jnp.stack([jnp.asarray(v) for v in rest])])


def test_an_opened_system_is_the_same_by_its_leaves_alone():
    seen = []

    def opened(k):
        system = with_closed_numbers(closing(k), X)
        program = jax.make_jaxpr(everything)(system)
        seen.append((is_known(system), is_known(program.consts), system.resets, system.ticks))
        assert (system.feels_reactions, system.slides) == (True, True)
        assert system.state_names == ("x", "x'")
        return everything(system)

    k = jnp.array(0.4)
    by_hand = lambda k: jnp.stack(  # noqa: E731
        [2.7, 3 * k + 5, 0.3, -0.7 * k, 0.3 + k, 0.7 + k, 0.3 - k, k, 0.1, 2 * k, 5.0]
    )
    for transformed in (jax.jacfwd, jax.jacrev, lambda f: lambda k: jax.vmap(f)(jnp.stack([k]))):
        np.testing.assert_allclose(transformed(opened)(k), transformed(by_hand)(k), rtol=1e-12)
    assert set(seen) == {(False, True, True, True)}
    system = closing(0.4)
    assert with_closed_numbers(system, X) is system
    jax.grad(lambda k: seen.append(with_closed_numbers(system, X)) or k)(1.0)
    assert seen[-1] is system, "its numbers are known"
