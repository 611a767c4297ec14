"""What tests do with results: run a problem, read its events, compare it with what is known."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from jaxfil import EventKind
from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.model.outcomes import outcome_names

DEFAULT = diffrax.Dopri8()


def rounding_of_steps(stepper):
    """The rounding of a run that steps through slopes of some size, in eps of the way it takes:
    h Σ b_i k_i is rounded by half an eps of its terms, and so are the k_i of Rodas5P, each the
    difference of a solution and of Σ (γ_ij/γ) k_j."""
    tableau = tableau_of(stepper)
    terms = [1 + sum(map(abs, row)) for row in getattr(tableau, "coupling", ())]
    terms = terms or [1.0] * len(tableau.b)
    return 0.5 * sum(abs(b) * size for b, size in zip(tableau.b, terms, strict=True))


def run(system, x0, t1, dt, ts=None, t0=0.0):
    """Three saved times and a table of events, so that all lanes share one compiled program."""
    ts = jnp.linspace(t0, t1, 3) if ts is None else jnp.asarray(ts, float)
    x0 = jnp.asarray(x0, float)
    saveat = diffrax.SaveAt(ts=ts)
    return jf.solve(system, x0, t0, t1, dt, saveat=saveat, max_events=64, throw=False)


def solved(problem):
    """The motion of a problem of the bank, as `run` gives it."""
    p = problem
    return run(p.system, p.x0, p.t1, p.dt, t0=p.t0)


def table(sol):
    """Times and kinds of the events that happened."""
    count = int(sol.num_events)
    assert np.all(np.isinf(sol.events.ts[count:]))
    assert np.all(sol.events.kinds[count:] == EventKind.none)
    return np.asarray(sol.events.ts[:count]), sol.events.kinds[:count].tolist()


def assert_solves(problem, sol):
    """Assert all that is known of a problem's motion."""
    p = problem
    assert outcome_names(sol.result) == p.outcome
    times, kinds = table(sol)
    if p.kinds is not None:
        # Of infinitely many contacts the first ones are known.
        several = len(p.kinds) if "zeno" in p.tags.split() else None
        assert kinds[:several] == p.kinds
    t_atol = p.atol if p.t_atol is None else p.t_atol
    if p.ts is not None:
        assert_within(times[: len(p.ts)], p.ts, t_atol)
    if p.before is not None:
        assert_within(sol.events.xs[: len(p.before)], p.before, p.atol)
    if p.mode is not None:
        assert tuple(sol.mode_final.tolist()) == p.mode
    if p.end is not None:
        assert_within(sol.x_final, p.end, p.atol)
    assert_within(sol.t_final, p.t1 if p.ends_at is None else p.ends_at, np.max(t_atol))


def assert_within(got, want, atol):
    """Assert that two arrays differ by `atol` at most, which may be an array too."""
    got, want = np.asarray(got), np.asarray(want, float)
    assert got.shape == want.shape
    assert np.all(abs(got - want) <= atol), (got, want, got - want)


def lane(batch, i):
    """One member of a batch of results."""
    return jax.tree.map(lambda leaf: leaf[i] if hasattr(leaf, "shape") else leaf, batch)


def in_float32(result):
    """The same result, or system, in float32."""

    def cast(leaf):
        return jnp.asarray(leaf, jnp.float32) if np.asarray(leaf).dtype == np.float64 else leaf

    return jax.tree.map(cast, result)


def by_imaginary_part(values):
    """Multipliers in order of their imaginary part, then of their size."""
    return np.asarray(sorted(values, key=lambda z: (round(np.imag(z), 6), abs(z))))


def with_derivatives(function, order):
    """The value of a function of one array with its first derivatives, and what the function gives
    besides its value, from one program."""
    if order == 0:

        def valued(p):
            value, more = function(p)
            return (value,), more

        return valued

    def further(p):
        values, more = with_derivatives(function, order - 1)(p)
        return values[-1], (values, more)

    def derived(p):
        last, (values, more) = jax.jacfwd(further, has_aux=True)(p)
        return (*values, last), more

    return derived


def along_directions(function, order):
    """The same as a function of a point and of as many directions: the value, and its derivatives
    along the first, along the first two, and so on. A direction at a time compiles in half the
    time that all of them take."""
    if order == 0:

        def valued(p):
            value, more = function(p)
            return (value,), more

        return valued

    def along(p, *directions):
        def further(p):
            values, more = along_directions(function, order - 1)(p, *directions[:-1])
            return values[-1], (values, more)

        _, slope, (values, more) = jax.jvp(further, (p,), directions[-1:], has_aux=True)
        return (*values, slope), more

    return along


def assert_derivatives(motion, exact, lanes, rounding, order=2):
    """Assert that numbers of a motion are a closed form of the same parameters, with their first
    derivatives, in all lanes of a batch; the solutions. `rounding` is in eps of the largest of the
    numbers compared, or of 1."""
    lanes = jnp.asarray(lanes, float)
    size = lanes.shape[1]
    run = jax.jit(jax.vmap(along_directions(motion, order), (0,) + (None,) * order))
    known, _ = jax.jit(jax.vmap(with_derivatives(lambda p: (exact(p), None), order)))(lanes)
    scales = [max(1, np.max(abs(want))) for want in known]
    for which in np.ndindex(*[size] * order):
        found, sols = run(lanes, *np.eye(size)[list(which)])
        assert set(outcome_names(sols.result).ravel()) == {"successful"}
        for k, (got, want) in enumerate(zip(found, known, strict=True)):
            want = want[(..., *which[:k])]
            assert_within(got, want, rounding * np.finfo(float).eps * scales[k])
    return sols


def kinds_of(sols):
    """The kinds of the events of each lane."""
    return [table(lane(sols, k))[1] for k in range(len(sols.num_events))]
