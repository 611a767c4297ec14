"""Names that have changed are found under their old spelling, for one release, with a warning."""

import jax.numpy as jnp
import pytest

import jaxfil as jf

SD = jf.systems.SDOscillator(omega=0.84)


@pytest.fixture(scope="module")
def orbit():
    return jf.periodic_orbit(SD, jnp.array([1.9, 0.0]), steps=20, stepper=jf.RK4())


@pytest.fixture(scope="module")
def graze(orbit):
    return jf.find_bifurcation(SD, "omega", orbit, "grazing")


@pytest.mark.parametrize(
    "old, new", [("KINDS", "EventKind"), ("Route", "BifurcationSequence")], ids=lambda n: n
)
def test_a_class_is_found_under_its_old_name(old, new):
    with pytest.warns(
        DeprecationWarning, match=f"`jaxfil.{old}` is now called `jaxfil.{new}`"
    ) as warned:
        assert getattr(jf, old) is getattr(jf, new)
    assert warned[0].filename == __file__  # the line to be changed


def test_an_outcome_is_found_under_its_old_name():
    with pytest.warns(DeprecationWarning, match="is now called `RESULTS.no_tangency_found`"):
        old = jf.RESULTS.nothing_to_touch
    assert bool(old == jf.RESULTS.no_tangency_found)
    with pytest.raises(AttributeError):
        _ = jf.RESULTS.nothing_at_all


def test_attributes_are_found_under_their_old_names(orbit, graze):
    with pytest.warns(DeprecationWarning, match="`plan` is now called `options`") as warned:
        assert orbit.plan is orbit.options
    assert warned[0].filename == __file__
    with pytest.warns(DeprecationWarning, match="`touch` is now called `tangency`"):
        assert graze.touch is graze.tangency


@pytest.mark.parametrize("verb", ["diagram", "branch", "bifurcation", "sequence", "curve"])
def test_arguments_are_taken_under_their_old_names(verb, orbit, graze):
    calls = {
        "diagram": lambda **name: (
            jf.bifurcation_diagram(
                SD,
                values=[0.8],
                x0=jnp.zeros(2) + 0.1,
                transient=1,
                samples=1,
                steps=10,
                stepper=jf.RK4(),
                progress=False,
                **name,
            ).values
        ),
        "branch": lambda **name: jf.continue_orbit(SD, orbit=orbit, stop=0.845, **name).values,
        "bifurcation": lambda **name: (
            jf.find_bifurcation(SD, orbit=orbit, kind="grazing", **name).value
        ),
        "sequence": lambda **name: (
            jf.find_bifurcations(SD, orbit=orbit, stop=0.845, **name).branch.values
        ),
        "curve": lambda **name: (
            jf.continue_bifurcation(SD, bifurcation=graze, stop=(0.85, 0.88), **name).values
        ),
    }
    several = verb == "curve"
    old, new = ("names", "parameters") if several else ("name", "parameter")
    value = ("omega", "f0") if several else "omega"
    with pytest.warns(DeprecationWarning, match=f"`{old}` is now called `{new}`") as warned:
        found = calls[verb](**{old: value})
    assert warned[0].filename == __file__
    assert (found == calls[verb](**{new: value})).all()


def test_an_old_and_a_new_name_together_are_an_error(orbit):
    with pytest.raises(TypeError, match="name"):
        jf.continue_orbit(SD, parameter="omega", name="omega", orbit=orbit, stop=0.85)
