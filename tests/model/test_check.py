"""Bad calls: a ValueError that names the argument, what it must be and what it was."""

import math

import diffrax
import equinox as eqx
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


class Ticking(jf.System):
    """A system with a clock of any kind."""

    clock: object

    def vector_field(self, t, x, side):
        return x

    @property
    def clocks(self):
        return (self.clock,)


class Held(Ticking):
    """A clock that is made when it is asked for, as of a period in a parameter."""

    @property
    def clocks(self):
        return (jf.Clock(self.clock),)


class Unclocked(jf.System):
    """A map that nothing calls."""

    def vector_field(self, t, x, side):
        return x

    def tick(self, t, x, clock):
        return x + 1


class Unswitched(jf.System):
    """Another one."""

    def vector_field(self, t, x, side):
        return x

    def reset(self, t, x, surface):
        return -x


class Gain(jf.System):
    """A system of one's own, with a parameter that nothing converts."""

    gain: float

    def vector_field(self, t, x, side):
        return self.gain * x


def same(t, x):
    return x


def solve(system=GOOD, x0=X0, t0=0.0, t1=1.0, dt=0.1, **kwargs):
    return jf.solve(system, x0, t0, t1, dt, **kwargs)


def diagram(system=FORCED, parameter="omega", values=OMEGAS, x0=X0, **kwargs):
    budget = {"transient": 1, "samples": 2, "steps": 10, "progress": False} | kwargs
    return jf.bifurcation_diagram(system, parameter, values, x0, **budget)


def saving(ts):
    return diffrax.SaveAt(ts=jnp.asarray(ts))


STATE = "`x0` must be of shape (n,) with n ≥ 1"
STEPPER = (
    "`stepper` must be jaxfil.RK4(), jaxfil.Rodas5P(), jaxfil.Taylor() or an instance of an "
    "explicit diffrax Runge–Kutta solver such as diffrax.Dopri8()"
)
SAVES = (
    "`saveat` must ask for exactly one of t1=True, ts=…, steps=True, dense=True (and t0=True only "
    "with steps=True)"
)
TIMES = "`saveat.ts` must be times in order within the span from t0 = 0.0 to t1 = 1.0"
DTYPE = "`x0` must be of dtype float64, float32, float16"
PERIOD = "`period` of SDOscillator must be a positive number"
BACKWARD = jf.systems.SDOscillator(omega=-0.7)
SHAPE = "`vector_field` of Custom must return an array of the shape of the state, (2,)"
COMPILED = (
    "`vector_field` of Custom must use jnp functions, since it is compiled, and t, x, side have no "
    "values before it runs; got "
)
PAIR = jf.drive_response(FORCED, 1.0)
LEAVES = (
    "`parameter` must be a parameter of _DriveResponse, one of system.f0, system.zeta, system.omega"
)

