"""Derivatives of graphs are JAX's derivatives of the functions, at kinks and special values, too."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mjx_study.graph.differentiation import NotDifferentiableError, jacobian, pull, push
from mjx_study.graph.evaluation import evaluated
from mjx_study.graph.function import ScalarFunction, capture
from mjx_study.graph.linear_map import derivative, implicit_derivative, implicit_jacobian
from mjx_study.graph.native import native_summary
from mjx_study.graph.nodes import ELEMENTWISE, entries_of
from mjx_study.graph.operation import applied, computed
from mjx_study.graph.scalars import unrolled
from mjx_study.simulation.linear_algebra import solve_positive_definite
from tests.test_graph import descent
from tests.test_second_derivatives import COMPOSITIONS

Function = Callable[..., Any]
ROW = np.array([0.3, -1.2, 2.5])
SPECIAL = (0.0, -0.0, 1.0, -1.0, 0.5, 2.0, -2.5, 1e-200, 1e200, np.inf, -np.inf, np.nan)
PAIRS = [(a, b) for a in SPECIAL for b in (0.0, 1.0, -1.0, 2.0, 0.5, np.inf, np.nan)]
ONE = [(a,) for a in SPECIAL]


def bits(x: Any) -> Any:
    return lax.bitcast_convert_type(x, np.uint64)


OPERATIONS: dict[str, tuple[Function, list[tuple[float, ...]]]] = {
    **{
        name: (getattr(lax, name), ONE)
        for name in (
            *("abs", "acos", "asin", "atan", "ceil", "cos", "cosh", "erf", "exp", "expm1", "floor", "is_finite", "log"),
            *("log1p", "logistic", "neg", "round", "rsqrt", "sign", "sin", "sinh", "sqrt", "square", "tan", "tanh"),
        )
    },
    **{name: (getattr(lax, name), PAIRS) for name in ("add", "atan2", "div", "max", "min", "mul", "pow", "rem", "sub")},
    **{
        name: (lambda x, y, name=name: lax.select(getattr(lax, name)(x, y), x, 2 * y), PAIRS)
        for name in ("eq", "ge", "gt", "le", "lt", "ne")
    },
    "add_any": (lambda x, y: jax.vjp(lambda z: (z * 2, z * 3), x)[1]((y, x))[0], PAIRS),
    "and": (lambda x, y: jnp.where((x > 0) & (y > 0), x, y), PAIRS),
    "or": (lambda x, y: jnp.where((x > 0) | (y > 0), x, y), PAIRS),
    "xor": (lambda x, y: jnp.where((x > 0) ^ (y > 0), x, y), PAIRS),
    "not": (lambda x: jnp.where(~(x > 0), x, x**2), ONE),
    "clamp": (lambda x, y: lax.clamp(y, x, y + 1) + lax.clamp(-1.0, x, y) + lax.clamp(-1.0, x, 1.0), PAIRS),
    "convert_element_type": (lambda x: x.astype(int) * x.astype(jnp.float32).astype(float), ONE),
    "integer_pow": (lambda x: (x**3, x**2, x**-1, x**-2), ONE),
    "shift_left": (lambda x: jnp.where(bits(x) << np.uint64(12) > np.uint64(1 << 62), x, x**2), ONE),
    "shift_right_logical": (lambda x: jnp.where(bits(x) >> np.uint64(52) > np.uint64(1022), x, x**2), ONE),
    "select_n": (lambda x, y: (lax.select(x > y, x, jnp.sqrt(y)), lax.select_n(jnp.int32(x > 0), x * y, y)), PAIRS),
}


def captured(function: Function, *like: Any, most: int = 10_000) -> ScalarFunction:
    return capture(function, *(jax.ShapeDtypeStruct(np.shape(each), float) for each in like), most=most)


def value(function: ScalarFunction, *inputs: Any) -> Any:
    return jax.jit(evaluated(function))(*inputs)


def all_close(ours: Any, theirs: Any, rtol: float = 1e-13, atol: float = 0.0) -> None:
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, other, rtol=rtol, atol=atol)


def test_every_operation_is_here() -> None:
    assert set(OPERATIONS) == ELEMENTWISE


@pytest.mark.parametrize("name", sorted(OPERATIONS))
def test_operations_have_jaxs_derivative(name: str) -> None:
    """At ties and at the ends of the range as well, in both modes."""
    function, points = OPERATIONS[name]
    one = lambda *x: [each for each in jax.tree.leaves(function(*x)) if each.dtype == float]  # noqa: E731
    graph = captured(one, *points[0])
    operations = {each.operation.name for each in graph.needed if not isinstance(each.operation, str)}
    assert name in operations or name in ("is_finite", "not")
    places = tuple(range(len(points[0])))
    slope = derivative(graph, places)
    columns = jnp.asarray(points).T
    changes = jnp.linspace(0.5, 1.5, columns.size).reshape(columns.shape)
    ours = jax.jit(jax.vmap(evaluated(slope.push)))(*columns, *changes)
    theirs = jax.jit(jax.vmap(lambda x, change: jax.jvp(one, x, change)[1]))(tuple(columns), tuple(changes))
    all_close(ours, theirs)

    adjoints = [changes[0] + place for place in range(len(theirs))]
    ours = jax.jit(jax.vmap(evaluated(slope.transposed.push)))(*columns, *adjoints)

    def transposed(x: Any, adjoints: Any) -> list[Any]:
        """By forward mode over one argument at a time."""
        over = lambda place: jax.jvp(lambda y: one(*x[:place], y, *x[place + 1 :]), (x[place],), (1.0,))[1]  # noqa: E731
        return [sum(a * b for a, b in zip(adjoints, over(place), strict=True)) for place in places]

    rtol = 1e-6 if name == "convert_element_type" else 1e-13
    all_close(ours, jax.jit(jax.vmap(transposed))(tuple(columns), adjoints), rtol)


def test_what_a_selection_leaves_out_does_not_count_in_reverse_mode() -> None:
    """Where JAX's has NaN, since it multiplies infinite derivatives by zero."""

    def function(x: Any, y: Any) -> Any:
        root = jnp.where(x > 0, jnp.sqrt(x), y * x)
        quotient = jnp.where(y != 0, x / y, jnp.where(x > 2, jnp.log(x) * y, root))
        index = jnp.int32(x > 0) + jnp.int32(y > 0)
        shared = jnp.sqrt(jnp.abs(x))  # counts where different conditions hold, and none of them at 0
        first = jnp.where(x > 0, jnp.where(y > 0, shared, x), y)
        second = jnp.where(x > 0, jnp.where(x + y > 0, y, shared * y), x * y)
        third = jnp.where(y > 0, jnp.where(x == 0, x, jnp.where(x > 1, shared, y)), 2 * y)
        selected = lax.select_n(index, root + quotient, 1 / (x + y), jnp.arctan2(y, x))
        return root * y + quotient + selected + first + second * third

    pull = derivative(captured(function, 1.0, 1.0), (0, 1)).transposed.push
    reverse = jax.jit(jax.vmap(evaluated(pull)))
    points = np.array([[0, 0], [0, 1], [-1, 2], [3, 0], [1.5, 0.5], [2, -1], [-1, -1], [0, -2], [-2, 0]], float).T
    forward = jax.jit(jax.vmap(lambda *x: jax.jacfwd(function, (0, 1))(*x)))(*points)
    assert np.all(np.isfinite(forward))
    all_close(reverse(*points, np.ones(points.shape[1])), forward)
    broken = jax.vmap(jax.grad(function, (0, 1)))(*points)
    assert not np.all(np.isfinite(broken))


