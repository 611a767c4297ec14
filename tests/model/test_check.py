"""Bad calls: a ValueError that names the argument, what it must be and what it was."""

import math
import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf

GOOD = jf.systems.CoulombOscillator()
FORCED = jf.systems.SDOscillator()
X0 = jnp.asarray([3.0, 0.0])
OMEGAS = np.asarray([0.7, 0.8])


class Custom(jf.System):
    """A system whose three functions return what a test wants."""

    field: object
    surface: object
    after: object

    def vector_field(self, t, x, side):
        return self.field(x)

    def switching(self, t, x):
        return self.surface(x)

    def reset(self, t, x, surface):
        return self.after(x)


def custom(field=lambda x: -x, surface=lambda x: x[0] - 9, after=lambda x: x):
    return Custom(field, surface, after)


class Short(jf.System):
    """A field that forgets its side, and a period of any kind."""

    period: object = None

    def vector_field(self, t, x):
        return x


def same(t, x):
    return x


def solve(system=GOOD, x0=X0, t0=0.0, t1=1.0, dt=0.1, **kwargs):
    return jf.solve(system, x0, t0, t1, dt, **kwargs)


def diagram(system=FORCED, parameter="omega", values=OMEGAS, x0=X0, **kwargs):
    budget = {"transient": 1, "samples": 2, "steps": 10, "progress": False} | kwargs
    return jf.bifurcation_diagram(system, parameter, values, x0, **budget)


def saving(ts):
    return diffrax.SaveAt(ts=jnp.asarray(ts))


