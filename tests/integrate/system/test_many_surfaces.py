"""Many surfaces that have nothing to do with each other are one array in the loop.

Seven oscillators with a friction each, two of them alike, and a state that no surface is of, in one
system: each must move as it does alone, where its surface is a number.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil.integrate.surfaces.normals import project
from jaxfil.integrate.system.components import Components
from jaxfil.integrate.system.lowered import build

FRICTION = np.array([0.3, 0.3, 0.35, 0.4, 0.45, 0.5, 0.9])
START = np.stack([np.linspace(0.5, 0.1, 7), np.linspace(-0.3, 0.4, 7)])
START[:, 1] = START[:, 0]
COUNT = len(FRICTION)
# At a tie there is no derivative.
APART = np.where(np.arange(COUNT) == 1, 0.32, FRICTION)


class Oscillators(jf.System):
    """q'' = cos t − q − 0.1 v − μ side(v + q/4 − 0.1), one for each μ, and r' = cos t − r."""

    slides = True
    period = 2 * jnp.pi
    mu: jax.Array

    def vector_field(self, t, x, side):
        q, v = jnp.split(x[:-1], 2)
        return jnp.concatenate([v, jnp.cos(t) - q - 0.1 * v - self.mu * side, jnp.cos(t) - x[-1:]])

    def switching(self, t, x):
        q, v = jnp.split(x[:-1], 2)
        return v + q / 4 - 0.1


class Shared(Oscillators):
    """The same, each friction on the motion beside the last state."""

    def switching(self, t, x):
        return jnp.split(x[:-1], 2)[1] - x[-1]


def together():
    return jnp.append(START.reshape(-1), 2.0)


def alone(i, **how):
    x0 = np.append(START[:, i], 2.0)
    return jf.solve(Oscillators(jnp.array(FRICTION[i : i + 1])), x0, 0.0, 12.0, 0.05, **how)


SYSTEM = Oscillators(jnp.array(FRICTION))


def test_what_is_one_array():
    built = build(SYSTEM, together(), compact=False)
    assert built.packed and built.structure.separate
    assert built.structure.members == tuple((i, COUNT + i) for i in range(COUNT))
    # Not of few surfaces that share a number of the state, nor of one.
    few = jnp.append(START[:, :2].reshape(-1), 2.0)
    assert not build(Shared(jnp.array(FRICTION[:2])), few, compact=False).packed
    assert build(Shared(jnp.array(FRICTION)), together(), compact=False).packed
    assert not build(Oscillators(jnp.array(FRICTION[:1])), jnp.ones(3), compact=False).packed


@pytest.mark.slow
@pytest.mark.parametrize("compact", [True, False])
def test_each_moves_as_it_does_alone(compact):
    sol = jf.solve(SYSTEM, together(), 0.0, 12.0, 0.05, compact=compact, max_events=400)
    number = int(sol.num_events)
    ts, members = np.asarray(sol.events.ts[:number]), np.asarray(sol.events.members[:number])
    modes, kinds = np.asarray(sol.events.modes[:number]), np.asarray(sol.events.kinds[:number])
    slid = 0
    for i in range(COUNT):
        single = alone(i)
        count, own = int(single.num_events), members[:, i]
        assert own.sum() == count > 0
        assert_allclose(ts[own], single.events.ts[:count], rtol=1e-11)
        assert (modes[own, i] == single.events.modes[:count, 0]).all()
        if i != 1 and not (own & (members.sum(axis=1) > 1)).any():
            assert (kinds[own] == single.events.kinds[:count]).all()
        assert_allclose(sol.xs[-1, [i, COUNT + i]], single.xs[-1, :2], rtol=1e-10, atol=1e-12)
        slid += int((single.events.modes[:count] == 0).sum())
    assert slid > COUNT
    # The two that are alike are met at one time, each time, one after the other.
    assert_array_equal(ts[members[:, 0]], ts[members[:, 1]])
    faded = (np.cos(12.0) + np.sin(12.0)) / 2 + 1.5 * np.exp(-12.0)
    assert_allclose(sol.xs[-1, -1], faded, rtol=1e-11)


@pytest.mark.slow
def test_derivatives_are_those_of_each_alone():
    def end(x, mu):
        return jf.solve(Oscillators(mu), x, 0.0, 6.0, 0.05).xs[-1]

    by_x, by_mu = jax.jacfwd(end, (0, 1))(together(), jnp.array(APART))
    back = jax.jacrev(end)(together(), jnp.array(APART))
    assert_allclose(back, by_x, rtol=1e-11, atol=1e-12)
    expected, expected_mu = np.zeros(by_x.shape), np.zeros(by_mu.shape)
    expected[-1, -1] = np.exp(-6.0)
    single = jax.jit(jax.jacfwd(end, (0, 1)))
    for i in range(COUNT):
        at = [i, COUNT + i]
        one = single(jnp.append(START[:, i], 2.0), jnp.array(APART[i : i + 1]))
        expected[np.ix_(at, at)] = one[0][:2, :2]
        expected_mu[at, i] = one[1][:2, 0]
    assert_allclose(by_x, expected, rtol=1e-8, atol=1e-10)
    assert_allclose(by_mu, expected_mu, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
def test_dense_output():
    saveat = diffrax.SaveAt(dense=True)
    sol = jf.solve(SYSTEM, together(), 0.0, 6.0, 0.05, saveat=saveat)
    single, ts = alone(4, saveat=saveat), np.linspace(0.0, 6.0, 41)
    assert_allclose(
        sol.evaluate(ts)[:, [4, COUNT + 4]], single.evaluate(ts)[:, :2], rtol=0, atol=1e-10
    )


@pytest.mark.release
def test_an_orbit_has_the_multipliers_of_each():
    def orbit(i):
        x0 = jnp.append(START[:, i].reshape(-1), 2.0)
        return jf.periodic_orbit(Oscillators(jnp.array(APART[i])), x0, transient=40)

    found = orbit(np.arange(COUNT))
    own = [np.sort(abs(orbit(np.array([i])).multipliers)) for i in range(COUNT)]
    # That of r, e^(-2π), is each one's smallest but of what a slide takes away.
    each = [v[abs(v - np.exp(-2 * np.pi)) > 1e-9] for v in own]
    expected = np.sort(np.append(np.concatenate(each), np.exp(-2 * np.pi)))
    assert_allclose(np.sort(abs(found.multipliers)), expected, rtol=0, atol=1e-8)


def test_projection_on_the_surfaces():
    built, rng = build(SYSTEM, together(), compact=False), np.random.default_rng(0)
    x = Components([jnp.asarray(rng.normal(size=2 * COUNT + 1))])
    _, _, normals = built.gradients(jnp.zeros(()), x)
    rows = np.asarray(jax.jacfwd(lambda x: SYSTEM.switching(0.0, x))(x.parts[0]))
    assert_allclose((normals @ x).parts[0], rows @ x.parts[0], rtol=1e-13)
    on, h = rng.random(COUNT) < 0.6, rng.normal(size=COUNT)
    height, flags = Components([jnp.asarray(h)]), Components([jnp.asarray(on)])
    (moved,) = project(built, x, height, normals, flags).parts
    gap = np.asarray(moved - x.parts[0])
    assert_allclose(rows[on] @ gap, -h[on], rtol=1e-12)
    # At right angles to the surfaces, and of those marked alone.
    assert_allclose(gap, -np.linalg.pinv(rows[on]) @ h[on], rtol=1e-12, atol=1e-15)
