"""One lane is one kernel, in a user's own transformation too: the same numbers as its many parts,
where XLA can compile it, and where it cannot."""

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxfil as jf
from jaxfil.xla import fits, kernel
from tests.xla.operations import names

X0 = jnp.array([1.0, 0.5])


class Coupled(jf.System):
    """A field written with what one kernel may hold (a product) or not (LAPACK, a scatter)."""

    a: jax.Array
    how: str = eqx.field(static=True)

    def vector_field(self, t, x, side):
        matrix = jnp.eye(2) + self.a
        pull = {
            "product": lambda: matrix @ x,
            "solve": lambda: jnp.linalg.solve(matrix, x),
            "scatter": lambda: x.at[jnp.argsort(x)].multiply(1 + self.a),
        }
        return -pull[self.how]() - 0.4 * side

    def switching(self, t, x):
        return x[0] - 0.5


class Through(Coupled):
    """The same, declared never to slide, which it does not: half as much to compile."""

    slides = False


def run(a, how, x0=X0, compact=None, kind=Coupled):
    sol = jf.solve(kind(a, how), x0, 0.0, 2.0, 0.05, stepper=diffrax.Midpoint(), compact=compact)
    assert sol.events is not None
    return sol.x_final, sol.events.ts[:2], sol.events.kinds[:2]


def compiled(function, *args):
    """The program for these arguments, to be looked at and run."""
    return jax.jit(function).lower(*args).compile()


def is_whole(program):
    """Whether a program starts no loop of its own, only kernels that hold theirs."""
    text = program.as_text()
    return " while(" not in text[text.index("ENTRY") :]


@pytest.mark.parametrize("how", ["solve", "scatter"])
def test_what_does_not_fit_is_left_in_parts(how):
    assert not is_whole(compiled(lambda a: run(a, how), jnp.float64(0.3)))


@pytest.fixture
def in_parts(monkeypatch):
    """Call it for nothing to fit into one kernel any more, in this test."""

    def start():
        monkeypatch.setattr(kernel, "fits", lambda jaxpr: False)
        jax.clear_caches()

    yield start
    jax.clear_caches()


