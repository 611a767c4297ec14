"""Every method of jaxfil's own is known where methods are known by name: in files of results, and
on the command line."""

import diffrax
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


def test_the_command_line_has_it():
    assert tuple(steppers.STEPPERS) == words.STEPPERS
    assert set(OWN_METHODS) < set(words.STEPPERS)