# The call, the argument it must name and what it must say the argument was.
CALLS = {
    "system is a function": (lambda: solve(lambda t, x: x), "system", "function"),
    "system is a class": (lambda: solve(jf.systems.SDOscillator), "system", "SDOscillator"),
    "x0 is a number": (lambda: solve(x0=jnp.asarray(1.0)), "x0", "()"),
    "x0 is a batch": (lambda: solve(x0=jnp.zeros((3, 2))), "x0", "(3, 2)"),
    "x0 is empty": (lambda: solve(x0=jnp.zeros(0)), "x0", "(0,)"),
    "x0 is complex": (lambda: solve(x0=jnp.asarray([1j, 0])), "x0", "complex128"),
    "x0 is a word": (lambda: solve(x0="here"), "x0", "here"),
    "x0 is too long": (lambda: solve(x0=jnp.zeros(3)), "vector_field", "(2,)"),
    "t0 is an array": (lambda: solve(t0=jnp.zeros(2)), "t0", "(2,)"),
    "t0 is None": (lambda: solve(t0=None), "t0", "None"),
    "t1 is a word": (lambda: solve(t1="later"), "t1", "later"),
    "t1 is complex": (lambda: solve(t1=1j), "t1", "complex128"),
    "dt is zero": (lambda: solve(dt=0.0), "dt", "0.0"),
    "dt is negative": (lambda: solve(t1=-1.0, dt=-0.25), "dt", "-0.25"),
    "dt is not a number": (lambda: solve(dt=float("nan")), "dt", "nan"),
    "dt is an array": (lambda: solve(dt=jnp.full(4, 0.1)), "dt", "(4,)"),
    "stepper is a name": (lambda: solve(stepper="rk4"), "stepper", "rk4"),
    "stepper is a class": (lambda: solve(stepper=diffrax.Tsit5), "stepper", "Tsit5"),
    "stepper is implicit": (lambda: solve(stepper=diffrax.Kvaerno5()), "stepper", "Kvaerno5"),
    "saveat is a list": (lambda: solve(saveat=[0.5]), "saveat", "list"),
    "saveat is empty": (lambda: solve(saveat=diffrax.SaveAt()), "saveat", "[]"),
    "saved after the end": (lambda: solve(saveat=saving([0.5, 1.5])), "ts", "1.5"),
    "saved before the start": (lambda: solve(saveat=saving([-0.5, 0.5])), "ts", "-0.5"),
    "saved out of order": (lambda: solve(saveat=saving([0.75, 0.25])), "ts", "0.25"),
    "max_events is zero": (lambda: solve(max_events=0), "max_events", "0"),
    "max_events is a fraction": (lambda: solve(max_events=2.5), "max_events", "2.5"),
    "max_steps is negative": (lambda: solve(max_steps=-3), "max_steps", "-3"),
    "adjoint is a word": (lambda: solve(adjoint="reverse"), "adjoint", "reverse"),
    "field of another shape": (
        lambda: solve(custom(field=lambda x: jnp.zeros(3))),
        "vector_field",
        "(3,)",
    ),
    "field is None": (lambda: solve(custom(field=lambda x: None)), "vector_field", "no array"),
    "field is complex": (
        lambda: solve(custom(field=lambda x: jax.lax.complex(x, x))),
        "vector_field",
        "complex",
    ),
    "H is a matrix": (
        lambda: solve(custom(surface=lambda x: x[:, None] * x)),
        "switching",
        "(2, 2)",
    ),
    "field branches": (
        lambda: solve(custom(field=lambda x: x if x[0] > 0 else -x)),
        "vector_field",
        "TracerBoolConversionError",
    ),
    "field calls math": (
        lambda: solve(custom(field=lambda x: x * math.sin(x[0]))),
        "jnp.sin",
        "ConcretizationTypeError",
    ),
    "field is of NumPy": (
        lambda: solve(custom(field=lambda x: np.array([x[1], x[0]]))),
        "jnp.stack",
        "TracerArrayConversionError",
    ),
    "field is a list": (lambda: solve(custom(field=list)), "jnp.stack", "type list"),
    "field without side": (lambda: solve(Short()), "(self, t, x, side)", "(t, x)"),
    "H is a condition": (lambda: solve(custom(surface=lambda x: x[0] > 0)), "switching", "bool"),
    "period is a method": (lambda: solve(Short(period=lambda: 1.0)), "period", "method"),
    "piecewise by two surfaces": (
        lambda: solve(jf.piecewise(same, same, lambda t, x: x)),
        "switching",
        "(2,)",
    ),
    "piecewise by no surface": (
        lambda: solve(jf.piecewise(same, same, lambda t, x: x[:0])),
        "switching",
        "(0,)",
    ),
    "piecewise of a list": (
        lambda: solve(jf.piecewise(same, lambda t, x: [x[1], x[0]], lambda t, x: x[0])),
        "f_minus",
        "list",
    ),
    "reset of another shape": (
        lambda: solve(custom(after=lambda x: x[:1])),
        "reset",
        "(1,)",
    ),
    "f_plus is a number": (lambda: jf.piecewise(1.0, lambda t, x: x, len), "f_plus", "1.0"),
    "switching is None": (
        lambda: jf.piecewise(lambda t, x: x, lambda t, x: -x, None),
        "switching",
        "None",
    ),
    "smoothed width is negative": (lambda: jf.smoothed(GOOD, -0.5), "width", "-0.5"),
    "smoothed system is None": (lambda: jf.smoothed(None, 0.1), "system", "NoneType"),
    "diagram of no such leaf": (lambda: diagram(parameter="omgea"), "omgea", "omega"),
    "diagram without a period": (
        lambda: diagram(GOOD, "friction"),
        "period",
        "CoulombOscillator",
    ),
    "diagram of an integer": (
        lambda: diagram(jf.drive_response(FORCED, 1), "coupling"),
        "coupling",
        "no float",
    ),
    "diagram with name and values exchanged": (
        lambda: diagram(parameter=jnp.ones(2), values="omega"),
        "parameter",
        "[1., 1.]",
    ),
    "basins without a period": (
        lambda: jf.basins_of_attraction(GOOD, ([0.0], [0.0])),
        "system",
        "CoulombOscillator",
    ),
    "basins over three axes": (
        lambda: jf.basins_of_attraction(FORCED, ([0.0], [0.0], [1.0])),
        "axes",
        "[1.0]",
    ),
    "diagram of a matrix": (lambda: diagram(values=np.ones((2, 3))), "values", "(2, 3)"),
    "diagram of nothing": (lambda: diagram(values=np.ones(0)), "values", "(0,)"),
    "diagram follows sideways": (lambda: diagram(follow="left"), "follow", "left"),
    "diagram without steps": (lambda: diagram(steps=0), "steps", "0"),
    "diagram without samples": (lambda: diagram(samples=-1), "samples", "-1"),
    "diagram of negative transient": (lambda: diagram(transient=-5), "transient", "-5"),
}


@pytest.mark.parametrize("name", list(CALLS))
def test_bad_call(name):
    call, argument, was = CALLS[name]
    with pytest.raises(ValueError, match=re.escape(argument)) as caught:
        call()
    message = str(caught.value)
    assert "must" in message or "needs" in message
    assert was in message


def test_reverse_mode_with_a_traced_step_asks_for_max_steps():
    def end(dt):
        return solve(dt=dt, adjoint=diffrax.RecursiveCheckpointAdjoint()).xs[-1, 0]

    with pytest.raises(ValueError, match="max_steps"):
        jax.jit(end)(0.1)


def test_evaluate_asks_for_a_dense_solution():
    with pytest.raises(ValueError, match="dense=True"):
        solve().evaluate(0.5)


def test_traced_bad_step_is_an_outcome():
    # No ValueError is possible under jit: still no hang, and no silent success.
    sol = jax.jit(lambda dt: solve(dt=dt, throw=False))(jnp.asarray(-0.1))
    assert sol.result != jf.RESULTS.successful
