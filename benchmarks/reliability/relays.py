"""Random relay systems against their exact motions (`relay_motion`).

A number of systems and a seed enter; a group of verdicts for each pair of n states and m surfaces
leaves. Compared are the outcome, the kinds, surfaces and times of all contacts, the states there,
and the state and mode at the end.
"""

import equinox as eqx
import jax
import numpy as np

import jaxfil as jf
from benchmarks.reliability.lanes import in_chunks
from benchmarks.reliability.relay_modes import Relays
from benchmarks.reliability.relay_motion import Motion, propagate
from benchmarks.reliability.verdict import DECIDED, Group, Verdict
from jaxfil import EventKind
from jaxfil.model.outcomes import outcome_names

T1 = 4.0
# Contacts that a solution keeps, and that an exact motion may have.
ROOM, MOST = 256, 2000
# Steps resolve the fastest field on the way, sliding fields among them: this much of its norm.
RESOLVED, LONGEST, SHORTEST = 0.3, 0.025, 2e-5
# Errors allowed, relative to the size of the motion: outright, or times what a change of the
# system by 1 does to the motion.
ALLOWED, OF_GROWTH = 1e-9, 1e-12
# Rounding, as a change of the system.
ROUNDED = 1e-14
# (n, m) and their part of all systems; three surfaces on which all may slide compile for minutes.
SHAPES = {
    **{(n, 1): 0.1 for n in (2, 3, 4, 5, 6)},
    **{(n, 2): 0.095 for n in (2, 3, 4, 5, 6)},
    (3, 3): 0.025,
}


class RelaySystem(jf.System):
    """x' = A x + b + Σ_j side_j (c_j + g_j H_j), H = N x - d."""

    a: jax.Array
    b: jax.Array
    c: jax.Array
    g: jax.Array
    n: jax.Array
    d: jax.Array

    def vector_field(self, t, x, side):
        relays = self.c + self.g * self.switching(t, x)[:, None]
        return self.a @ x + self.b + side @ relays

    def switching(self, t, x):
        return self.n @ x - self.d


