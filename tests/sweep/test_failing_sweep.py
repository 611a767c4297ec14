"""A sweep of which every lane fails says so while it runs, with the first lane's cause."""

import jax.numpy as jnp
import pytest

import jaxfil as jf


@pytest.mark.parametrize(("friction", "told"), [(jnp.nan, True), (0.4, False)])
@pytest.mark.parametrize("follow", [None, "up"])
def test_the_cause_of_the_first_lane_is_said(friction, told, follow, capsys):
    system = jf.systems.SDOscillator(f0=friction)
    jf.bifurcation_diagram(
        system,
        "omega",
        [0.7, 0.8],
        jnp.array([0.3, 0.1]),
        transient=1,
        samples=1,
        steps=10,
        stepper=jf.RK4(),
        follow=follow,
    )
    said = "All of the first 2 lanes have failed. The first one: The state, the vector field"
    assert (said in capsys.readouterr().err) == told