def test_conditions_cost_no_more_than_what_they_select() -> None:
    """A value that counts under two chains of conditions; to meet them one by one took 40 selections per value."""

    def function(x: Any, conditions: Any) -> Any:
        def chain(conditions: Any) -> Any:
            found = jnp.sin(x)
            for each in conditions:
                found = jnp.where(each > 0, found, 0.0)
            return found

        return jnp.sum(chain(conditions[0]) * chain(conditions[1]))

    values, depth = 30, 20
    pull = derivative(captured(function, np.ones(values), np.ones((2, depth))), (0,)).transposed.push
    assert pull.size < 10 * values + 10 * depth + 2 * values * depth


def rotation(x: Any) -> Any:
    """With what a step has: products, divisions, norms, branches, and a table."""
    axis = x / jnp.sqrt(jnp.sum(x**2))
    cross = jnp.cross(axis, jnp.array([0.0, 1.0, 0.0]))
    turned = jnp.where(x[0] > 0, jnp.cos(x[1]) * axis + jnp.sin(x[1]) * cross, axis * jnp.maximum(x[2], 0.1))
    table = jnp.arange(12.0).reshape(4, 3)
    return turned @ turned, jnp.outer(turned, axis)[jnp.array([0, 2])], table[jnp.argmax(x)] * x, jnp.cumsum(x)


