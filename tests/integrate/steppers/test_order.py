"""The order of each method survives contacts: errors fitted against dt, within 0.3 of nominal."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from tests.problems import PROBLEMS, closed_forms

STEPPERS = {
    "RK4": (jf.RK4(), 4),
    "Tsit5": (diffrax.Tsit5(), 5),
    "Dopri8": (diffrax.Dopri8(), 8),
    "Heun": (diffrax.Heun(), 2),
    "Bosh3": (diffrax.Bosh3(), 3),
    "Dopri5": (diffrax.Dopri5(), 5),
    "Taylor": (jf.Taylor(6), 6),
}


SPIN = PROBLEMS["rotating"].system


def rotating_end(inputs, dt, stepper):
    return jf.solve(SPIN, inputs, 0.0, 2.3, dt, stepper=stepper, compact=True).xs[-1]


def rotating_exact(x0):
    return closed_forms.rotating(SPIN, x0, 0.0, 2.3)


def sticking_end(inputs, dt, stepper):
    """From t = 1/2 once round belt case 1 at omega = 1.3: slips, sticks, slips."""
    *x0, v = inputs
    system = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=1.3, v=v)
    span = 2 * np.pi / 1.3
    sol = jf.solve(system, jnp.stack(x0), 0.5, 0.5 + span, dt, stepper=stepper, compact=True)
    return sol.xs[-1]


# x(1/2) on the orbit and v; the end's derivatives. Exact per piece, 40 digits (mpmath).
BELT = np.asarray([1.8744118768552134962, -0.14979404478707690457, 1.0])
BELT_DERIVATIVE = np.asarray(
    [
        [-0.061617088629117428013, 0.0066208452407968938517, 0.5324593663479519649],
        [1.2828365557251512335, -0.13784264225492023074, -4.205502085653285915],
    ]
)

ROTATING = np.asarray(PROBLEMS["rotating"].x0, float)
PROBLEMS = {
    "rotating": (
        rotating_end,
        ROTATING,
        2.3,
        np.asarray(rotating_exact(jnp.asarray(ROTATING))),
        np.asarray(jax.jacfwd(rotating_exact)(jnp.asarray(ROTATING))),
    ),
    "belt": (sticking_end, BELT, 2 * np.pi / 1.3, BELT[:2], BELT_DERIVATIVE),
}

# Numbers of steps between which errors are above rounding and in the asymptotic regime. The step
# after a contact is cut by it, and its error with it: the fit takes many numbers of steps.
STEPS = {
    ("rotating", "RK4"): (60, 600),
    ("rotating", "Tsit5"): (60, 600),
    ("rotating", "Dopri8"): (65, 130),
    ("rotating", "Heun"): (300, 3000),
    ("rotating", "Bosh3"): (200, 2000),
    ("rotating", "Dopri5"): (150, 1500),
    ("belt", "RK4"): (60, 600),
    ("belt", "Tsit5"): (120, 1000),
    ("belt", "Dopri8"): (27, 66),
}


@pytest.fixture(scope="module", params=STEPS, ids="-".join)
def errors(request):
    """Nominal order, numbers of steps, and the errors of values and derivatives there."""
    end, inputs, span, value, derivative = PROBLEMS[request.param[0]]
    stepper, nominal = STEPPERS[request.param[1]]
    steps = np.geomspace(*STEPS[request.param], 200)

    @jax.jit
    @jax.vmap
    def run(dt):
        both = jax.jacfwd(lambda *args: (end(*args),) * 2, has_aux=True)
        return both(jnp.asarray(inputs), dt, stepper)

    derivatives, values = run(jnp.asarray(span / steps))
    return (
        nominal,
        steps,
        abs(np.asarray(values) - value),
        abs(np.asarray(derivatives) - derivative),
    )


def fitted(steps, error):
    return -np.polyfit(np.log(steps), np.log(error), 1)[0]


@pytest.mark.slow
def test_order_of_values(errors):
    nominal, steps, values, _ = errors
    assert_allclose(fitted(steps, values.max(axis=1)), nominal, rtol=0, atol=0.3)


@pytest.mark.slow
def test_order_of_derivatives(errors):
    # By x0 on the rotating oscillator, by the belt's speed on the belt.
    nominal, steps, _, derivatives = errors
    assert_allclose(fitted(steps, derivatives[:, :, -1].max(axis=1)), nominal, rtol=0, atol=0.3)


def test_order_of_derivatives_by_the_initial_state(errors):
    # On the belt Dopri8's leading error constant is so small that its fit is above nominal until
    # rounding takes over: a lower bound.
    nominal, steps, _, derivatives = errors
    assert fitted(steps, derivatives[:, :, :2].max(axis=(1, 2))) > nominal - 0.3
