"""`python -m tests.pictures`: a picture of each kind, kept in `tests/references`.

Made-up results enter, so that nothing is computed; PNG files and a file of the words on them leave,
which `tests/test_pictures.py` compares new pictures with. Words are kept apart from the pictures,
and ticks left out, since another release of matplotlib or FreeType draws other ones.
"""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import matplotlib.style
import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text

import jaxfil as jf
from jaxfil.model.labels import labels_of
from jaxfil.model.outcomes import outcome_codes, outcomes
from jaxfil.sweep.conditions import Conditions

FOLDER = Path(__file__).parent / "references"
WORDS = FOLDER / "words.json"
SIZE, DPI = (3.3, 2.5), 100

SD, BELT = jf.systems.SDOscillator(), jf.systems.BeltFriction(v=0.5)
NAMES = labels_of(SD, 2)


def made(kind, **attributes):
    """A result of that kind that has these attributes and no others."""
    return object.__new__(type(kind)(kind.__name__, (kind,), attributes))


def unchecked(kind, **values):
    """A result with these values of its fields as they are: NumPy's in place of JAX's, or those of
    many lanes, which `vmap` gives and the check of its types would refuse."""
    result = object.__new__(kind)
    for field in dataclasses.fields(kind):
        object.__setattr__(result, field.name, values.get(field.name, field.default))
    return result


def motion():
    """A turn on a belt of velocity 1/2: it sticks, slips, crosses and ends at a wall."""
    ts = np.linspace(0.0, 8.0, 161)
    stick, slip, cross, impact = np.pi / 6, 5 * np.pi / 6, 2 * np.pi + 0.4, 7.5
    held = (stick <= ts) & (ts < slip)
    xs = np.stack([-np.cos(ts), np.where(held, 0.5, np.sin(ts))], axis=1)
    xs[ts >= impact, 1] *= -0.8
    modes = np.stack([np.where(held, 0, np.where(ts < cross, -1, 1)), np.ones(161, int)], axis=1)
    times = np.array([stick, slip, cross, impact, np.inf])
    kinds = [
        jf.EventKind.stick,
        jf.EventKind.slip,
        jf.EventKind.crossing,
        jf.EventKind.impact,
        jf.EventKind.none,
    ]
    with np.errstate(invalid="ignore"):
        before = np.stack([-np.cos(times), np.sin(times)], axis=1)
    members = np.array([[1, 0], [1, 0], [1, 0], [0, 1], [0, 0]], bool)
    surfaces = np.array([0, 0, 0, 1, -1])
    events = unchecked(
        jf.Events,
        ts=times,
        xs=before,
        surfaces=surfaces,
        members=members,
        kinds=np.array(kinds),
        modes=np.zeros((5, 2), int),
    )
    return unchecked(
        jf.Solution,
        ts=ts,
        xs=xs,
        modes=modes,
        events=events,
        num_events=np.array(4),
        result=jf.RESULTS.successful,
        stats={"num_steps": np.array(9), "num_halvings": np.array(0)},
        t_final=jnp.asarray(8.0),
        x_final=jnp.asarray(xs[-1]),
        mode_final=np.array([1, 1]),
        errors=None,
        _dense=None,
        labels=NAMES,
    )


def moved(ax):
    """One moment of a moving picture."""
    moving = jf.plot.animation(motion(), ax, BELT)
    moving._draw_frame(5.0)
    moving._draw_was_started = True  # or matplotlib warns that it was never shown


def section():
    """Points of a curve that folds, shape (400, 2)."""
    s = np.linspace(0.0, 40.0, 400)
    return np.stack([np.cos(s) + 0.3 * np.cos(2.1 * s), np.sin(s)], axis=1)


def diagram(parameter, values, xs, names):
    """A sweep with these samples and outcomes."""
    return jf.BifurcationDiagram(
        values=values,
        xs=xs,
        results=outcomes(outcome_codes(np.array(names))),
        parameter=parameter,
        system="SDOscillator",
        conditions=Conditions({}, np.zeros(2), 0, 40, "RK4", None, jf.__version__),
        labels=NAMES,
    )


def period_doublings():
    """The logistic map's diagram, and a value that failed."""
    values, x, samples = np.linspace(2.8, 4.0, 60), np.full(60, 0.4), []
    for k in range(40):
        x = values * x * (1 - x)
        samples += [x] * (k >= 20)
    xs = np.stack(samples, axis=1)[..., None] * np.array([1.0, -1.0])
    xs[50] = np.nan
    return diagram("omega", values, xs, ["successful"] * 50 + ["nonfinite"] + ["successful"] * 9)