# The call, how its message begins and what it must say after that the argument was.
CALLS = {
    "system is a function": (
        lambda: solve(lambda t, x: x),
        "`system` must be an instance of jaxfil.System",
        "function",
    ),
    "system is a class": (
        lambda: solve(jf.systems.SDOscillator),
        "`system` must be an instance of jaxfil.System",
        "SDOscillator",
    ),
    "x0 is a number": (
        lambda: solve(x0=jnp.asarray(1.0)),
        STATE,
        "()",
    ),
    "x0 is a batch": (
        lambda: solve(x0=jnp.zeros((3, 2))),
        STATE,
        "(3, 2)",
    ),
    "x0 is empty": (
        lambda: solve(x0=jnp.zeros(0)),
        STATE,
        "(0,)",
    ),
    "x0 is complex": (
        lambda: solve(x0=jnp.asarray([1j, 0])),
        "`x0` must be of a real dtype",
        "complex128",
    ),
    "x0 in bfloat16": (lambda: solve(x0=X0.astype(jnp.bfloat16)), DTYPE, "bfloat16"),
    "x0 in float8": (lambda: solve(x0=X0.astype(jnp.float8_e4m3fn)), DTYPE, "float8_e4m3fn"),
    "x0 is not a number": (lambda: solve(x0=[math.nan, 0.0]), "`x0` must be finite", "[nan"),
    "x0 is infinite": (lambda: solve(x0=[3.0, math.inf]), "`x0` must be finite", "inf]"),
    "guess of an orbit is not a number": (
        lambda: jf.periodic_orbit(FORCED, X0 * math.nan),
        "`x0` must be finite",
        "nan",
    ),
    "parameter is a word": (
        lambda: jf.systems.SDOscillator(omega="0.7"),
        "`omega` of SDOscillator must be a number or an array",
        "'0.7'",
    ),
    "parameter is a list": (
        lambda: jf.systems.SDOscillator(omega=[0.7, 0.8]),
        "`omega` of SDOscillator must be a number or an array",
        "[0.7, 0.8]",
    ),
    "parameter is None": (
        lambda: jf.systems.BouncingBall(g=None),
        "`g` of BouncingBall must be a number or an array",
        "None",
    ),
    "parameter that may be None is a word": (
        lambda: jf.systems.SDOscillator(alpha="flat"),
        "`alpha` of SDOscillator must be a number or an array",
        "'flat'",
    ),
    "own parameter is a word": (
        lambda: Gain("3"),
        "`gain` of Gain must be a number or an array",
        "'3'",
    ),
    "parameter of another shape": (
        lambda: solve(jf.systems.SDOscillator(omega=jnp.ones(3))),
        "`omega` of SDOscillator must be of a shape that `vector_field` can take",
        "(3,)",
    ),
    "restitution is negative": (
        lambda: jf.systems.BouncingBall(restitution=-0.5),
        "`restitution` of BouncingBall must be 0 or more",
        "-0.5",
    ),
    "restitution at a wall is negative": (
        lambda: jf.systems.ImpactOscillator(restitution=jnp.array(-0.25)),
        "`restitution` of ImpactOscillator must be 0 or more",
        "-0.25",
    ),
    "x0 is a word": (lambda: solve(x0="here"), "`x0` must be an array of shape (n,)", "here"),
    "x0 is too long": (
        lambda: solve(x0=jnp.zeros(3)),
        "`vector_field` of CoulombOscillator must return an array of the shape of the state, (3,)",
        "(2,)",
    ),
    "t0 is an array": (lambda: solve(t0=jnp.zeros(2)), "`t0` must be a number", "(2,)"),
    "t0 is None": (lambda: solve(t0=None), "`t0` must be a number", "None"),
    "t1 is a word": (lambda: solve(t1="later"), "`t1` must be a number", "later"),
    "t0 is not a number": (lambda: solve(t0=math.nan), "`t0` must be finite", "nan"),
    "t1 is infinite": (lambda: solve(t1=jnp.inf), "`t1` must be finite", "inf"),
    "t1 is complex": (lambda: solve(t1=1j), "`t1` must be a number", "1j"),
    "dt is zero": (lambda: solve(dt=0.0), "`dt` must be a positive number", "0.0"),
    "dt is negative": (lambda: solve(t1=-1.0, dt=-0.25), "`dt` must be a positive number", "-0.25"),
    "dt is not a number": (lambda: solve(dt=float("nan")), "`dt` must be a positive number", "nan"),
    "dt makes too many steps": (
        lambda: solve(t1=1e12),
        "`dt` must make fewer than 2³¹ steps from t0 = 0.0 to t1 = 1000000000000.0",
        "0.1, which makes 1e+13",
    ),
    "dt is an array": (
        lambda: solve(dt=jnp.full(4, 0.1)),
        "`dt` must be a positive number",
        "(4,)",
    ),
    "stepper is a name": (
        lambda: solve(stepper="rk4"),
        STEPPER,
        "rk4",
    ),
    "stepper is a tolerance": (
        lambda: solve(stepper=jf.Adaptive()),
        "`stepper` must be a method; a tolerance takes the place of the step",
        "Adaptive(",
    ),
    "stepper is a class": (
        lambda: solve(stepper=diffrax.Tsit5),
        "`stepper` must be an instance",
        "Tsit5",
    ),
    "stepper is implicit": (
        lambda: solve(stepper=diffrax.Kvaerno5()),
        STEPPER,
        "Kvaerno5",
    ),
    "saveat is a list": (lambda: solve(saveat=[0.5]), "`saveat` must be a diffrax.SaveAt", "list"),
    "saveat is empty": (
        lambda: solve(saveat=diffrax.SaveAt()),
        SAVES,
        "[]",
    ),
    "saved by a function": (
        lambda: solve(saveat=diffrax.SaveAt(t1=True, fn=lambda t, y, args: y[0])),
        "`saveat.fn` must be omitted",
        "lambda",
    ),
    "every fifth step is saved": (
        lambda: solve(saveat=diffrax.SaveAt(steps=5)),
        "`saveat.steps` must be True",
        "5",
    ),
    "solver's state is saved": (
        lambda: solve(saveat=diffrax.SaveAt(t1=True, solver_state=True)),
        "`saveat.solver_state` must be False",
        "True",
    ),
    "controller's state is saved": (
        lambda: solve(saveat=diffrax.SaveAt(t1=True, controller_state=True)),
        "`saveat.controller_state` must be False",
        "True",
    ),
    "a jump is saved": (
        lambda: solve(saveat=diffrax.SaveAt(t1=True, made_jump=True)),
        "`saveat.made_jump` must be False",
        "True",
    ),
    "stages by a scan": (
        lambda: solve(stepper=diffrax.Tsit5(scan_kind="lax")),
        "`stepper.scan_kind` must be None",
        "'lax'",
    ),
    "saved after the end": (
        lambda: solve(saveat=saving([0.5, 1.5])),
        TIMES,
        "1.5",
    ),
    "saved before the start": (
        lambda: solve(saveat=saving([-0.5, 0.5])),
        TIMES,
        "-0.5",
    ),
    "saved out of order": (
        lambda: solve(saveat=saving([0.75, 0.25])),
        TIMES,
        "0.25",
    ),
    "max_events is zero": (
        lambda: solve(max_events=0),
        "`max_events` must be an integer of at least 1 or None",
        "0",
    ),
    "max_events is a fraction": (
        lambda: solve(max_events=2.5),
        "`max_events` must be an integer of at least 1 or None",
        "2.5",
    ),
    "max_steps is more than can be counted": (
        lambda: solve(max_steps=2**31),
        "`max_steps` must be an integer below 2³¹",
        "2147483648",
    ),
    "max_steps is negative": (
        lambda: solve(max_steps=-3),
        "`max_steps` must be an integer of at least 1 or None",
        "-3",
    ),
    "adjoint is a word": (
        lambda: solve(adjoint="reverse"),
        "`adjoint` must be diffrax.ForwardMode() or diffrax.RecursiveCheckpointAdjoint()",
        "reverse",
    ),
    "field of another shape": (
        lambda: solve(custom(field=lambda x: jnp.zeros(3))),
        SHAPE,
        "(3,)",
    ),
    "field is None": (
        lambda: solve(custom(field=lambda x: None)),
        SHAPE,
        "no array",
    ),
    "field is complex": (
        lambda: solve(custom(field=lambda x: jax.lax.complex(x, x))),
        "`vector_field` of Custom must return real numbers",
        "complex",
    ),
    "H is a matrix": (
        lambda: solve(custom(surface=lambda x: x[:, None] * x)),
        "`switching` of Custom must return a scalar or an array of shape (m,)",
        "(2, 2)",
    ),
    "field branches": (
        lambda: solve(custom(field=lambda x: x if x[0] > 0 else -x)),
        COMPILED,
        "TracerBoolConversionError",
    ),
    "field calls math": (
        lambda: solve(custom(field=lambda x: x * math.sin(x[0]))),
        COMPILED,
        "ConcretizationTypeError",
    ),
    "field is of NumPy": (
        lambda: solve(custom(field=lambda x: np.array([x[1], x[0]]))),
        COMPILED,
        "TracerArrayConversionError",
    ),
    "field is a list": (
        lambda: solve(custom(field=list)),
        SHAPE,
        "type list; write jnp.stack",
    ),
    "field without side": (
        lambda: solve(Short()),
        "`vector_field` of Short must take (self, t, x, side)",
        "(t, x)",
    ),
    "field of integers": (
        lambda: solve(custom(field=lambda x: jnp.array([1, 2]))),
        "`vector_field` of Custom must return numbers of the state's dtype, float64",
        "int64; write 1.0 instead of 1",
    ),
    "field in single precision": (
        lambda: solve(custom(field=lambda x: x.astype(jnp.float32))),
        "`vector_field` of Custom must return numbers of the state's dtype, float64",
        "float32",
    ),
    "reset in single precision": (
        lambda: solve(custom(after=lambda x: x.astype(jnp.float32))),
        "`reset` of Custom must return numbers of the state's dtype, float64",
        "float32",
    ),
    "period of a clock is a word": (
        lambda: jf.Clock("a"),
        "`period` must be positive and finite",
        "'a'",
    ),
    "clocks are words": (
        lambda: solve(Ticking("a")),
        "`clocks` of Ticking must be a tuple of jaxfil.Clock",
        "('a',)",
    ),
    "period of a clock is zero": (
        lambda: solve(Held(0.0)),
        "`clocks` of Held must be a tuple of jaxfil.Clock: `period` must be positive and finite",
        "0.0",
    ),
    "a tick without clocks": (
        lambda: solve(Unclocked()),
        "`clocks` of Unclocked must be a tuple of jaxfil.Clock, at which its `tick` is called",
        "missing",
    ),
    "a reset without surfaces": (
        lambda: solve(Unswitched()),
        "`switching` of Unswitched must return the surfaces of its `reset`",
        "missing",
    ),
    "clock of a batch": (
        lambda: solve(Ticking(jf.Clock(jnp.ones(3)))),
        "`clocks` of Ticking must have one period each",
        "(3,)",
    ),
    "sections is a function": (
        lambda: solve(sections=same),
        "`sections` must be a jaxfil.Section or a sequence of them",
        "same",
    ),
    "section takes a state alone": (
        lambda: solve(sections=jf.Section(lambda x: x[0])),
        "`sections[0].function` must take (t, x)",
        "(x)",
    ),
    "section branches": (
        lambda: solve(sections=jf.Section(lambda t, x: x[0] if x[1] > 0 else t)),
        "`sections[0].function` must use jnp functions",
        "TracerBoolConversionError",
    ),
    "observed without a state": (
        lambda: solve(observe=lambda t: t),
        "`observe` must take (t, x)",
        "(t)",
    ),
    "checkpoint is a number": (
        lambda: diagram(checkpoint=3),
        "`checkpoint` must be a path",
        "3",
    ),
    "one number is fitted by two": (
        lambda: jf.fit(GOOD, ("friction",), [0.5, 0.6], [1.0, 1.1], X0, 0.1),
        "`data` must have rows of shape (2,), that of the whole state without `observe`",
        "rows of shape ()",
    ),
    "two numbers are fitted by one": (
        lambda: jf.fit(GOOD, ("friction",), [1.0], X0[None], X0, 0.1, observe=lambda t, x: x[0]),
        "`data` must have rows of shape (), as `observe` returns",
        "rows of shape (2,)",
    ),
    "H is a condition": (
        lambda: solve(custom(surface=lambda x: x[0] > 0)),
        "`switching` of Custom must return real numbers",
        "bool",
    ),
    "period is a method": (
        lambda: solve(Short(period=lambda: 1.0)),
        "`period` of Short must be a number, a property or None",
        "method",
    ),
    "piecewise by two surfaces": (
        lambda: solve(jf.piecewise(same, same, lambda t, x: x)),
        "`switching` must return a scalar, since two fields have one surface",
        "(2,)",
    ),
    "piecewise by no surface": (
        lambda: solve(jf.piecewise(same, same, lambda t, x: x[:0])),
        "`switching` must return a scalar, since two fields have one surface",
        "(0,)",
    ),
    "piecewise of a list": (
        lambda: solve(jf.piecewise(same, lambda t, x: [x[1], x[0]], lambda t, x: x[0])),
        "`f_minus` must return a jax array of shape (2,)",
        "list",
    ),
    "reset of another shape": (
        lambda: solve(custom(after=lambda x: x[:1])),
        "`reset` of Custom must return an array of the shape of the state, (2,)",
        "(1,)",
    ),
    "f_plus is a number": (
        lambda: jf.piecewise(1.0, lambda t, x: x, len),
        "`f_plus` must be a callable of (t, x)",
        "1.0",
    ),
    "switching is None": (
        lambda: jf.piecewise(lambda t, x: x, lambda t, x: -x, None),
        "`switching` must be a callable of (t, x)",
        "None",
    ),
    "smoothed width is negative": (
        lambda: jf.smoothed(GOOD, -0.5),
        "`width` must be positive",
        "-0.5",
    ),
    "smoothed system is None": (
        lambda: jf.smoothed(None, 0.1),
        "`system` must be a jaxfil.System",
        "NoneType",
    ),
    "diagram of no such leaf": (
        lambda: diagram(parameter="omgea"),
        "`parameter` must be a parameter of SDOscillator, one of f0, zeta, omega",
        "omgea",
    ),
    "diagram without a period": (
        lambda: diagram(GOOD, "friction"),
        "`system` must be forced, since a diagram samples once a forcing period",
        "CoulombOscillator",
    ),
    "diagram of an integer": (
        lambda: diagram(eqx.tree_at(lambda s: s.coupling, PAIR, jnp.asarray(1)), "coupling"),
        LEAVES,
        "no float",
    ),
    "diagram with name and values exchanged": (
        lambda: diagram(parameter=jnp.ones(2), values="omega"),
        "`parameter` must be a string, or two or more different ones",
        "[1., 1.]",
    ),
    "basins without a period": (
        lambda: jf.basins_of_attraction(GOOD, ([0.0], [0.0])),
        "`system` must be forced, since motions are sampled once a forcing period",
        "CoulombOscillator",
    ),
    "basins over three axes": (
        lambda: jf.basins_of_attraction(FORCED, ([0.0], [0.0], [1.0])),
        "`axes` must be a pair, the values of two components",
        "[1.0]",
    ),
    "diagram of too many steps": (
        lambda: diagram(transient=2**30, samples=5, steps=4),
        "`transient`, `samples` and `steps` must make fewer than 2³¹ steps",
        "(1073741824 + 5) × 4",
    ),
    "diagram of too many steps at half the step": (
        lambda: diagram(transient=2**29, samples=1, steps=2, estimate_error=True),
        "`transient`, `samples` and `steps` must make fewer than 2³¹ steps",
        "(536870912 + 1) × 2 × 2 with `estimate_error`",
    ),
    "basins of too many steps": (
        lambda: jf.basins_of_attraction(FORCED, ([0.0], [0.0]), transient=53_687_091),
        "`transient`, `samples` and `steps` must make fewer than 2³¹ steps",
        "(53687091 + 32) × 40",
    ),
    "exponents of too many steps": (
        lambda: jf.lyapunov_spectrum(FORCED, X0, periods=2**26, transient=0, steps=32),
        "`periods`, `transient` and `steps` must make fewer than 2³¹ steps",
        "(67108864 + 0) × 32",
    ),
    "synchronization of too many steps": (
        lambda: jf.synchronization_exponent(FORCED, X0, [0.1], periods=2**26, steps=32),
        "`periods`, `transient` and `steps` must make fewer than 2³¹ steps",
        "(67108864 + 200) × 32",
    ),
    "orbit of too many steps": (
        lambda: jf.periodic_orbit(FORCED, X0, periods=2**26, steps=32),
        "`periods`, `transient` and `steps` must make fewer than 2³¹ steps",
        "(67108864 + 0) × 32",
    ),
    "orbit of a negative period": (lambda: jf.periodic_orbit(BACKWARD, X0), PERIOD, "-8.97"),
    "harmonics of a negative period": (
        lambda: jf.harmonic_balance(BACKWARD, jnp.zeros((3, 2)), 1),
        PERIOD,
        "-8.97",
    ),
    "exponents of a negative period": (lambda: jf.lyapunov_spectrum(BACKWARD, X0), PERIOD, "-8.97"),
    "basins of a negative period": (
        lambda: jf.basins_of_attraction(BACKWARD, ([0.0], [0.0])),
        PERIOD,
        "-8.97",
    ),
    "component is a name": (
        lambda: jf.plot.time_history(
            solve(saveat=diffrax.SaveAt(steps=True)),
            jf.plot.page().add_subplot(),
            components=(0, "v"),
        ),
        "`components[1]` must be an integer from 0 to 1",
        "'v'",
    ),
    "components are names": (
        lambda: jf.basins_of_attraction(FORCED, ([0.0], [0.0]), components=("x", "v")),
        "`components` must be two different ones from 0 to 1",
        "('x', 'v')",
    ),
    "section of names": (
        lambda: jf.plot.poincare_section(np.zeros((3, 2)), components=("x", "v")),
        "`components[0]` must be an integer from 0 to 1",
        "'x'",
    ),
    "diagram of a matrix": (
        lambda: diagram(values=np.ones((2, 3))),
        "`values` must be real numbers of shape (p,) with p ≥ 1",
        "(2, 3)",
    ),
    "diagram of nothing": (
        lambda: diagram(values=np.ones(0)),
        "`values` must be real numbers of shape (p,) with p ≥ 1",
        "(0,)",
    ),
    "diagram follows sideways": (
        lambda: diagram(follow="left"),
        '`follow` must be "up", "down" or None',
        "left",
    ),
    "diagram without steps": (
        lambda: diagram(steps=0),
        "`steps` must be an integer of at least 1",
        "0",
    ),
    "diagram without samples": (
        lambda: diagram(samples=-1),
        "`samples` must be an integer of at least 1",
        "-1",
    ),
    "diagram of negative transient": (
        lambda: diagram(transient=-5),
        "`transient` must be an integer of at least 0",
        "-5",
    ),
}


