"""First calls beside diffrax, and how they grow with states and surfaces.

The calls below enter; the text of two tables leaves. Each call is made in a process of its own
(`python -m benchmarks.cost_first NAME`), in three rounds, without a cache on disk, and its
processor time is divided by that of diffrax's own first call in the same rounds.
"""

import statistics
import subprocess
import sys
import time

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import jaxfil as jf
from benchmarks.table import Column, table

X0 = np.array([0.3, 0.1])
BELT = {"gamma1": 10.0, "gamma2": 0.0, "omega": 12.0}


def belt():
    """The system of the first table."""
    return jf.systems.BeltFriction(**BELT)


def end(x0, system=None):
    """The state in which a run of jaxfil ends."""
    return jf.solve(belt() if system is None else system, x0, 0.0, 10.0, 0.05, throw=False).xs[-1]


def diffrax_end(x0, finder=optx.Newton(1e-12, 1e-12)):  # noqa: B008
    """The state in which diffrax stops at the first zero of the switching function; without a
    `finder` that at the end of the step which this zero is in."""
    system = belt()
    term = diffrax.ODETerm(lambda t, x, _: system.vector_field(t, x, jnp.ones(())))
    event = diffrax.Event(lambda t, y, args, **_: system.switching(t, y), finder)
    options = {"event": event, "adjoint": diffrax.ForwardMode(), "throw": False}
    return diffrax.diffeqsolve(term, diffrax.Dopri8(), 0.0, 10.0, 0.05, x0, **options).ys[-1]


def sweep(system=None, parameter="omega", x0=X0):
    """A diagram of 200 lanes."""
    values = np.linspace(11.0, 12.0, 200)
    system = belt() if system is None else system
    return jf.bifurcation_diagram(system, parameter, values, x0, transient=20, samples=20).xs


def orbit():
    """The orbit that the paper follows."""
    return jf.periodic_orbit(belt(), np.array([0.6, 0.0]))


def margin(orbit, system=None):
    """How far an orbit is from grazing."""
    return jf.grazing_margin(belt() if system is None else system, orbit)


def spectrum():
    """Lyapunov exponents."""
    return jf.lyapunov_spectrum(belt(), X0, periods=100).exponents


def synchronization():
    """The rate at which a copy synchronises."""
    return jf.synchronization_exponent(belt(), X0, couplings=np.linspace(0, 2, 9))


def bifurcations(orbit):
    """The sliding bifurcations of a branch."""
    return jf.find_bifurcations(belt(), "omega", orbit, stop=10.0)


def averages():
    """A diagram of 200 lanes with two numbers of each: a mean and an amplitude."""
    average = {
        "power": lambda t, x, side: -side * x[1],
        "amplitude": jf.Maximum(lambda t, x, side: x[0]),
    }
    options = dict(transient=20, samples=20, average=average)
    return jf.bifurcation_diagram(belt(), "omega", np.linspace(11, 12, 200), X0, **options).averages


def graze():
    """Where an orbit grazes a wall."""
    wall = jf.systems.ImpactOscillator(omega=1.2, amplitude=0.43)
    found = jf.periodic_orbit(wall, np.array([0.5, 0.5]))
    return wall, jf.find_bifurcation(wall, "amplitude", found, "grazing")


def grazing_curve(found):
    """The curve of this grazing in two parameters."""
    wall, grazing = found
    return jf.continue_bifurcation(wall, ("omega", "amplitude"), grazing, stop=(1.1, 1.3)).values


class Line(jf.System):
    """An equilibrium that meets a surface."""

    mu: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(1.0))

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, self.mu - x, -jnp.ones_like(x))

    def switching(self, t, x):
        return x[0]


def equilibrium():
    """The equilibrium, on its side."""
    return jf.equilibrium(Line(), np.ones(1))


def equilibria(found):
    """Its branch, through the surface."""
    return jf.continue_equilibrium(Line(), "mu", found, stop=-1.0).values


def tangencies():
    """The visible fold of a planar system."""
    return [p.x for p in jf.tangency_points(jf.systems.VisibleFold(), ((-2, 0), (-2, 0)))]


def everything():
    """Every verb once."""
    end(X0), jax.jacfwd(end)(X0), jax.grad(lambda x: end(x)[0])(X0), sweep()
    found = orbit()
    bifurcations(found), margin(found), jax.grad(lambda s: margin(found, s))(belt())
    return spectrum(), synchronization()