def test_compositions_have_jaxs_derivative() -> None:
    function = captured(rotation, ROW)
    theirs = jax.jit(jax.jacfwd(rotation))
    slope = derivative(function, (0,))
    columns = jax.jit(jax.vmap(evaluated(slope.push), (None, 0), out_axes=-1))
    for point in (ROW, -ROW, ROW[::-1]):
        expected = np.concatenate([np.reshape(each, (-1, 3)) for each in theirs(point)])
        matrix = jacobian(function.graph, np.array(entries_of(function.outputs)), function.inputs[0])
        whole = ScalarFunction(function.graph, function.inputs, [matrix], [jax.typeof(expected)], None)
        all_close(value(whole, point), [expected], atol=1e-15)
        all_close(
            np.concatenate([np.reshape(each, (-1, 3)) for each in columns(point, np.eye(3))]), expected, atol=1e-15
        )


def test_what_is_always_zero_is_not_computed() -> None:
    """Of outputs that depend on one input each, and of constants."""
    function = captured(lambda x: (jnp.sin(x), jnp.ones(2)), ROW)
    matrix = jacobian(function.graph, np.array(entries_of(function.outputs)), function.inputs[0])
    nodes = [[at for at, each in enumerate(row) if each != 0] for row in matrix]
    assert nodes == [[0], [1], [2], [], []]
    slope = derivative(function, (0,))
    assert [each.operation.name for each in slope.push.needed if not isinstance(each.operation, str)].count("cos") == 3


def newton(x: Any) -> Any:
    return lax.while_loop(lambda y: jnp.abs(y**2 - x[0]) > 1e-12, lambda y: (y + x[0] / y) / 2, 1 + x[0])


REFUSED: dict[str, Function] = {
    "loop": newton,
    "eigh": lambda x: jnp.linalg.eigvalsh(jnp.diag(x) + 1)[0],
    "stop_gradient": lambda x: lax.stop_gradient(x)[0] * x[1],
}


@pytest.mark.parametrize("name", REFUSED)
def test_loops_and_whole_arrays_have_no_derivative_as_graphs(name: str) -> None:
    function = captured(REFUSED[name], ROW)
    with pytest.raises(NotDifferentiableError, match=name):
        derivative(function, (0,))
    adjoint = function.graph.fresh("input", (), np.dtype(float))
    with pytest.raises(NotDifferentiableError, match=name):
        pull(function.graph, function.outputs, function.inputs, [adjoint])
    with pytest.raises(NotDifferentiableError, match=name):
        push(function.graph, function.outputs, function.inputs, [function.inputs[0]])
    fixed = captured(lambda x, y, name=name: REFUSED[name](y) * x[1], ROW, ROW)
    all_close(value(derivative(fixed, (0,)).push, ROW, ROW, ROW), [REFUSED[name](ROW) * ROW[1]])


@pytest.mark.parametrize("name", ["eigh", "stop_gradient"])
def test_jax_differentiates_what_the_graph_does_not(name: str) -> None:
    function = captured(REFUSED[name], ROW)
    for mode in (jax.grad, jax.jacfwd):
        ours = jax.jit(mode(lambda x: computed(function, [x])[0] ** 2))(ROW)
        assert f"through XLA: derivative of {name}" in native_summary()
        all_close(ours, mode(lambda x: REFUSED[name](x) ** 2)(ROW))


COMPOSED: dict[str, Callable[[Function], Function]] = {"once": jax.jacrev, **COMPOSITIONS}