@pytest.mark.parametrize("name", list(CALLS))
def test_bad_call(name):
    call, sentence, was = CALLS[name]
    with pytest.raises(ValueError) as caught:
        call()
    message = str(caught.value)
    assert message.startswith(sentence) and len(message.splitlines()) == 1
    assert was in message.removeprefix(sentence)


def test_reverse_mode_with_a_traced_step_asks_for_max_steps():
    def end(dt):
        return solve(dt=dt, adjoint=diffrax.RecursiveCheckpointAdjoint()).xs[-1, 0]

    with pytest.raises(ValueError, match="max_steps"):
        jax.jit(end)(0.1)


def test_evaluate_asks_for_a_dense_solution():
    with pytest.raises(ValueError, match="dense=True"):
        solve().evaluate(0.5)


def test_evaluate_asks_for_a_solution_of_one_lane():
    run = lambda x0: solve(x0=x0, saveat=diffrax.SaveAt(dense=True), stepper=jf.RK4())  # noqa: E731
    sols = jax.vmap(run)(jnp.stack([X0, 2 * X0]))
    with pytest.raises(
        ValueError, match=r"`evaluate` needs .* one lane.*got a batch of shape \(2,\)"
    ):
        sols.evaluate(0.5)
    at = eqx.filter_vmap(lambda sol: sol.evaluate(0.5))(sols)
    np.testing.assert_array_equal(at[0], run(X0).evaluate(0.5))


def test_traced_bad_step_is_an_outcome():
    # No ValueError is possible under jit: still no hang, and no silent success.
    sol = jax.jit(lambda dt: solve(dt=dt, throw=False))(jnp.asarray(-0.1))
    assert sol.result == jf.RESULTS.nonfinite