class Chain(jf.System):
    """n masses between springs, the first one on a belt."""

    period = 1.0
    mu: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(0.3))

    def vector_field(self, t, x, side):
        q, v = jnp.split(x, 2)
        ends = jnp.pad(q, 1)
        push = ends[2:] - 2 * q + ends[:-2] - 0.1 * v
        return jnp.concatenate([v, push.at[0].add(jnp.cos(t) - self.mu * side)])

    def switching(self, t, x):
        return x[len(x) // 2] - 1.0


class Dense(jf.System):
    """x' = A x + b side, A full."""

    a: jax.Array

    def vector_field(self, t, x, side):
        return self.a @ x - side * jnp.ones_like(x)

    def switching(self, t, x):
        return x[0]


class Surfaces(jf.System):
    """Each of m states is pushed to zero by its own relay."""

    omega: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(11.0))

    @property
    def period(self):
        return 2 * jnp.pi / self.omega

    def vector_field(self, t, x, side):
        return -x - 0.5 * side + jnp.cos(self.omega * t + jnp.arange(len(x)))

    def switching(self, t, x):
        return x


class Blocks(jf.System):
    """Burridge and Knopoff's chain: n blocks between springs on a moving belt, each with its own
    friction."""

    mu: jax.Array

    def vector_field(self, t, x, side):
        q, v = jnp.split(x, 2)
        ends = jnp.pad(q, 1)
        return jnp.concatenate([v, ends[2:] - 3 * q + ends[:-2] - self.mu * side])

    def switching(self, t, x):
        return x[x.size // 2 :] - 0.1


class Stack(jf.System):
    """Masses on each other, the lowest one on a belt, each pulled at by a spring and a force of its
    own: the friction between two of them is in the rates of three surfaces."""

    mu: jax.Array

    def vector_field(self, t, x, side):
        q, v = jnp.split(x, 2)
        below = self.mu * side
        above = jnp.append(below[1:], 0.0)
        return jnp.concatenate([v, jnp.cos(t + jnp.arange(q.size)) - q - below + above])

    def switching(self, t, x):
        v = x[x.size // 2 :]
        return v - jnp.append(0.1, v[:-1])


def textbook(name):
    """A run of a scene of `jaxfil.systems.TEXTBOOK`."""
    kind, x0 = jf.systems.TEXTBOOK[name]
    return end(np.array(x0), kind())


def chain(masses):
    """A run of a chain from rest."""
    return end(np.linspace(0.1, 0.2, 2 * masses), Chain())


def blocks(n):
    """A run of n blocks from rest."""
    friction = jnp.linspace(0.3, 0.4, n)
    return end(np.linspace(0.1, 0.2, 2 * n), Blocks(friction))


def stack(m):
    """A run of m masses on each other, from rest."""
    friction = jnp.linspace(0.4, 0.2, m)
    return end(np.linspace(0.1, 0.2, 2 * m), Stack(friction))


def dense(n):
    """A run with a matrix of n rows."""
    a = np.random.default_rng(0).normal(size=(n, n)) / n - np.eye(n)
    return end(np.linspace(1, 2, n), Dense(jnp.asarray(a)))


def surfaces(m):
    """A diagram of a system with m surfaces."""
    return sweep(Surfaces(), x0=np.linspace(1, 2, m))


# What is made before the clock starts, and what is timed.
NOTHING = lambda: None  # noqa: E731
DIFFRAX = {
    "diffrax": (NOTHING, lambda _: diffrax_end(X0)),
    "diffrax's Jacobian": (NOTHING, lambda _: jax.jacfwd(diffrax_end)(X0)),
    "diffrax, not located": (NOTHING, lambda _: diffrax_end(X0, None)),
    "its Jacobian": (NOTHING, lambda _: jax.jacfwd(lambda x: diffrax_end(x, None))(X0)),
}
CALLS = {
    "jf.solve": (NOTHING, lambda _: end(X0)),
    "its forward Jacobian": (NOTHING, lambda _: jax.jacfwd(end)(X0)),
    "jax.grad through it": (NOTHING, lambda _: jax.grad(lambda x: end(x)[0])(X0)),
    "a sweep": (NOTHING, lambda _: sweep()),
    "an orbit": (NOTHING, lambda _: orbit().x0),
    "a spectrum": (NOTHING, lambda _: spectrum()),
    "the rate of synchronisation": (NOTHING, lambda _: synchronization()),
    "find_bifurcations after an orbit": (orbit, bifurcations),
    "a margin after an orbit": (orbit, margin),
    "its gradient after the margin": (
        lambda: (found := orbit(), margin(found))[0],
        lambda found: jax.grad(lambda s: margin(found, s))(belt()),
    ),
    "averages of a sweep": (NOTHING, lambda _: averages()),
    "continue_bifurcation after the graze": (graze, grazing_curve),
    "an equilibrium": (NOTHING, lambda _: equilibrium().x),
    "its branch": (equilibrium, equilibria),
    "tangency points": (NOTHING, lambda _: tangencies()),
    "all verbs, once each": (NOTHING, lambda _: everything()),
    "Filippov's spiral": (NOTHING, lambda _: textbook("filippov-spiral")),
    "two separate relays": (NOTHING, lambda _: textbook("two-relays")),
    "two masses on each other": (NOTHING, lambda _: stack(2)),
    "three masses on each other": (NOTHING, lambda _: stack(3)),
}
GROWTH = {
    "a chain of masses": (chain, (2, 10, 50)),
    "blocks with a friction each": (blocks, (5, 20, 50)),
    "a dense field of n states": (dense, (4, 16, 64)),
    "a diagram with m surfaces": (surfaces, (1, 3, 5, 8)),
}


def measured(names, rounds):
    """Processor seconds of the first call of each name, the median over rounds. Each round makes
    all calls once, so that a machine that slows down does so for all of them."""
    return {name: statistics.median(runs) for name, runs in _all_rounds(names, rounds).items()}


def _all_rounds(names, rounds):
    runs = {name: [] for name in names}
    for _ in range(rounds):
        for name in names:
            command = [sys.executable, "-m", "benchmarks.cost_first", name]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
            runs[name].append(float(done.stdout))
            print(f"first calls: {name}, {runs[name][-1]:.1f} s", file=sys.stderr, flush=True)
    return runs


def report(quick):
    """The section's text."""
    rounds = 1 if quick else 3
    seconds = measured((*DIFFRAX, *CALLS), rounds)
    alone, jacobian = seconds["diffrax"], seconds["diffrax's Jacobian"]
    body = [
        [name, s, s / alone, s / jacobian, s / (alone + jacobian)] for name, s in seconds.items()
    ]
    heads = [
        Column("÷ diffrax", ">.2f"),
        Column("÷ its Jacobian", ">.2f"),
        Column("÷ both", ">.2f"),
    ]
    columns = [Column("first call"), Column("s", ">.1f"), *heads]
    first = table(columns, body, "First calls beside diffrax", ABOUT)
    grown = []
    for name, (_, sizes) in GROWTH.items():
        times = [*measured([f"{name}:{size}" for size in sizes], rounds).values()]
        grown += [[name, k, s, s / times[0]] for k, s in zip(sizes, times, strict=True)]
    columns = [Column("first call"), Column("of"), Column("s", ">.1f"), Column("÷ least", ">.1f")]
    return f"{first}\n\n\n{table(columns, grown, 'Growth with n and m')}"


ABOUT = """\
Processor seconds of first calls with Dopri8, tracing, compilation and the run, each in a process of
its own. diffrax: `diffeqsolve` with an `Event` on one side of the belt, located by Newton's method
of Optimistix, in forward mode; not located: the run ends with the step that the event is in."""


def main():
    """Make the call that the command line names, and print its processor seconds."""
    name, _, size = sys.argv[1].partition(":")
    for verb in dir(jf):
        getattr(jf, verb)  # imports of jaxfil's are made when a name is asked for, diffrax's above
    jax.config.update("jax_enable_x64", True)
    jax.block_until_ready(jax.jit(jnp.cumsum)(jnp.ones(3)))
    if size:
        prepare, call = NOTHING, lambda _: GROWTH[name][0](int(size))
    else:
        prepare, call = {**DIFFRAX, **CALLS}[name]
    given = prepare()
    start = time.process_time()
    jax.block_until_ready(jax.tree.leaves(call(given)))
    print(time.process_time() - start)


if __name__ == "__main__":
    main()