@pytest.mark.release
def test_a_lane_and_its_derivatives_give_what_their_parts_give(in_parts):
    a = jnp.float64(0.3)

    def alone(a):
        return run(a, "product")

    def jacobian(a):
        return jax.jacfwd(lambda a, x0: run(a, "product", x0)[:2], argnums=(0, 1))(a, X0)

    def slope(a):
        return jax.jvp(lambda a: alone(a)[0], (a,), (jnp.ones_like(a),))[1]

    def curvature(a):
        return jax.jvp(slope, (a,), (jnp.ones_like(a),))[1]

    def all_of_them():
        programs = [compiled(f, a) for f in (alone, jacobian, curvature)]
        return (alone(a), *(program(a) for program in programs)), programs

    whole, programs = all_of_them()
    assert is_whole(programs[0]) and is_whole(programs[1])
    in_parts()
    parts, programs = all_of_them()
    assert not any(is_whole(program) for program in programs)
    assert np.isfinite(parts[0][1]).any(), "there was no contact"
    for u, v in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        np.testing.assert_allclose(u, v, rtol=1e-13, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("compact", [pytest.param(False, marks=pytest.mark.release), True])
def test_batches_of_all_kinds_give_what_single_lanes_give(compact):
    """Few lanes are one kernel, many a loop over blocks, those of a compact program a loop over
    lanes, and so are their derivatives in any order."""
    some, many = jnp.linspace(0.2, 0.4, 4), jnp.linspace(0.2, 0.4, 100)
    kind = Coupled if compact else Through

    def end(a):
        return run(a, "product", compact=compact, kind=kind)[:2]

    def batch(a):
        return jax.vmap(end)(a)

    def slopes(a):
        return jax.vmap(jax.jacfwd(end))(a)

    def swapped(a):
        return jax.jvp(batch, (a,), (jnp.ones_like(a),))[1]

    alone, slope = compiled(end, some[0]), compiled(jax.jacfwd(end), some[0])
    few, lot = compiled(batch, some), compiled(batch, many)
    assert is_whole(alone) and not is_whole(lot)
    assert is_whole(few) is not compact
    for a, ends in ((some, few), (many, lot)):
        for program, ref in (
            (ends, alone),
            (compiled(slopes, a), slope),
            (compiled(swapped, a), slope),
        ):
            got = program(a)
            for i in (0, 3, -1):
                for u, v in zip(got, ref(a[i]), strict=True):
                    np.testing.assert_allclose(u[i], v, rtol=1e-13, atol=1e-14)
    nested = jax.jit(jax.vmap(jax.vmap(end)))(many.reshape(2, 50))
    for u, v in zip(nested, lot(many), strict=True):
        np.testing.assert_allclose(u.reshape(v.shape), v, rtol=1e-13, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("throw", [False, True])
def test_derivatives_of_the_end_need_no_kernel_but_their_own(throw):
    def end(x0, a):
        return jf.solve(Coupled(a, "product"), x0, 0.0, 2.0, 0.05, throw=throw).xs[-1]

    for function in (end, jax.jacfwd(end)):
        text = jax.jit(function).lower(X0, jnp.float64(0.3)).compile().as_text()
        assert text is not None
        entry = text[text.index("ENTRY") :]
        assert entry.count("xla_cpu_small_call") >= entry.count(" call(") == 1


@pytest.mark.release
@pytest.mark.parametrize("compact", [pytest.param(False, marks=pytest.mark.release), True])
def test_a_lane_can_be_linearised(compact):
    """As optimistix and lineax do: the state first, its derivative later."""
    kind = Coupled if compact else Through

    def end(a):
        return run(a, "product", compact=compact, kind=kind)[:2]

    def batch(a):
        return jax.vmap(end)(a)

    one, some = jnp.float64(0.3), jnp.linspace(0.2, 0.4, 3)
    for f, a in ((end, one), (batch, some)):
        ref = jax.jvp(f, (a,), (jnp.ones_like(a),))
        for linearized in (jax.linearize(f, a), jax.linearize(jax.jit(f), a)):
            got = linearized[0], linearized[1](jnp.ones_like(a))
            for u, v in zip(jax.tree.leaves(got), jax.tree.leaves(ref), strict=True):
                np.testing.assert_allclose(u, v, rtol=1e-13, atol=1e-14)


def everything(x, k):
    """Each operation that is held to fit into one kernel."""
    unary = [lax.abs, lax.acos, lax.asin, lax.asinh, lax.atan, lax.atanh, lax.cbrt, lax.ceil]
    unary += [lax.cos, lax.cosh, lax.erf, lax.erf_inv, lax.erfc, lax.exp, lax.exp2, lax.expm1]
    unary += [lax.floor, lax.log, lax.log1p, lax.logistic, lax.neg, lax.round, lax.rsqrt, lax.sign]
    unary += [lax.sin, lax.sinh, lax.sqrt, lax.square, lax.tan, lax.tanh, lax.stop_gradient]
    unary += [jnp.log2]
    binary = [lax.add, lax.atan2, lax.div, lax.max, lax.min, lax.mul, lax.pow]
    binary += [lax.rem, lax.sub]
    compare = [lax.eq, lax.ge, lax.gt, lax.le, lax.lt, lax.ne]
    flags = [f(x, k * x) for f in compare]
    out = [f(x) for f in unary] + [lax.acosh(1 + x)] + [f(x, 1 + x) for f in binary]
    out += [lax.nextafter(lax.stop_gradient(x), 1.0 + lax.stop_gradient(x))]
    out += [flags[0] & flags[1], flags[0] | flags[1], flags[0] ^ flags[1], ~flags[0]]
    out += [lax.is_finite(x), lax.integer_pow(x, 3), lax.clamp(0.1, x, 0.9), lax.reduce_precision(
        x, 8, 23), lax.argmax(x, 0, np.int32), lax.argmin(x, 0, np.int32)]  # fmt: skip
    out += [f(x) for f in (jnp.sum, jnp.prod, jnp.max, jnp.min)] + [jnp.any(x > 1), jnp.all(x > 1)]
    out += [
        x.reshape(2, 3).T,
        lax.rev(x, (0,)),
        jnp.concatenate([x, x]),
        lax.pad(x, 0.0, [(1, 1, 0)]),
    ]
    out += [
        jnp.stack([x, x]),
        jnp.tile(x, 2),
        lax.split(x, (2, 4)),
        list(x),
        x[1:3],
        x[None, :],
        x[0:1].squeeze(0),
    ]
    index = k.astype(int)
    out += [lax.bitcast_convert_type(lax.stop_gradient(x), jnp.int64) << 1]
    out += [lax.dynamic_slice(x, (index,), (2,)), x[jnp.array([2, 1])], jnp.where(x > 1, x, 0.0)]
    out += [
        lax.scan(lambda c, v: (c * v, c + v), x[0], x)[1],
        lax.while_loop(lambda v: v[0] < 9, lambda v: v + x, x),
    ]
    out += [
        lax.cond(k > 1, jnp.sin, jnp.cos, x),
        lax.optimization_barrier(x),
        jnp.array(x, copy=True),
        jax.device_put(x),
    ]
    out += [lax.iota(np.int32, 3), jax.jit(jnp.sin)(x), jax.nn.relu(x), eqxi.unvmap_any(k > 1)]
    out += [jax.linear_transpose(lambda v: v + v, x)(x)[0]]
    # A count over the lanes of a batch: a sum over an axis, once the batch is one.
    out += [jax.vmap(lambda v: v / lax.psum(v, "batch"), axis_name="batch")(x)]
    out += [jax.linearize(lambda x: lax.cond(k > 1, jnp.sin, jnp.negative, x), x)[1](x)]
    return out


# Names that other versions of JAX have for some of them.
OTHERS = {"pjit", "copy_p", "copy", "stop_gradient", "exp2", "square", "unstack", "stack", "split"}
OTHERS |= {"empty2", "tile", "log2", "one_minus_square"}
# A zero that stands for a second derivative, compiled as an array of zeros.
OTHERS |= {"vanishing_map"}
# Forward derivatives, which `test_forward_jacobian` compiles.
OTHERS |= {"pushforward"}


@pytest.mark.slow
def test_a_loop_may_start_from_a_number_that_a_kernel_is_given():
    """Arguments that XLA knew were no longer used by the kernel, and XLA aborted (up to 0.10.2) if
    it had also made a copy of them for a loop."""

    def loop(start, y):
        body = lambda s: (jnp.sin(s[0]), s[1] + 1)  # noqa: E731
        return jax.lax.while_loop(lambda s: s[1] < 4, body, (y, start))

    def both(y):
        start, zero = jnp.zeros((), jnp.int32), jnp.zeros(())
        once = kernel.kernel_if_it_fits(lambda y, start: y + start.astype(y.dtype))(y, start)
        sol = jf.solve(jf.systems.CoulombOscillator(), once * X0, 0.0, 1.0, 0.5, stepper=jf.RK4())
        return loop(start, once), loop(zero, sol.x_final)

    y = jnp.asarray(0.3)
    (a, _), (b, _) = jax.jit(both)(y)
    end = jf.solve(jf.systems.CoulombOscillator(), y * X0, 0.0, 1.0, 0.5, stepper=jf.RK4()).x_final
    np.testing.assert_allclose(a, loop(0, y)[0], rtol=1e-15)
    np.testing.assert_allclose(b, loop(0, end)[0], rtol=1e-15)


@pytest.mark.slow
def test_one_kernel_holds_what_is_said_to_fit():
    x, k = jnp.linspace(0.2, 0.7, 6), jnp.float64(1.0)
    found = set(names(jax.make_jaxpr(everything)(x, k).jaxpr))
    assert found <= fits.FITTING, found - fits.FITTING
    assert fits.FITTING - found <= OTHERS, fits.FITTING - found - OTHERS

    def moved(x, k):
        return jax.jvp(lambda x: everything(x, k), (x,), (x,))

    def lanes(x, k):
        return jax.vmap(moved)(x, k)

    for function, args in ((everything, (x, k)), (lanes, (jnp.stack([x] * 64), jnp.ones(64)))):
        assert is_whole(compiled(kernel.kernel_if_it_fits(function), *args))


def test_blocks_of_rows_are_kernels_and_ask_each_other():
    """Newton's method for roots, until all of a block have converged."""
    scale = jnp.float64(2.0)

    def roots(a):
        body = lambda x: 0.5 * (x + scale * a / x)  # noqa: E731
        return jax.lax.while_loop(lambda x: jnp.any(abs(x * x - scale * a) > 1e-12 * a), body, a)

    def blocks(a):
        run = kernel.kernel_of_rows(roots, 8, a)
        assert run is not None
        return run(a)

    for p in (3, 8, 21):
        a = jnp.linspace(1.0, 9.0, p)
        program = compiled(blocks, a)
        assert is_whole(program) == (p <= 8), "one kernel, or a loop over kernels"
        assert "xla_cpu_small_call" in program.as_text()
        np.testing.assert_allclose(program(a), np.sqrt(2 * a), rtol=1e-12)
    assert kernel.kernel_of_rows(jnp.sort, 8, a) is None


def test_an_error_of_the_users_own_is_told():
    class Guarded(Coupled):
        def vector_field(self, t, x, side):
            return eqx.error_if(-x, x[0] < 0.9, "left the model's range")

    with pytest.raises(eqx.EquinoxRuntimeError, match="left the model's range"):
        jf.solve(Guarded(jnp.float64(0.3), "product"), X0, 0.0, 2.0, 0.05)
