"""The hard cases once more, with the linearly implicit stepper.

The tests are those of the explicit one, run with another default. Left out are those whose motion
the default stepper integrates to more digits in the steps it is given there.
"""

import pytest

import jaxfil as jf
from tests.integrate.contacts import test_event_location as cases
from tests.integrate.run import test_outcomes as outcomes
from tests.integrate.surfaces import test_sliding as slides

TESTS = [
    (cases.test_starts_on_the_surface_and_crosses, ((1, 2), 1, 1, 0.1)),
    (cases.test_starts_on_the_surface_and_slides, ((-1, 3), 3 / 4)),
    (cases.test_contact_exactly_on_a_grid_point_or_a_saved_time, (0.25,)),
    (cases.test_contact_exactly_on_a_grid_point_or_a_saved_time, (0.3,)),
    (cases.test_same_contact_again_after_the_switch, ()),
    (cases.test_both_surfaces_at_once, (lambda s1, s2: (1, 2), 0.3)),
    (cases.test_grazing_touch, (0.3,)),
    (cases.test_grazing_touch_missed_by_a_little, (1e-6, 0.3, jf.Rodas5P())),
    (cases.test_grazing_touch_missed_by_a_little, (1e-9, 2.0, jf.Rodas5P())),
    (slides.test_chattering, (0.3, 1)),
    (outcomes.test_repelling_slide, (0.1,)),
    (outcomes.test_very_stiff_sides, ()),
]


@pytest.fixture(autouse=True)
def implicit(monkeypatch):
    """What a test solves it solves with the other stepper, and it solves something."""
    solve, steppers = jf.solve, []

    def with_rodas5p(*args, stepper=None, **kwargs):
        steppers.append(stepper)
        return solve(*args, stepper=jf.Rodas5P(), **kwargs)

    monkeypatch.setattr(jf, "solve", with_rodas5p)
    yield
    assert steppers and set(steppers) == {None}


@pytest.mark.slow
@pytest.mark.parametrize(("test", "arguments"), TESTS, ids=lambda v: getattr(v, "__name__", ""))
def test_hard_cases(test, arguments):
    test(*arguments)
