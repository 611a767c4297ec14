"""Diagrams of what is observed, against closed forms."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from tests.problems.systems import Turn

EPS = np.finfo(float).eps


class Dragged(jf.System):
    """A mass on a belt of speed 1, pushed by cos(t + φ) with a phase φ that stays: where friction
    is stronger it sticks."""

    force: jax.Array

    state_names: ClassVar = ("phase", "v")
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.zeros(()), jnp.cos(t + x[0]) - self.force * side - x[1] + 1])

    def switching(self, t, x):
        return x[1] - 1


class Friction(eqx.Module):
    """The force of friction, and the time in periods."""

    force: jax.Array

    def __call__(self, t, x, side):
        return jnp.stack([-self.force * side, t / (2 * jnp.pi)])


def sweep(observe=None, forces=(1.25, 2.0), **options):
    given = dict(transient=2, samples=3, steps=8, stepper=jf.RK4(), compact=True, progress=False)
    return jf.bifurcation_diagram(
        Dragged(jnp.array(1.0)),
        "force",
        jnp.array(forces),
        jnp.array([0.3, 1.0]),
        observe=observe or Friction(jnp.array(2.0)),
        **given | options,
    )


@pytest.fixture(scope="module")
def found():
    return sweep()


def test_the_friction_of_a_stick_is_the_force_that_it_holds_against(found):
    """At each end of a period: -cos 0.3, as a part of the friction there is."""
    assert found.successful.all() and found.xs.shape == (2, 3, 2)
    exact = np.cos(0.3) * 2 / np.array([[1.25], [2.0]])
    np.testing.assert_allclose(found.xs[..., 0], -np.broadcast_to(exact, (2, 3)), rtol=64 * EPS)
    np.testing.assert_allclose(found.xs[..., 1], np.tile([3.0, 4.0, 5.0], (2, 1)), rtol=4 * EPS)
    assert found.labels.state == ("Friction[0]", "Friction[1]")
    assert found.plot().get_ylabel() == "Friction[0] once a period"


def test_a_diagram_of_what_is_observed_is_kept_as_any_other(found, tmp_path):
    kept = sweep(checkpoint=tmp_path / "kept")
    again = sweep(checkpoint=tmp_path / "kept")
    assert np.array_equal(kept.xs, found.xs) and np.array_equal(again.xs, found.xs)
    with pytest.raises(ValueError, match="observe"):
        sweep(Friction(jnp.array(3.0)), checkpoint=tmp_path / "kept")
    found.save(tmp_path / "diagram.nc")
    back = jf.load(tmp_path / "diagram.nc")
    assert np.array_equal(back.xs, found.xs) and back.labels.state == found.labels.state
    assert back.conditions.observe == found.conditions.observe
    assert back.conditions.observe.startswith("Friction, function ")


@pytest.mark.slow
def test_one_number_is_kept_of_lanes_that_start_from_their_own_states_or_follow(tmp_path):
    def phase(t, x, side):
        return x[0]

    options = dict(samples=2, forces=(1.25, 2.0, 3.0))
    each = jnp.array([[0.1, 1.0], [0.2, 1.0], [0.3, 1.0]])
    own = jf.bifurcation_diagram(
        Dragged(jnp.array(1.0)),
        "force",
        jnp.array([1.25, 2.0, 3.0]),
        each,
        transient=1,
        samples=2,
        steps=8,
        stepper=jf.RK4(),
        compact=True,
        progress=False,
        observe=phase,
    )
    np.testing.assert_array_equal(own.xs[..., 0], np.repeat([[0.1], [0.2], [0.3]], 2, axis=1))
    data = own.to_xarray()
    assert data["x"].dims == ("force", "sample", "component")
    assert data["component"].values.tolist() == ["phase"] and data["x0"].dims == (
        "force",
        "x0_component",
    )
    followed = sweep(phase, follow="up", checkpoint=tmp_path / "followed", **options)
    np.testing.assert_array_equal(followed.xs, np.full((3, 2, 1), 0.3))


def test_samples_may_be_modes():
    """The push at the ends of periods, cos 0.3, makes it slip where friction is less."""
    found = sweep(lambda t, x, mode: mode, forces=(0.5, 1.25))
    np.testing.assert_array_equal(found.xs[..., 0], [[1, 1, 1], [0, 0, 0]])


def test_at_a_section_it_is_the_side_and_the_time_there():
    """x falls through zero above, where y = 1, after a quarter of a turn and whole turns."""
    d = jf.bifurcation_diagram(
        Turn(jnp.array(1.0)),
        "rate",
        jnp.array([2.0]),
        jnp.array([1.0, 0.0]),
        transient=1,
        samples=2,
        steps=8,
        section=jf.Section(lambda t, x: x[0], direction=-1),
        max_return=8.0,
        compact=True,
        progress=False,
        observe=lambda t, x, side: jnp.stack([t, side]),
    )
    whole = 1.5 * np.pi
    np.testing.assert_allclose(d.xs[0, :, 0], np.pi / 2 + whole * np.array([1, 2]), rtol=1e-8)
    np.testing.assert_array_equal(d.xs[0, :, 1], 1)
    assert d.labels.state == ("observed[0]", "observed[1]")


def test_what_is_no_row_of_numbers_is_refused_by_name():
    with pytest.raises(ValueError, match="`observe` must return a number, or k of them in a row"):
        sweep(lambda t, x, side: jnp.zeros((2, 2)))