@pytest.mark.parametrize("name", COMPOSED)
def test_computed_graphs_are_functions_at_every_order(name: str) -> None:
    """In scans, checkpoints and batches; adjoints of what a batch shares add up."""
    advance = lambda x, y: (jnp.sin(x) * y[0] + x**2 / 4, jnp.argmax(x))  # noqa: E731
    graph = captured(advance, ROW, ROW[:2])

    def total(step: Function, x: Any) -> Any:
        def scanned(start: Any, y: Any) -> Any:
            return lax.scan(lambda z, _: (jax.checkpoint(step)(z, y)[0], None), start, length=3)[0]

        return jnp.sum(jax.vmap(scanned, (0, None))(jnp.stack([x, 2 * x, x / 3]), x[1:]) ** 2, axis=1)

    ours = jax.jit(COMPOSED[name](lambda x: total(lambda *inputs: computed(graph, inputs), x)))(ROW)
    all_close(ours, jax.jit(COMPOSED[name](lambda x: total(advance, x)))(ROW), 1e-12)


@pytest.mark.parametrize("name", COMPOSED)
def test_loops_of_known_length_are_functions_at_every_order(name: str) -> None:
    graph = captured(descent, ROW)
    assert any(node.operation == "loop" for node in graph.needed)
    total = lambda found: jnp.sin(found[0]) * found[0][::-1] ** 2  # noqa: E731
    ours = jax.jit(COMPOSED[name](lambda x: total(computed(graph, [x]))))(ROW)
    all_close(ours, jax.jit(COMPOSED[name](lambda x: total(descent(x))))(ROW), 1e-11, 1e-12)


def equations(x: Any, force: Any, root: Any) -> Any:
    """A symmetric system, nonlinear in its root, and what follows from both."""
    matrix = jnp.outer(x, x) + 2 * jnp.eye(3)
    gap = matrix @ root + root**3 - force * x
    return gap, jnp.sin(root) * x[0], root[:1] * force


def solved(x: Any, force: Any) -> Any:
    """The root, by Newton steps enough, which JAX differentiates."""
    root = jnp.zeros(3)
    for _ in range(12):
        gap = lambda root: equations(x, force, root)[0]  # noqa: E731
        root = root - jnp.linalg.solve(jax.jacfwd(gap)(root), gap(root))
    return [*equations(x, force, root)[1:], root]


def test_the_implicit_derivative_is_that_of_the_loop() -> None:
    function, force = captured(equations, ROW, 1.0, ROW), jnp.array(0.8)
    root = solved(ROW, force)[-1]
    expected = jax.jit(jax.jacfwd(solved, argnums=(0, 1)))(ROW, force)
    slope = implicit_derivative(function, (0, 1), solve_positive_definite)
    along = lambda *changes: applied(slope, [ROW, force, root], changes)  # noqa: E731
    change = (jnp.array([0.4, -0.3, 1.0]), jnp.array(0.7))
    through = [np.asarray(over_x) @ change[0] + np.asarray(over_force) * change[1] for over_x, over_force in expected]
    all_close(along(*change), through, 1e-11)
    adjoints = [jnp.cos(each) for each in through]
    back = jax.jit(lambda adjoints: jax.linear_transpose(along, *change)(adjoints))(adjoints)
    of_x = sum(adjoint @ np.asarray(over_x) for adjoint, (over_x, _) in zip(adjoints, expected, strict=True))
    of_force = sum(adjoint @ np.asarray(over) for adjoint, (_, over) in zip(adjoints, expected, strict=True))
    all_close(back, [of_x, of_force], 1e-11)
    (matrix,) = computed(implicit_jacobian(function, (0,), solve_positive_definite), [ROW, force, root])
    all_close(matrix, np.concatenate([over_x for over_x, _ in expected]), 1e-11)


def test_changes_of_an_empty_array_have_its_type() -> None:
    """As of the activations of a model without actuator dynamics, in 32 bits."""
    given = jnp.ones(2, jnp.float32), jnp.zeros(0, jnp.float32)
    function = partial(unrolled, lambda x, empty: (x * x, empty))
    found = jax.jvp(function, given, given)[1], jax.vjp(function, *given)[1](given)
    assert {each.dtype for each in jax.tree.leaves(found)} == {np.dtype("float32")}
