"""Loops of known length as native code: all passes in one call, with what is carried from one to the next in registers.

A loop written with `jax.lax.scan` calls native code once per pass, and XLA computes what surrounds it: control laws,
costs, and the sums of reverse mode. Here a whole program is traced, differentiated as it may be, and each of its scans
becomes one function whose body is a graph, native code that it calls included.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jax.interpreters.partial_eval import dce_jaxpr

from mjx_study.graph.c import NotWrittenError
from mjx_study.graph.function import Passes, ScalarFunction, bind_whole, interpreted, programs_in, run, scan_inputs
from mjx_study.graph.native import NativeFunction, count_left, native_identity, postponed, written
from mjx_study.graph.nodes import ScalarGraph, TooLargeError, constants
from mjx_study.graph.scalars import most_scalars

MOST_OPERATIONS: Final = 4_000
"""Maximum number of scalar operations in a pass. Longer ones spend their time in the native code that they call, which
programs share, and registers do not suffice for what surrounds it. On CPUs, code called in a loop that carries nothing
does not count: only vectors of samples for which it has anything to do compute it."""
MOST_CALLED: Final = 100_000
"""Maximum number of scalar operations in a pass with those of code that it calls."""
MOST_CARRIED: Final = 500
"""Maximum number of scalars from one pass to the next."""


def with_native_scans(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function of pytrees of arrays with its scans as native code where possible; to be batched, not
    differentiated."""

    def program(*arguments: Any) -> Any:
        if native_identity() is None:
            return function(*arguments)
        with postponed():
            closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        leaves, structure = jax.tree.flatten(shape)
        closed = _without_rules(closed)
        jaxpr, _ = dce_jaxpr(closed.jaxpr, [True] * len(leaves), instantiate=True)
        natively = partial(_natively, set())
        return structure.unflatten(interpreted(natively, ClosedJaxpr(jaxpr, closed.consts), jax.tree.leaves(arguments)))

    return program


def _without_rules(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The program with what functions with a derivative rule compute in place of calls of them.

    Nothing is then computed because a derivative might depend on it, and loops that copy their rows need not run.
    """
    return jax.make_jaxpr(lambda *inputs: interpreted(_inlined, closed, inputs))(*closed.in_avals)


def _inlined(equation: Any, inputs: Sequence[Any]) -> Sequence[Any]:
    """Outputs of an operation without such functions."""
    name, inner = equation.primitive.name, equation.params.get("jaxpr")
    if not isinstance(inner, ClosedJaxpr) or not (name == "ruled" or _has(inner.jaxpr, "ruled")):
        return bind_whole(equation, inputs)
    if name in ("ruled", "jit", "pjit"):
        return interpreted(_inlined, inner, inputs)
    if name != "scan":
        return bind_whole(equation, inputs)
    body = _without_rules(inner)
    outputs = list(bind_whole(equation.replace(params={**equation.params, "jaxpr": body}), inputs))
    *before, rows = scan_inputs(equation, inputs)
    known = dict(zip(body.jaxpr.invars[sum(map(len, before)) :], rows, strict=True))
    for place, atom in enumerate(body.jaxpr.outvars):
        if place >= len(before[1]) and not isinstance(atom, Literal) and atom in known:
            outputs[place] = known[atom]
    return outputs


def _natively(left: set[int], equation: Any, inputs: Sequence[Any]) -> Sequence[Any]:
    """Outputs of an operation, in which scans are replaced by native code.

    Args:
        left: lengths of the loops that XLA has kept. On CPUs it keeps what maps their rows, too: native code has rows
            in another order, and copying them takes longer than a small network.
    """
    name, inner = equation.primitive.name, equation.params.get("jaxpr")
    if name == "scan":
        length, maps = equation.params["length"], not scan_inputs(equation, inputs)[1]
        stays = maps and length in left and jax.default_backend() == "cpu"
        if not stays and (loop := _native_scan(equation, inputs)) is not None:
            return loop
        left.add(length)
    if name in ("jit", "pjit") and isinstance(inner, ClosedJaxpr) and _has(inner.jaxpr, "scan"):
        return interpreted(partial(_natively, left), inner, inputs)
    _build(equation)
    return bind_whole(equation, inputs)


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
    if equation.effects or any(jnp.issubdtype(aval.dtype, jax.dtypes.extended) for aval in avals):
        count_left("loop with side effects" if equation.effects else "loop over random keys")
        return None
    try:
        function, used = _body(body, inputs, fixed, wanted, range(num_consts, num_consts + carried))
        passes = Passes(
            num_consts=sum(place < num_consts for place in used),
            num_carry=sum(place < carried for place in wanted),
            length=parameters["length"],
            reverse=parameters["reverse"],
        )
        source = written(function, passes)
    except NotWrittenError as error:
        count_left(f"loop with {error}")
        return None
    except TooLargeError as error:
        count_left(f"loop of more than {str(error) or f'{MOST_OPERATIONS} operations'}")
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
    calls = not len(carried) and jax.default_backend() == "cpu"
    most = min(MOST_CALLED, most_scalars()) if calls else MOST_OPERATIONS
    graph = ScalarGraph(2 * most + sum(aval.size for aval in closed.in_avals), values_only=True)
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
    own, num_carried = function.size - graph.called, sum(given[place].size for place in carried)
    exceeded = {
        f"{MOST_CARRIED} values from pass to pass": num_carried > MOST_CARRIED,
        f"{MOST_OPERATIONS} operations": own > MOST_OPERATIONS,
        f"{most} operations, called code included": function.size > most,
    }
    for limit, is_exceeded in exceeded.items():
        if is_exceeded:
            raise TooLargeError(limit)
    used = {free[at] for at in function.used}
    places = [place for place in free if place in used or place in carried]
    return function.of([free.index(place) for place in places]), places


def _has(jaxpr: Jaxpr, name: str) -> bool:
    """Whether a program has an operation, in programs that it calls, too."""
    return any(each.primitive.name == name or any(_has(own, name) for own in programs_in(each)) for each in jaxpr.eqns)


def _build(equation: Any) -> None:
    """Begin to build the native code that an operation calls, in the programs that it calls, too."""
    if equation.primitive.name == "native":
        equation.params["function"].begun()
    for jaxpr in programs_in(equation):
        for each in jaxpr.eqns:
            _build(each)