def periods():
    """A plane of two parameters in which the period grows to the right, and one lane failed."""
    i, j, k = np.ogrid[:8, :6, :40]
    xs = 1.0 + (k % (1 + i // 2 + j // 3)) + 0.0 * i
    xs[7] = np.sqrt(np.arange(40.0))
    names = np.full((8, 6), "successful")
    names[0, 5] = "zeno"
    values = np.linspace(0.6, 1.3, 8), np.linspace(0.1, 0.3, 6)
    return diagram(("omega", "f0"), values, xs[..., None], names)


def powers():
    """A map of mean power with a ridge, of which one lane failed."""
    found = periods()
    omega, f0 = np.meshgrid(*found.values, indexing="ij")
    power = f0**2 / ((1 - omega**2) ** 2 + 0.1)
    power[0, 5] = np.nan
    return eqx.tree_at(
        lambda d: d.averages, found, {"power, W": power}, is_leaf=lambda v: v is None
    )


def spectrum(values=None):
    """Two exponents, of one lane or one for each value, the second lost in the last quarter."""
    times = np.linspace(10.0, 400.0, 40)
    at = np.zeros(()) if values is None else values
    exponents = np.stack([0.1 * np.sin(6 * at) + 0.05, -0.1 - 0.2 * at**2], axis=-1)
    if values is not None:
        exponents[3 * len(values) // 4 :, 1] = -np.inf
    decay = np.stack([np.cos(times) / times, -2 / times], axis=-1)
    return unchecked(
        jf.LyapunovSpectrum,
        exponents=exponents,
        standard_error=np.full(exponents.shape, 0.004),
        running=exponents[..., None, :] + decay,
        times=times,
        x0=np.zeros(2),
        x_final=np.zeros(2),
        settled=np.ones(at.shape, bool) if values is None else at < 0.9,
        result=jf.RESULTS.successful,
    )


def synchronized():
    """Drives and responses that keep apart below a coupling of 0.4."""
    couplings = np.linspace(0.0, 1.0, 11)
    distances = np.where(couplings < 0.4, 0.3 - couplings / 2, 1e-10)
    return unchecked(
        jf.Synchronization,
        exponent=np.array(0.4),
        couplings=couplings,
        distances=distances,
        synchronized=couplings >= 0.4,
        tolerance=np.array(1e-9),
        time=np.array(2000.0),
        bias=np.array(0.05),
        x0=np.zeros(2),
        results=jf.RESULTS.successful,
    )


def branch():
    """A branch with a fold, unstable above it."""
    s = np.linspace(-1.0, 1.5, 40)
    values, height = 0.9 - 0.1 * s**2, np.stack([s, 2 * s], axis=1)
    points = [
        SimpleNamespace(kind="fold", value=0.9, index=16),
        SimpleNamespace(kind="contacts", value=0.78, index=33),
    ]
    return made(
        jf.Branch,
        parameter="omega",
        values=values,
        orbits=SimpleNamespace(x0=height, system=SD),
        stable=s < 0,
        points=points,
    )


class Ellipses(eqx.Module):
    """Orbits about (1, 0), of which `trajectory` is one turn."""

    x0: np.ndarray

    @property
    def system(self):
        return SD

    def trajectory(self):
        angles = np.linspace(0.0, 2 * np.pi, 61)
        xs = self.x0 * np.stack([1 + np.cos(angles), 0.5 * np.sin(angles)], axis=1)
        modes = np.ones((61, 1), int)
        ends = {"x_final": xs[-1], "mode_final": modes[-1]}
        return unchecked(jf.Solution, ts=angles, xs=xs, modes=modes, events=None, **ends)


def widening():
    """A branch of orbits that widen."""
    values = np.linspace(0.7, 0.9, 9)
    orbits = Ellipses(np.stack([values, values], axis=1))
    return made(jf.Branch, parameter="omega", values=values, orbits=orbits)


def sequence():
    """The same branch, its change of contacts named."""
    followed = branch()
    named = SimpleNamespace(kind="adding-sliding", value=0.78)
    return unchecked(
        jf.BifurcationSequence,
        branch=followed,
        bifurcations=[followed.points[0], named],
        indices=[point.index for point in followed.points],
    )


def over_two():
    """Exponents over a grid: chaos in the middle, one lost and one that failed."""
    x, y = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 7), indexing="ij")
    first = 0.2 - x**2 - y**2
    first[0, 0], first[-1, -1] = -np.inf, np.nan
    return unchecked(
        jf.LyapunovSpectrum,
        exponents=np.stack([first, first - 1], axis=-1),
        result=jf.RESULTS.successful,
    )


def curve():
    """A curve of grazing that becomes one of crossing-sliding."""
    values = np.stack([np.linspace(0.6, 1.3, 30), np.linspace(-1, 1, 30) ** 2 + 0.1], axis=1)
    kinds = ("grazing-sliding",) * 12 + ("crossing-sliding",) * 18
    sides = {"before": kinds[0], "after": kinds[-1]}
    change = SimpleNamespace(kind="two-fold", values=values[12], **sides)
    return unchecked(
        jf.BifurcationCurve,
        parameters=("omega", "f0"),
        values=values,
        ts=np.zeros(30),
        xs=np.zeros((30, 2)),
        kinds=kinds,
        points=[change],
        ended=("", ""),
        result=jf.RESULTS.successful,
        labels=NAMES,
    )


def basins():
    """Two attractors, one of period two, whose basins spiral; chaos and a failed state."""
    axes = np.linspace(-2.0, 2.0, 30), np.linspace(-1.0, 1.0, 20)
    x, y = np.meshgrid(*axes, indexing="ij")
    labels = np.where(np.sin(3 * np.hypot(x, y) + np.arctan2(y, x)) > 0, 1, 2)
    labels[:4], labels[-1, -1] = 0, -1
    return unchecked(
        jf.Basins,
        axes=axes,
        labels=labels,
        attractors=(np.array([[0.5, 0.2]]), np.array([[-1.0, 0.3], [1.2, -0.6]])),
        results=jf.RESULTS.successful,
        components=(0, 1),
        system="SDOscillator",
        names=NAMES,
    )


def errors():
    """Two steppers of orders four and eight, down to what the reference resolves."""
    dts = np.array([0.2, 0.1, 0.05, 0.025])
    return unchecked(
        jf.WorkPrecision,
        steppers=("RK4", "Dopri8"),
        dts=dts,
        errors=np.stack([dts**4, 1e-2 * dts**8]),
        seconds=np.stack([1e-6 / dts, 3e-6 / dts]),
        num_events=np.zeros((2, 4), int),
        outcomes=np.full((2, 4), "successful"),
        reached=np.ones((2, 4), bool),
        reference=np.array([1.0, 0.5]),
        reference_stepper="Dopri8",
        reference_events=0,
        reference_error=1e-13,
        reference_check=1e-13,
        period=None,
    )


def choice():
    """Two steppers of orders four and eight, whose steps were doubled and then looked for between
    two of them."""
    counts = np.array([[4, 8, 16, 32, 64, 48], [4, 8, 12, 16, 0, 0]])
    with np.errstate(divide="ignore"):
        errors = np.stack([2e2 / counts[0] ** 4.0, 1e2 / counts[1] ** 8.0])
    order = np.argsort(np.where(counts == 0, 999, counts), axis=1)
    counts, errors = (np.take_along_axis(v, order, axis=1) for v in (counts, errors))
    errors = np.where(counts == 0, np.nan, errors)
    return unchecked(
        jf.StepChoice,
        stepper=jf.RK4(),
        steps=12,
        dt=0.1,
        error=errors[1, 2],
        seconds=36e-6,
        tolerance=1e-6,
        result=jf.RESULTS.successful,
        forced=True,
        steppers=("RK4", "Dopri8"),
        counts=counts,
        errors=errors,
        times=counts * np.array([[1e-6], [3e-6]]),
        reference=np.ones((1, 2)),
        reference_error=1e-12,
    )


VALUES = np.linspace(0.0, 1.2, 25)
FILIPPOV = jf.piecewise(
    lambda t, x: jnp.stack([1.0 + 0.0 * x[0], x[0] * (x[0] - 1)]),
    lambda t, x: jnp.stack([1.0 + 0.0 * x[0], 0.5 - x[0]]),
    lambda t, x: x[1],
)
# A saddle and a node above a pseudo-saddle that attracts from both sides, on x = 0; tangencies
# where the lower field turns, at x = ±1.
SADDLES = jf.piecewise(
    lambda t, x: jnp.stack([x[0], (1 - x[1]) * (x[1] - 2)]),
    lambda t, x: jnp.stack([x[0], 1 - x[0] ** 2]),
    lambda t, x: x[1],
)


def rests_turning():
    """A made-up branch of equilibria that turns back in a nonsmooth fold."""
    mu = np.array([1.0, 0.5, 0.0, 0.5, 1.0])
    x = np.stack([[0.0, 0.0, 0.0, 0.4, 0.8], mu], axis=1)
    at = made(jf.Equilibrium, x=x, mode=np.array([[1], [1], [0], [0], [0]]), system=SD)
    turn = made(jf.Equilibrium, x=np.zeros(2))
    point = SimpleNamespace(kind="nonsmooth-fold", value=0.0, equilibrium=turn, index=2)
    stable = np.array([True, True, False, False, False])
    told = {"parameter": "omega", "values": mu, "points": [point], "stable": stable}
    return made(jf.EquilibriumBranch, equilibria=at, **told)


PICTURES = {
    "animation": moved,
    "averages": lambda ax: jf.plot.averages(powers(), "power, W", ax),
    "basins": lambda ax: jf.plot.basins(basins(), ax),
    "bifurcation_curve": lambda ax: jf.plot.bifurcation_curve(curve(), ax),
    "bifurcation_sequence": lambda ax: jf.plot.bifurcation_sequence(sequence(), ax),
    "bifurcation_diagram": lambda ax: jf.plot.bifurcation_diagram(period_doublings(), ax),
    "branch": lambda ax: jf.plot.branch(branch(), ax),
    "branch_orbits": lambda ax: jf.plot.branch_orbits(widening(), ax),
    "equilibrium_branch": lambda ax: jf.plot.equilibrium_branch(rests_turning(), ax),
    "event_timeline": lambda ax: jf.plot.event_timeline(motion(), ax),
    "exponent_map": lambda ax: jf.plot.exponent_map(
        (np.linspace(0, 1, 9), np.linspace(0, 1, 7)), over_two(), ax, ("a", "b")
    ),
    "lyapunov_convergence": lambda ax: jf.plot.lyapunov_convergence(spectrum(), ax),
    "lyapunov_exponents": lambda ax: jf.plot.lyapunov_exponents(VALUES, spectrum(VALUES), ax, "Ω"),
    "multipliers": lambda ax: jf.plot.multipliers(
        made(jf.Orbit, multipliers=np.array([0.5 + 0.5j, 0.5 - 0.5j, -1.2]), system=SD), ax
    ),
    "parameter_map": lambda ax: jf.plot.parameter_map(periods(), ax),
    "path_in_time": lambda ax: jf.plot.path_in_time(motion(), ax),
    "phase_plane": lambda ax: jf.plot.phase_plane(SADDLES, ((-2, 2), (-1, 3)), ax),
    "phase_portrait": lambda ax: jf.plot.phase_portrait(motion(), ax, BELT),
    "poincare_section": lambda ax: jf.plot.poincare_section(section(), ax, system=SD),
    "return_map": lambda ax: jf.plot.return_map(section(), ax, system=SD),
    "section_density": lambda ax: jf.plot.section_density(section(), ax, system=SD, bins=20),
    "sliding_region": lambda ax: jf.plot.sliding_region(FILIPPOV, ((-1, 2), (-1, 1)), ax),
    "step_choice": lambda ax: jf.plot.step_choice(choice(), ax),
    "synchronization": lambda ax: jf.plot.synchronization(synchronized(), ax),
    "time_history": lambda ax: jf.plot.time_history(motion(), ax),
    "work_precision": lambda ax: jf.plot.work_precision(errors(), ax),
}


def words(figure):
    """What is written on the axes of a figure but the numbers of their ticks, in order."""
    told = []
    for ax in figure.axes:
        told += [ax.get_title(), ax.get_xlabel(), ax.get_ylabel()]
        if ax.get_legend() is not None:
            told += [text.get_text() for text in ax.get_legend().get_texts()]
        told += [text.get_text() for text in ax.texts]
    # The scales of colour, whose ticks are words.
    told += [text.get_text() for ax in figure.axes[1:] for text in ax.get_yticklabels()]
    return [text for text in told if text]


def draw(name, path):
    """Write the picture `name` without its words and ticks to `path`; the words leave."""
    with matplotlib.style.context("default"):
        figure = Figure(figsize=SIZE, dpi=DPI)
        PICTURES[name](figure.add_axes((0.06, 0.06, 0.88, 0.88)))
        told = words(figure)
        for ax in figure.axes:
            ax.xaxis.set_visible(False)
            ax.yaxis.set_visible(False)
            if ax.get_legend() is not None:
                ax.get_legend().remove()
        for text in figure.findobj(Text):
            text.set_visible(False)
        figure.savefig(path)
    return told


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    told = {name: draw(name, FOLDER / f"{name}.png") for name in PICTURES}
    WORDS.write_text(json.dumps(told, ensure_ascii=False, indent=1) + "\n")
