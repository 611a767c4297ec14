"""Parameters by their names: leaves, and entries of those that are arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.parameter import get_parameter, parameters, replace_parameter


class Coupled(jf.System):
    """x' = a x + (cos t, 0), with a matrix, and what else may be among the leaves."""

    a: jax.Array
    network: eqx.nn.MLP | None = None
    count: int = 3

    period = 2 * np.pi

    def vector_field(self, t, x, side):
        push = 0.0 if self.network is None else self.network(x)
        return self.a @ x + jnp.stack([jnp.cos(t), jnp.zeros_like(t)]) + push


MATRIX = np.array([[-0.5, 0.8], [-1.2, -0.7]])


def coupled(matrix=MATRIX):
    return Coupled(jnp.asarray(matrix, float))


def response(matrix):
    """The periodic motion p cos t + q sin t at t = 0: q = a p + f and -p = a q, f = (1, 0)."""
    return jnp.linalg.solve(jnp.eye(2) + matrix @ matrix, -matrix[:, 0])


def with_entry(value):
    matrix = MATRIX.copy()
    matrix[1, 0] = value
    return matrix


def test_an_entry_is_named_by_its_indices():
    system = Coupled(jnp.asarray(MATRIX), eqx.nn.MLP(2, 2, 3, 1, key=jax.random.key(0)), 4)
    assert list(parameters(system))[:2] == ["a", "network.layers.0.weight"]
    for name, value in (("a[0,1]", 0.8), ("a[1, 0]", -1.2), ("a[-1,-1]", -0.7)):
        assert float(get_parameter(system, name)) == value
    changed = replace_parameter(system, "network.layers.0.weight[2,1]", 5.0)
    weight = system.network.layers[0].weight
    np.testing.assert_array_equal(
        changed.network.layers[0].weight, np.asarray(weight.at[2, 1].set(5.0))
    )
    assert changed.network.layers[0].weight.dtype == weight.dtype
    same = replace_parameter(changed, "network.layers.0.weight[2,1]", weight[2, 1])
    assert eqx.tree_equal(same, system)
    corners = [replace_parameter(system, f"a[{i}]", 9.0).a for i in ("0,0", "1,1")]
    np.testing.assert_array_equal(corners[0], [[9.0, 0.8], [-1.2, -0.7]])
    np.testing.assert_array_equal(corners[1], [[-0.5, 0.8], [-1.2, 9.0]])


def test_two_names_of_one_entry_are_one_parameter():
    with pytest.raises(ValueError, match="`parameters` must be the names of different parameters"):
        jf.fit(coupled(), ("a[1,0]", "a[-1, 0]"), [[0.0, 0.0]], np.ones((1, 2)), jnp.zeros(2), 0.1)


@pytest.mark.parametrize(
    "name, told",
    [
        ("a[0,2]", r"one of a; got 'a\[0,2\]', and `a` is of shape \(2, 2\)"),
        ("a[0]", r"got 'a\[0\]', and `a` is of shape"),
        ("b[0]", r"one of a; got 'b\[0\]'\.$"),
        ("count[0]", r"got 'count\[0\]'"),
        ("count", "'count', which is 3 and no float"),
        ("a[x]", r"got 'a\[x\]'"),
    ],
)
def test_an_entry_that_is_not_there_is_told(name, told):
    with pytest.raises(ValueError, match=told):
        get_parameter(coupled(), name)
    with pytest.raises(ValueError, match=told):
        replace_parameter(coupled(), name, 1.0)


def test_a_sweep_goes_over_an_entry(tmp_path):
    values = np.array([-1.2, -0.3])
    swept = jf.bifurcation_diagram(
        coupled(), "a[1,0]", values, jnp.zeros(2), transient=12, samples=1, progress=False
    )
    exact = [response(with_entry(value)) for value in values]
    np.testing.assert_allclose(swept.xs[:, 0], exact, rtol=0, atol=1e-9)
    swept.save(tmp_path / "entry.nc")
    again = jf.load(tmp_path / "entry.nc")
    assert again.parameter == "a[1,0]"
    np.testing.assert_array_equal(again.values, values)


@pytest.mark.slow
def test_an_orbit_is_continued_in_an_entry_and_has_derivatives_by_all():
    orbit = jf.periodic_orbit(coupled(), jnp.zeros(2))
    branch = jf.continue_orbit(coupled(), "a[1,0]", orbit, stop=-0.9, max_step=0.1)
    exact = [response(with_entry(value)) for value in branch.values]
    np.testing.assert_allclose(branch.orbits.x0, exact, rtol=0, atol=1e-10)

    def start(matrix):
        return jf.periodic_orbit(Coupled(matrix), orbit.x0).x0

    by_matrix = jax.jacrev(start)(jnp.asarray(MATRIX))
    np.testing.assert_allclose(
        by_matrix, jax.jacfwd(response)(jnp.asarray(MATRIX)), rtol=0, atol=1e-9
    )


class Tabulated(jf.System):
    """x' = f(x) + cos t with f from a table of 5,000 entries."""

    table: jax.Array

    period = 2 * np.pi

    def vector_field(self, t, x, side):
        grid = jnp.linspace(-200.0, 200.0, 5000)
        return jnp.interp(x, grid, self.table) + jnp.cos(t)


@pytest.mark.slow
def test_a_sweep_goes_over_an_entry_of_a_large_table():
    """A tooth where the motion passes makes it another one; one where it does not makes none."""
    table = -2 * jnp.linspace(-200.0, 200.0, 5000)

    def swept(table, name, values):
        return jf.bifurcation_diagram(
            Tabulated(table),
            name,
            values,
            jnp.zeros(1),
            transient=1,
            samples=1,
            steps=100,
            stepper=jf.RK4(),
            progress=False,
        )

    tooth, far = float(table[2502]), float(table[10])  # at 0.2, of a motion up to 0.45
    near = swept(table, "table[2502]", [tooth, 0.3])
    assert near.successful.all()
    changed = swept(table.at[2502].set(0.3), "table[10]", [far, 0.3])
    np.testing.assert_allclose(changed.xs, near.xs[[1, 1]], rtol=0, atol=1e-13)
    np.testing.assert_allclose(near.xs[0, 0], 0.4, rtol=0, atol=1e-5)  # x' = -2x + cos t
    assert abs(near.xs[0] - near.xs[1]).max() > 1e-2


def test_a_network_may_be_in_the_field():
    network = eqx.nn.MLP(2, 2, 8, 1, dtype=float, key=jax.random.key(0))
    system = Coupled(jnp.asarray(MATRIX), network)
    x0 = jnp.array([0.3, -0.2])
    end = jf.solve(system, x0, 0.0, 3.0, 0.05, stepper=jf.RK4()).x_final
    field = jax.jit(lambda t, x: system.vector_field(t, x, jnp.zeros(0)))
    x, h = x0, 0.05
    for k in range(60):
        t = k * h
        k1 = field(t, x)
        k2 = field(t + h / 2, x + h / 2 * k1)
        k3 = field(t + h / 2, x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + field(t + h, x + h * k3))
    np.testing.assert_allclose(end, x, rtol=0, atol=1e-13)


def test_a_complex_leaf_is_refused_by_name():
    told = r"`a` of Coupled must be real, got .*; give its real and its imaginary part"
    system = eqx.tree_at(lambda s: s.a, coupled(), jnp.asarray(1j * MATRIX))
    with pytest.raises(ValueError, match=told):
        jf.solve(system, jnp.zeros(2), 0.0, 1.0, 0.1)
    with pytest.raises(ValueError, match=told):
        jf.lyapunov_spectrum(system, jnp.zeros(2))