def random_system(seed, m, n=3):
    """A system of order one that turns, with surfaces near its state and mostly attracting."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    a = 1.5 * (a - a.T) + 0.4 * rng.normal(size=(n, n)) - 0.3 * np.eye(n)
    normals, c = rng.normal(size=(m, n)), 1.5 * rng.normal(size=(m, n))
    attracts = rng.random(m) < 0.8
    c = np.where((attracts & ((normals * c).sum(axis=1) > 0))[:, None], -c, c)
    g = rng.normal(size=(m, n)) * (rng.random((m, 1)) < 0.5)
    d = 0.5 * rng.normal(size=m)
    return Relays(a, rng.normal(size=n), c, g, normals, d), rng.normal(size=n)


def random_direction(system, x0, seed):
    """A change of everything, of order one."""
    rng = np.random.default_rng([seed, 1])
    return Relays(*(rng.normal(size=np.shape(v)) for v in system)), rng.normal(size=x0.shape)


def moved(system, x0, direction, step):
    """The exact motion of everything moved a step along a direction."""
    bent = Relays(*(u + np.longdouble(step) * v for u, v in zip(system, direction[0], strict=True)))
    return propagate(bent, x0 + np.longdouble(step) * direction[1], T1, MOST, through=True)


def sure(motion: Motion):
    """Which contacts are compared: all but those of an accumulation."""
    ts = np.asarray(motion.ts, float)
    return counted(ts, motion)


def counted(ts, motion: Motion):
    """Which of these times are outside of the accumulations of a motion."""
    inside = [(ts > begin - 1e-9) & (ts < end + 1e-7) for begin, end in spans(motion)]
    return ~np.any([np.zeros(len(ts), bool), *inside], axis=0)


def spans(motion: Motion):
    """The accumulations, as floats."""
    return [(float(begin), float(end)) for begin, end in motion.spans]


def structure(motion: Motion):
    """What does not change with a small change of the system."""
    columns = (motion.kinds, motion.surfaces)
    kept = [np.asarray(c)[sure(motion)].tolist() for c in columns]
    return motion.outcome, motion.mode, len(motion.spans), *kept


@eqx.filter_jit
@eqx.filter_vmap
def solve(system, x0, dt):
    """What is compared of a chunk of solutions."""
    sol = jf.solve(RelaySystem(*system), x0, 0.0, T1, dt, max_events=ROOM, throw=False)
    return sol.result, sol.t_final, sol.x_final, sol.mode_final, sol.num_events, sol.events


def values(motion: Motion):
    """The end, and the times of the contacts compared and the states there."""
    before = np.reshape(motion.before, (-1, len(motion.x)))
    return motion.x, np.asarray(motion.ts)[sure(motion)], before[sure(motion)]


def growth(system, x0, seed, step=1e-9):
    """What a change of the system by 1 does to the motion; infinite if a step changes contacts."""
    direction = random_direction(system, x0, seed)
    ahead, behind = (moved(system, x0, direction, s) for s in (step, -step))
    if structure(ahead) != structure(behind):
        return np.inf
    pairs = zip(values(ahead), values(behind), strict=True)
    return 1 + max(float(abs(u - v).max(initial=0)) / (2 * step) for u, v in pairs)


def distance(motion: Motion, sol):
    """The largest error of the end and of all contacts; infinite where these are others."""
    _, _, x, mode, count, events = sol
    ts, xs, codes, surfaces = (
        v[:count] for v in (events.ts, events.xs, events.kinds, events.surfaces)
    )
    kept = counted(ts, motion)
    kinds = [EventKind(int(k)).name for k in codes[kept]]
    found = "successful", tuple(mode.tolist()), len(motion.spans), kinds, surfaces[kept].tolist()
    if found != structure(motion):
        return np.inf
    exact = [np.asarray(v, float) for v in values(motion)]
    size = 1 + max(abs(v).max(initial=0) for v in exact[::2])
    pairs = zip((x, ts[kept], xs[kept]), exact, strict=True)
    return max(abs(u - v).max(initial=0) for u, v in pairs) / size


def judge(number, system, x0, motion: Motion, name, sol):
    """The verdict on one solution, called `name`."""
    successful = name == "successful"
    if successful and motion.outcome == "successful":
        error = distance(motion, sol)
        if error <= ALLOWED:
            return Verdict(number, "right", error=error)
        grown = growth(system, x0, 0)
        if error <= OF_GROWTH * grown < 1e-3:
            return Verdict(number, "right", error=error)
        decided = motion.margin >= max(DECIDED, ROUNDED * grown)
        detail = f"error {error:.1e}, margin {motion.margin:.0e}, growth {grown:.0e}"
        return Verdict(number, "wrong" if decided else "rounding", detail, error)
    decided = motion.margin >= DECIDED
    detail = f"{name} at {float(sol[1]):.6g}, exactly {motion.outcome} at {float(motion.t):.6g}"
    detail += f", margin {motion.margin:.0e}"
    if successful:
        return Verdict(number, "wrong" if decided else "rounding", detail)
    crowded = len(motion.ts) > ROOM
    same = motion.outcome != "successful" and abs(float(sol[1]) - float(motion.t)) < 1e-7
    told = not decided or crowded or same
    return Verdict(number, "told" if told else "refused", detail)


def group(n, m, count, seed):
    """The verdicts on `count` systems of n states and m surfaces."""
    problems = [random_system([seed, n, m, i], m, n) for i in range(count)]
    motions = [propagate(*problem, T1, MOST, through=True) for problem in problems]
    dts = np.clip([RESOLVED / (motion.rate + 1e-3) for motion in motions], SHORTEST, LONGEST)
    sols = in_chunks(solve, problems, dts)
    names = outcome_names(sols[0])
    verdicts = []
    for i, (problem, motion, name) in enumerate(zip(problems, motions, names, strict=True)):
        lane = jax.tree.map(lambda v, i=i: v[i], sols[1:])
        verdicts.append(judge(i, *problem, motion, str(name), (None, *lane)))
    return Group("relays", f"{n} states, {m} surface{'s' * (m > 1)}", verdicts)


def groups(systems, seed):
    """All shapes."""
    for (n, m), part in SHAPES.items():
        yield group(n, m, max(1, round(part * systems)), seed)
