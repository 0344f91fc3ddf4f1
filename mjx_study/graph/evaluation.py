"""Evaluate graphs of scalars by JAX operations."""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import jaxpr_as_fun

from mjx_study.graph.function import ScalarFunction, array_of, bind_whole
from mjx_study.graph.nodes import LoopBody, Node


def evaluated(function: ScalarFunction) -> Callable[..., list[jax.Array]]:
    """Return a function of the inputs that computes the leaves of the result, one scalar operation after the other."""

    def program(*inputs: jax.Array) -> list[jax.Array]:
        values: dict[int, Any] = {}
        for array, nodes in zip(inputs, function.inputs, strict=True):
            values |= {node.number: array[index] for index, node in np.ndenumerate(nodes)}
        _emit(function.needed, values)
        return [
            array_of([values[each.number] if isinstance(each, Node) else each for each in output.flat], aval)
            for output, aval in zip(function.outputs, function.avals, strict=True)
        ]

    return program


def written_out(function: ScalarFunction) -> Callable[..., list[jax.Array]]:
    """`evaluated` as a program, which JAX batches and differentiates once for all programs that use it."""
    return jax.jit(jaxpr_as_fun(jax.make_jaxpr(evaluated(function))(*function.types)))


def _emit(nodes: Iterable[Node], values: dict[int, Any]) -> None:
    """Compute nodes with JAX, arguments first, and add them to `values`."""
    for node in nodes:
        if node.number in values:
            continue
        arguments = [values[each.number] if isinstance(each, Node) else each for each in node.arguments]
        match node.operation:
            case "output":
                place, index = node.parameters
                found = arguments[0][place][index]
            case "table":
                found = jnp.asarray(node.parameters)[arguments[0]]
            case "whole":
                equation, avals = node.parameters
                left = iter(arguments)
                arrays = [array_of(itertools.islice(left, math.prod(aval.shape)), aval) for aval in avals]
                found = bind_whole(equation, arrays)
            case "loop":
                found = _emit_loop(node, arguments, values)
            case primitive if node.parameters:
                found = primitive.bind(*arguments, **node.parameters)
            case primitive:  # that rules add: JAX's functions supply the parameters of the installed version
                name = primitive.name
                function = getattr(lax, f"bitwise_{name}" if name in ("and", "not", "or") else name, primitive.bind)
                found = function(*arguments)
        values[node.number] = found


def _emit_loop(node: Node, arguments: list[Any], values: dict[int, Any]) -> Any:
    body: LoopBody = node.parameters
    fixed = {each.number: values[each.number] for each in body.fixed}

    def at(carry: Sequence[Any], outputs: Sequence[Any]) -> list[Any]:
        local = fixed | {each.number: value for each, value in zip(body.carried, carry, strict=True)}
        _emit(body.inside, local)
        return [local[each.number] if isinstance(each, Node) else jnp.asarray(each) for each in outputs]

    start = [jnp.asarray(each) for each in arguments[: len(body.carried)]]
    if body.length is not None:
        return lax.fori_loop(0, body.length, lambda _, carry: at(carry, body.after), start)
    return lax.while_loop(lambda carry: at(carry, [body.again])[0], lambda carry: at(carry, body.after), start)
