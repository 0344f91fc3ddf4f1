"""Loops of known length as native code: all passes in one call, with what is carried from one to the next in registers.

A loop written with `jax.lax.scan` calls native code once per pass, and XLA computes what surrounds it: control laws,
costs, and the sums of reverse mode. Here a whole program is traced, differentiated as it may be, and each of its scans
becomes one function whose body is a graph, native code that it calls included.
"""

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jax.interpreters.partial_eval import dce_jaxpr

from mjx_study.graph.c import NotWrittenError, source_of
from mjx_study.graph.function import Passes, ScalarFunction, bind_whole, run, scan_inputs
from mjx_study.graph.native import POSTPONED, NativeFunction, count_left, native_identity, switched_on
from mjx_study.graph.nodes import ScalarGraph, TooLargeError, constants

MOST_OPERATIONS: Final = 4_000
"""Maximum number of scalar operations in a pass. Longer ones spend their time in the native code that they call, which
programs share, and registers do not suffice for what surrounds it."""
MOST_CARRIED: Final = 500
"""Maximum number of scalars from one pass to the next."""

AS_THEY_ARE: Final = ContextVar("as they are", default=False)
"""Switch: functions `with_native_scans` are traced as if they were without."""


def with_native_scans(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function of pytrees of arrays with its scans as native code where possible; to be batched, not
    differentiated."""

    def program(*arguments: Any) -> Any:
        if native_identity() is None or AS_THEY_ARE.get():
            return function(*arguments)
        with switched_on(POSTPONED):
            closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        leaves, structure = jax.tree.flatten(shape)
        jaxpr, _ = dce_jaxpr(closed.jaxpr, [True] * len(leaves), instantiate=True)
        outputs = _evaluated(ClosedJaxpr(jaxpr, closed.consts), jax.tree.leaves(arguments))
        return structure.unflatten(outputs)

    return program


def _evaluated(closed: ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
    """Outputs of a program, with its scans replaced."""
    jaxpr = closed.jaxpr
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*closed.consts, *inputs), strict=True))

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else values[atom]

    for equation in jaxpr.eqns:
        given = [read(atom) for atom in equation.invars]
        inner = equation.params.get("jaxpr")
        if equation.primitive.name == "scan" and (loop := _native_scan(equation, given)) is not None:
            outputs = loop
        elif equation.primitive.name in ("jit", "pjit") and isinstance(inner, ClosedJaxpr) and _scans(inner.jaxpr):
            outputs = _evaluated(inner, given)
        else:
            _build(equation)
            outputs = bind_whole(equation, given)
        values |= zip(equation.outvars, outputs, strict=True)
    return [read(atom) for atom in jaxpr.outvars]


def _native_scan(equation: Any, inputs: Sequence[Any]) -> Sequence[Any] | None:
    """Outputs of a scan as native code; None if it is to remain a scan."""
    parameters = equation.params
    num_consts, carried = map(len, scan_inputs(equation, inputs)[:2])
    body, avals = parameters["jaxpr"], [atom.aval for atom in equation.invars]
    wanted = [place for place, aval in enumerate(body.out_avals) if aval.size]  # XLA fails to transpose empty results
    fixed = [
        not aval.size or (place < num_consts and not isinstance(each, Tracer) and aval.size <= MOST_OPERATIONS)
        for place, (each, aval) in enumerate(zip(inputs, avals, strict=True))
    ]
    if not wanted or not parameters["length"]:
        return None
    if any(jnp.issubdtype(aval.dtype, jax.dtypes.extended) for aval in avals):
        count_left("loop over random keys")
        return None
    try:
        function, used = _body(body, inputs, fixed, wanted, range(num_consts, num_consts + carried))
        passes = Passes(
            num_consts=sum(place < num_consts for place in used),
            num_carry=sum(place < carried for place in wanted),
            length=parameters["length"],
            reverse=parameters["reverse"],
        )
        source = source_of(function, jax.default_backend(), passes)
    except NotWrittenError as error:
        count_left(f"loop with {error}")
        return None
    except TooLargeError:
        count_left(f"loop of more than {MOST_OPERATIONS} operations, or {MOST_CARRIED} values from pass to pass")
        return None

    def scan(*some: Any) -> list[Any]:
        given = dict(zip(used, some, strict=True))
        every = [
            inputs[place] if known and aval.size else given.get(place, jnp.zeros(aval.shape, aval.dtype))
            for place, (known, aval) in enumerate(zip(fixed, avals, strict=True))
        ]
        outputs = bind_whole(equation, every)
        return [outputs[place] for place in wanted]

    native = NativeFunction(lambda: source, *passes.avals(function), lambda: scan)
    native.begun()
    found = dict(zip(wanted, native(*(jnp.asarray(inputs[place], avals[place].dtype) for place in used)), strict=True))
    outputs = (atom.aval for atom in equation.outvars)
    return [found.get(place, jnp.zeros(aval.shape, aval.dtype)) for place, aval in enumerate(outputs)]


def _body(
    closed: Any, inputs: Sequence[Any], fixed: Sequence[bool], wanted: Sequence[int], carried: range
) -> tuple[ScalarFunction, list[int]]:
    """Body of a scan as a graph of some of its outputs, and the places of the inputs that it has.

    Args:
        fixed: whether each input is a constant.
        carried: places of what is carried, which it has in any case.
    """
    graph = ScalarGraph(2 * MOST_OPERATIONS, values_only=True)
    given = []
    for place, (each, known, aval) in enumerate(zip(inputs, fixed, closed.in_avals, strict=True)):
        value = each if aval.size else np.zeros(aval.shape, aval.dtype)
        given.append(constants(value) if known else graph.fresh("input", aval.shape, aval.dtype))
        if not known and place < carried.start:
            graph.arrays |= dict.fromkeys((node.number for node in given[-1].flat), place)
    outputs = run(graph, closed, given)
    free = [place for place, known in enumerate(fixed) if not known]
    function = ScalarFunction(
        graph,
        [given[place] for place in free],
        [outputs[place] for place in wanted],
        [closed.out_avals[place] for place in wanted],
        None,
    )
    if function.size > MOST_OPERATIONS or sum(given[place].size for place in carried) > MOST_CARRIED:
        raise TooLargeError
    used = {free[at] for at in function.used}
    places = [place for place in free if place in used or place in carried]
    return function.of([free.index(place) for place in places]), places


def _inside(equation: Any) -> list[Jaxpr]:
    """Programs that an operation calls."""
    found = []
    for each in jax.tree.leaves(equation.params, is_leaf=lambda leaf: isinstance(leaf, ClosedJaxpr | Jaxpr)):
        found += [each.jaxpr] if isinstance(each, ClosedJaxpr) else [each] if isinstance(each, Jaxpr) else []
    return found


def _scans(jaxpr: Jaxpr) -> bool:
    """Whether a program has a scan, in programs that it calls, too."""
    return any(each.primitive.name == "scan" or any(map(_scans, _inside(each))) for each in jaxpr.eqns)


def _build(equation: Any) -> None:
    """Begin to build the native code that an operation calls, in the programs that it calls, too."""
    if equation.primitive.name == "native":
        equation.params["function"].begun()
    for jaxpr in _inside(equation):
        for each in jaxpr.eqns:
            _build(each)
