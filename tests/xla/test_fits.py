"""Fields that a kernel cannot hold as they are: tables, long sums, and a compiler that makes no
kernels. The process lives, and the numbers are those of the closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil.xla import compiler, fits

X0 = jnp.array([1.0, 0.0])
END = 3.0
TOLERANCE = 1e-13


class Tabulated(jf.System):
    """x'' = -x, whose force is read from a table: in a field, made within, or closed over.

    Its surface parts one field from itself: what never slides compiles sooner."""

    slides = False
    omega: jax.Array
    table: jax.Array | None = None
    how: str = eqx.field(static=True, default="interpolated")
    entries: int = eqx.field(static=True, default=2000)

    def vector_field(self, t, x, side):
        n = self.entries
        if self.how == "summed":
            return jnp.stack([x[1], -jnp.sum(jnp.full(n, 1 / n, x.dtype) * x[0])])
        grid = np.linspace(-2.0, 2.0, n)
        force = jnp.asarray(grid) if self.table is None else self.table
        if self.how == "indexed":  # entry number k is the one that belongs to the middle of a cell
            cell = jnp.clip(jnp.floor((x[0] + 2) / 4 * (n - 1)), 0, n - 2).astype(int)
            rest = x[0] - jnp.asarray(grid)[cell]
            return jnp.stack([x[1], -(force[cell] + rest)])
        return jnp.stack([x[1], -jnp.interp(x[0], jnp.asarray(grid), force)])

    def switching(self, t, x):
        return x[0] - 0.5

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def end(x0, system):
    return jf.solve(system, x0, 0.0, END, 0.05, max_events=None).x_final


def exact(t):
    return np.stack([np.cos(t), -np.sin(t)], axis=-1)


def table(entries):
    return jnp.linspace(-2.0, 2.0, entries)


ONE = jnp.asarray(1.0)
SYSTEMS = {
    "closed over, interpolated": lambda: Tabulated(ONE),
    "closed over, by index": lambda: Tabulated(ONE, how="indexed"),
    "closed over, a hundred thousand": lambda: Tabulated(ONE, entries=100_000),
    "a field": lambda: Tabulated(ONE, table(2000)),
    "a field, by index": lambda: Tabulated(ONE, table(2000), how="indexed"),
    "a field, a hundred thousand": lambda: Tabulated(ONE, table(100_000), entries=100_000),
    "summed": lambda: Tabulated(ONE, how="summed", entries=100),
}


@jax.custom_batching.custom_vmap
def by_library(a):
    """A system that a library solves, with a rule for batches of its own."""
    return jnp.linalg.solve(a, a[0])


@by_library.def_vmap
def _(size, batched, a):
    return jnp.linalg.solve(a, a[:, 0, :, None])[..., 0], True


def test_a_function_with_its_own_batches_is_examined():
    program = jax.make_jaxpr(by_library)(jnp.eye(2)).jaxpr
    assert not fits.fits(program)


@pytest.mark.slow
@pytest.mark.parametrize("where", SYSTEMS)
def test_tables_in_a_field_leave_the_process_alive(where):
    # As constants of the program, made outside of it or in it.
    outside = SYSTEMS[where]()
    for run in (
        lambda x: end(x, outside),
        lambda x: end(x, SYSTEMS[where]()),
        lambda x: end(X0, outside),
    ):
        assert_allclose(jax.jit(run)(X0), exact(END), rtol=0, atol=TOLERANCE)


@pytest.mark.slow
@pytest.mark.parametrize(
    "where", ["closed over, by index", pytest.param("a field", marks=pytest.mark.release), "summed"]
)
def test_tables_live_in_batches_derivatives_and_sweeps(where):
    system = SYSTEMS[where]()
    many = jax.jit(jax.vmap(lambda x: end(x, system)))(jnp.tile(X0, (70, 1)))
    assert_allclose(many, np.broadcast_to(exact(END), many.shape), rtol=0, atol=TOLERANCE)
    turn = jax.jit(jax.jacfwd(lambda x: end(x, system)))(X0)
    c, s = np.cos(END), np.sin(END)
    assert_allclose(turn, [[c, s], [-s, c]], rtol=0, atol=10 * TOLERANCE)
    omegas = np.linspace(0.7, 1.3, 3)
    swept = jf.bifurcation_diagram(
        system, "omega", omegas, X0, transient=0, samples=2, steps=200, progress=False
    )
    times = 2 * np.pi / omegas[:, None] * np.arange(1, 3)
    assert_allclose(swept.xs, exact(times), rtol=0, atol=10 * TOLERANCE)


def test_a_failed_lane_leaves_the_table_of_the_others_as_it_is():
    system = SYSTEMS["a field"]()
    starts = jnp.stack([X0 * jnp.nan, X0, X0 * 1e300])

    def run(x):
        return jf.solve(system, x, 0.0, END, 0.05, max_events=None, throw=False).x_final

    got = jax.jit(jax.vmap(run))(starts)
    assert_allclose(got[1], exact(END), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("reduce", [jnp.sum, jnp.max, jnp.min])
def test_a_long_reduction_is_left_to_the_compiler(reduce):
    def program(size):
        return jax.make_jaxpr(lambda v: reduce(v * v))(jnp.ones(size)).jaxpr

    assert fits.fits(program(4095)) and not fits.fits(program(4096))


@pytest.fixture
def asked_anew():
    """The compiler is asked in this test, and again after it."""
    for function in (compiler.makes_whole_kernels.cache_clear, jax.clear_caches):
        function()
    yield
    for function in (compiler.makes_whole_kernels.cache_clear, jax.clear_caches):
        function()


@pytest.mark.slow
@pytest.mark.usefixtures("asked_anew")
@pytest.mark.parametrize(
    "why", ["unknown attributes", pytest.param("it refuses", marks=pytest.mark.release)]
)
def test_a_compiler_that_makes_no_kernels_is_left_alone(monkeypatch, why):
    def refuses(x):
        raise NotImplementedError

    if why == "unknown attributes":
        monkeypatch.setattr(compiler, "WHOLE", {"xla_cpu_of_another_version": "true"})
    else:
        monkeypatch.setattr(compiler, "_probe", refuses)
    assert not compiler.makes_whole_kernels()
    smooth = Tabulated(ONE, how="summed", entries=3)
    many = jax.jit(jax.vmap(lambda x: end(x, smooth)))(jnp.tile(X0, (70, 1)))
    assert_allclose(many, np.broadcast_to(exact(END), many.shape), rtol=0, atol=TOLERANCE)
    swept = jf.bifurcation_diagram(
        smooth, "omega", [1.0], X0, transient=0, samples=1, steps=200, progress=False
    )
    assert_allclose(swept.xs[0, 0], X0, rtol=0, atol=10 * TOLERANCE)
