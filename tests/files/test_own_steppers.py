"""Every method of jaxfil's own is known where methods are known by name: in files of results, and
on the command line."""

import diffrax
import jax.numpy as jnp
import pytest

import jaxfil as jf
from jaxfil.command import steppers, words
from jaxfil.files.solution import stepper_from
from jaxfil.integrate.steppers.explicit import OWN_METHODS, controlled, tableau_of
from jaxfil.model.dataset_io import NamedArrays

METHODS = [method() for method in OWN_METHODS.values()] + [jf.Taylor(16), diffrax.Dopri8()]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: tableau_of(method).name)
def test_a_file_names_it(method):
    def read(stepper):
        return stepper_from(NamedArrays({}, attributes={"stepper": tableau_of(stepper).name}))

    assert read(method) == method
    if not isinstance(method, jf.RK4):
        following = controlled(jf.Adaptive(1e-7, 1e-9), method)
        assert read(following) == following


class Tsit5(diffrax.Heun):
    """A method of a user, with a name that diffrax has too."""


@pytest.mark.parametrize("adaptive", [False, True])
@pytest.mark.slow
def test_dense_output_by_a_method_of_a_user_is_not_saved(tmp_path, adaptive):
    ball, x0 = jf.systems.BouncingBall(), jnp.array([1.0, 0.0])
    step = jf.Adaptive(1e-4) if adaptive else 0.05
    run = dict(stepper=Tsit5(), max_steps=4096)
    dense = jf.solve(ball, x0, 0.0, 1.0, step, saveat=diffrax.SaveAt(dense=True), **run)
    with pytest.raises(ValueError, match="cannot hold dense output by a stepper of your own"):
        dense.save(tmp_path / "dense.npz")
    sol = jf.solve(ball, x0, 0.0, 1.0, step, **run)
    sol.save(tmp_path / "end.npz")
    assert (jf.load(tmp_path / "end.npz").xs == sol.xs).all()


def test_the_command_line_has_it():
    assert tuple(steppers.STEPPERS) == words.STEPPERS
    assert set(OWN_METHODS) < set(words.STEPPERS)
