"""JAX programs as nodes of ONNX graphs, for the primitives of detection.

All integers are int64 in the graph; unsigned words keep their 32 bits. If a function has several forms, the graph
contains the form of the platform that it names: the sort of TPUs, which needs no 64-bit words, and the loops of
CPUs, which stop early.
"""

import math
import string
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal
from jax.lax import GatherScatterMode

from fcos_lidar_jax.inference.onnx_graph import Graph, kind_of

Value = Any  # The name of a value in the graph, or a constant.
_WORD = 0xFFFFFFFF
_RULES: dict[str, Callable[..., Any]] = {}
_SAME = "abs add asinh cos div exp floor log max min mul neg pow sign sin sqrt sub"
_KINDS = {name: name.capitalize() for name in _SAME.split()} | {"eq": "Equal", "logistic": "Sigmoid"}
_KINDS |= {"ge": "GreaterOrEqual", "gt": "Greater", "le": "LessOrEqual", "lt": "Less"}
_KINDS |= {"le_to": "LessOrEqual", "lt_to": "Less"}  # differ for -0.0 and NaN only
_LOGIC = {"and": "And", "or": "Or", "xor": "Xor", "not": "Not"}
_REDUCTIONS = {"reduce_and": "Min", "reduce_max": "Max", "reduce_or": "Max", "reduce_sum": "Sum"}
_SCATTERS = {"scatter": "none", "scatter-add": "add", "scatter-max": "max"}


def translate(graph: Graph, program: ClosedJaxpr, inputs: Sequence[Value]) -> list[Value]:
    """Add the nodes of a program to a graph, and return its results.

    Raises:
        NotImplementedError: a primitive that has no rule.
    """
    values: dict[Any, Value] = dict(zip(program.jaxpr.constvars, program.consts, strict=True))
    values |= zip(program.jaxpr.invars, inputs, strict=True)

    def read(variable: Any) -> Value:
        return variable.val if isinstance(variable, Literal) else values[variable]

    for eqn in program.jaxpr.eqns:
        name = eqn.primitive.name
        _expect(name in _RULES, f"the primitive {name}")
        results = _RULES[name](graph, eqn, *map(read, eqn.invars))
        values |= zip(eqn.outvars, results if isinstance(results, list) else [results], strict=True)
    return [read(variable) for variable in program.jaxpr.outvars]


def _expect(has_rule: bool, found: str) -> None:
    if not has_rule:
        raise NotImplementedError(f"found {found}, which has no rule")


def _rule(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    def add(rule: Callable[..., Any]) -> Callable[..., Any]:
        _RULES.update(dict.fromkeys(names, rule))
        return rule

    return add


def _ints(values: Sequence[Any]) -> np.ndarray:
    return np.array(values, np.int64)


def _is_bool(variable: Any) -> bool:
    return variable.aval.dtype == np.bool_


def _cast(graph: Graph, x: Value, dtype: Any) -> str:
    return graph("Cast", x, to=graph.onnx.helper.np_dtype_to_tensor_dtype(kind_of(dtype)))


def _permuted(graph: Graph, x: Value, order: Sequence[int]) -> Value:
    return x if [*order] == sorted(order) else graph("Transpose", x, perm=[*map(int, order)])


def _as_word(graph: Graph, eqn: Any, x: Value) -> Value:
    """Cut an unsigned result to its 32 bits."""
    return graph("BitwiseAnd", x, _WORD) if eqn.outvars[0].aval.dtype == np.uint32 else x


@_rule("shift_left", "shift_right_arithmetic", "shift_right_logical")
def _shift(graph: Graph, eqn: Any, x: Value, bits: Value) -> Value:
    """By powers of two, because the operator for shifts takes no signed integers."""
    power = graph("Pow", 2, bits)
    if eqn.primitive.name == "shift_left":
        return _as_word(graph, eqn, graph("Mul", x, power))
    return graph("Div", graph("Sub", x, graph("Mod", x, power)), power)


@_rule("population_count")
def _population_count(graph: Graph, eqn: Any, x: Value) -> Value:
    for bits, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        halves = graph("BitwiseAnd", x, mask), graph("BitwiseAnd", graph("Div", x, 1 << bits), mask)
        x = graph("Add", *halves)
    return x


@_rule("convert_element_type")
def _convert(graph: Graph, eqn: Any, x: Value) -> Value:
    before, after = eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype
    x = x if kind_of(before) == kind_of(after) else _cast(graph, x, after)
    return x if before == after else _as_word(graph, eqn, x)


@_rule("bitcast_convert_type")
def _bitcast(graph: Graph, eqn: Any, x: Value) -> Value:
    bits = graph("BitCast", x, to=graph.onnx.TensorProto.INT32)
    return _as_word(graph, eqn, _cast(graph, bits, np.int64))


@_rule("select_n")
def _select(graph: Graph, eqn: Any, condition: Value, otherwise: Value, x: Value) -> Value:
    if not _is_bool(eqn.outvars[0]):
        return graph("Where", condition, x, otherwise)
    return graph("Or", graph("And", condition, x), graph("And", graph("Not", condition), otherwise))


@_rule("argmax")
def _argmax(graph: Graph, eqn: Any, x: Value) -> Value:
    x = _cast(graph, x, np.float32) if _is_bool(eqn.invars[0]) else x
    return graph("ArgMax", x, axis=eqn.params["axes"][0], keepdims=0)


@_rule("dot_general")
def _dot(graph: Graph, eqn: Any, x: Value, y: Value) -> Value:
    (contracted, batched), letters = eqn.params["dimension_numbers"], iter(string.ascii_letters)
    left, right = ([next(letters) for _ in v.aval.shape] for v in eqn.invars)
    for i, j in (*zip(*batched, strict=True), *zip(*contracted, strict=True)):
        right[j] = left[i]
    kept = [left[i] for i in batched[0]] + [
        letter for letter in left + right if (letter in left) != (letter in right)
    ]
    return graph("Einsum", x, y, equation=f"{''.join(left)},{''.join(right)}->{''.join(kept)}")


@_rule("iota")
def _iota(graph: Graph, eqn: Any) -> Value:
    shape, axis = eqn.outvars[0].aval.shape, eqn.params["dimension"]
    places = _cast(graph, graph("Range", 0, shape[axis], 1), eqn.outvars[0].aval.dtype)
    along = [size if i == axis else 1 for i, size in enumerate(shape)]
    return graph("Expand", graph("Reshape", places, _ints(along)), _ints(shape))


@_rule("broadcast_in_dim")
def _broadcast(graph: Graph, eqn: Any, x: Value) -> Value:
    shape = eqn.outvars[0].aval.shape
    sizes = dict(zip(eqn.params["broadcast_dimensions"], eqn.invars[0].aval.shape, strict=True))
    return graph("Expand", graph("Reshape", x, _ints([sizes.get(i, 1) for i in range(len(shape))])), _ints(shape))


@_rule("slice")
def _slice(graph: Graph, eqn: Any, x: Value) -> Value:
    starts, ends, steps = (eqn.params[name] for name in ("start_indices", "limit_indices", "strides"))
    axes = range(len(starts))
    return graph("Slice", x, *map(_ints, (starts, ends, axes, steps or [1] * len(starts))))


@_rule("dynamic_slice")
def _dynamic_slice(graph: Graph, eqn: Any, x: Value, *starts: Value) -> Value:
    sizes = _ints(eqn.params["slice_sizes"])
    start = graph("Concat", *(graph("Reshape", start, _ints([1])) for start in starts), axis=0)
    start = graph("Min", graph("Max", start, 0), _ints(eqn.invars[0].aval.shape) - sizes)
    return graph("Slice", x, start, graph("Add", start, sizes), _ints(range(len(sizes))))


@_rule("pad")
def _pad(graph: Graph, eqn: Any, x: Value, value: Value) -> Value:
    low, high, interior = zip(*eqn.params["padding_config"], strict=True)
    _expect(not any(interior), "a pad between elements")
    return graph("Pad", x, _ints([*low, *high]), value)


def _top(graph: Graph, x: Value, number: int, axis: int, *, largest: bool) -> list[str]:
    """Values and indices of the first in order; of equal values, the first."""
    return graph.several("TopK", x, _ints([number]), outputs=2, axis=axis, largest=int(largest))


@_rule("sort")
def _sort(graph: Graph, eqn: Any, *columns: Value) -> list[Value]:
    """One stable sort per key, the least significant first."""
    axis, order = eqn.params["dimension"], None
    for key, variable in reversed([*zip(columns, eqn.invars, strict=True)][: eqn.params["num_keys"]]):
        key = _cast(graph, key, np.int64) if _is_bool(variable) else key
        key = key if order is None else graph("GatherElements", key, order, axis=axis)
        _, place = _top(graph, key, variable.aval.shape[axis], axis, largest=False)
        order = place if order is None else graph("GatherElements", order, place, axis=axis)
    return [graph("GatherElements", x, order, axis=axis) for x in columns]


def _places(graph: Graph, indices: Value, sizes: Sequence[int], beyond: int | None) -> tuple[Value, Value]:
    """Row-major places of indices [..., k] in an array; ``beyond`` and False outside of it, unless None."""
    strides = [math.prod(sizes[i + 1 :]) for i in range(len(sizes))]
    place = graph("ReduceSum", graph("Mul", indices, _ints(strides)), _ints([-1]), keepdims=0)
    if beyond is None:
        return place, None
    inside = graph("And", graph("GreaterOrEqual", indices, 0), graph("Less", indices, _ints(sizes)))
    inside = graph("ReduceMin", inside, _ints([-1]), keepdims=0)
    return graph("Where", inside, place, beyond), inside


@_rule("gather")
def _gather(graph: Graph, eqn: Any, x: Value, indices: Value) -> Value:
    dims, shape, count = eqn.params["dimension_numbers"], eqn.invars[0].aval.shape, eqn.invars[1].aval.shape
    axes = [*dims.start_index_map, *dims.operand_batching_dims]
    order = [*axes, *(i for i in range(len(shape)) if i not in axes)]
    x = _permuted(graph, x, order)
    sizes = [shape[axis] for axis in order]
    taken = [eqn.params["slice_sizes"][axis] for axis in order]
    _expect(taken == [1] * len(axes) + sizes[len(axes) :], "a gather of windows")
    for axis in dims.start_indices_batching_dims:
        along = [count[axis] if i == axis else 1 for i in range(len(count))]
        own = graph("Expand", np.arange(count[axis]).reshape(along), _ints([*count[:-1], 1]))
        indices = graph("Concat", indices, own, axis=-1)
    fills = eqn.params["mode"] == GatherScatterMode.FILL_OR_DROP
    place, inside = _places(graph, indices, sizes[: len(axes)], 0 if fills else None)
    number = math.prod(sizes[: len(axes)])
    rows = graph("Gather", graph("Reshape", x, _ints([number, *sizes[len(axes) :]])), place, axis=0)
    if fills:
        inside = graph("Unsqueeze", inside, _ints(range(-(len(sizes) - len(axes)), 0)))
        rows = graph("Where", inside, rows, np.asarray(eqn.params["fill_value"], eqn.outvars[0].aval.dtype))
    outer = iter(range(len(count) - 1))
    offsets = {axis: len(count) - 1 + i for i, axis in enumerate(dims.offset_dims)}
    axes_of_result = range(len(eqn.outvars[0].aval.shape))
    return _permuted(graph, rows, [offsets[i] if i in offsets else next(outer) for i in axes_of_result])


@_rule(*_SCATTERS)
def _scatter(graph: Graph, eqn: Any, x: Value, indices: Value, updates: Value) -> Value:
    dims, shape, sizes = eqn.params["dimension_numbers"], eqn.invars[0].aval.shape, eqn.invars[2].aval.shape
    axes, windows = [int(axis) for axis in dims.scatter_dims_to_operand_dims], dims.update_window_dims
    order = [*axes, *(i for i in range(len(shape)) if i not in axes)]
    x = _permuted(graph, x, order)
    rest = [shape[axis] for axis in order[len(axes) :]]
    is_single = {*axes} == {*dims.inserted_window_dims} and [sizes[axis] for axis in windows] == rest
    _expect(is_single, "a scatter of windows")
    number, width = math.prod(shape[axis] for axis in axes), math.prod(rest)
    # Updates outside of the array go to an additional row.
    place, _ = _places(graph, indices, [shape[axis] for axis in axes], number)
    place = graph("Mul", graph("Reshape", place, _ints([-1, 1])), width)
    place = graph("Reshape", graph("Add", place, np.arange(width)), _ints([-1]))
    outer = [axis for axis in range(len(sizes)) if axis not in windows]
    updates = graph("Reshape", _permuted(graph, updates, [*outer, *windows]), _ints([-1]))
    more = np.zeros(width, eqn.outvars[0].aval.dtype)
    table = graph("Concat", graph("Reshape", x, _ints([-1])), more, axis=0)
    table = graph("ScatterElements", table, place, updates, axis=0, reduction=_SCATTERS[eqn.primitive.name])
    table = graph("Slice", table, _ints([0]), _ints([number * width]))
    table = graph("Reshape", table, _ints([shape[axis] for axis in order]))
    return _permuted(graph, table, [order.index(axis) for axis in range(len(shape))])


@_rule("scan")
def _scan(graph: Graph, eqn: Any, *inputs: Value) -> list[Value]:
    """Steps one after the other, as in a binary search."""
    fixed, number = eqn.params["num_consts"], eqn.params["num_carry"]
    _expect(len(inputs) == fixed + number and len(eqn.outvars) == number, "a scan over arrays")
    state = [*inputs[fixed:]]
    for _ in range(eqn.params["length"]):
        state = translate(graph, eqn.params["jaxpr"], [*inputs[:fixed], *state])
    return state


@_rule("while")
def _while(graph: Graph, eqn: Any, *inputs: Value) -> list[Value]:
    condition, body = (eqn.params[f"{name}_jaxpr"] for name in ("cond", "body"))
    split = eqn.params["cond_nconsts"], eqn.params["cond_nconsts"] + eqn.params["body_nconsts"]
    of_condition, of_body, state = inputs[: split[0]], inputs[split[0] : split[1]], inputs[split[1] :]
    kinds = [variable.aval for variable in eqn.outvars]
    iteration, again = jax.ShapeDtypeStruct((), np.int64), condition.out_avals[0]

    def step(_: str, __: str, *state: str) -> list[Value]:
        after = translate(graph, body, [*of_body, *state])
        return [*translate(graph, condition, [*of_condition, *after]), *after]

    inner = graph.inner(step, [iteration, again, *kinds], [again, *kinds])
    begins = translate(graph, condition, [*of_condition, *state])
    return graph.several("Loop", "", *begins, *state, outputs=len(kinds), body=inner)


@_rule("cond")
def _cond(graph: Graph, eqn: Any, index: Value, *inputs: Value) -> list[Value]:
    branches, kinds = eqn.params["branches"], [variable.aval for variable in eqn.outvars]

    def choose(first: int) -> list[Value]:
        if first == len(branches) - 1:
            return translate(graph, branches[first], inputs)
        this = graph.inner(lambda: translate(graph, branches[first], inputs), [], kinds)
        others = graph.inner(lambda: choose(first + 1), [], kinds)
        here = graph("Equal", index, first)
        return graph.several("If", here, outputs=len(kinds), then_branch=this, else_branch=others)

    return choose(0) if isinstance(index, str) else translate(graph, branches[int(index)], inputs)


@_rule(*_LOGIC, *_KINDS)
def _elementwise(graph: Graph, eqn: Any, *inputs: Value) -> Value:
    name = eqn.primitive.name
    kind = _KINDS.get(name) or ("" if _is_bool(eqn.invars[0]) else "Bitwise") + _LOGIC[name]
    return _as_word(graph, eqn, graph(kind, *inputs))


@_rule("cummax")
def _cummax(graph: Graph, eqn: Any, x: Value) -> Value:
    """Maxima over windows whose length doubles."""
    axis, length = _ints([eqn.params["axis"]]), eqn.invars[0].aval.shape[eqn.params["axis"]]
    for step in (1 << i for i in range((length - 1).bit_length())):
        first, rest = (graph("Slice", x, [0], [end], axis) for end in (step, length - step))
        x = graph("Max", x, graph("Concat", first, rest, axis=eqn.params["axis"]))
    return x


@_rule("stack")
def _stack(graph: Graph, eqn: Any, *parts: Value) -> Value:
    axis = eqn.params["axis"]
    return graph("Concat", *(graph("Unsqueeze", part, [axis]) for part in parts), axis=axis)


@_rule("split")
def _split(graph: Graph, eqn: Any, x: Value) -> list[str]:
    sizes = eqn.params["sizes"]
    return graph.several("Split", x, _ints(sizes), outputs=len(sizes), axis=eqn.params["axis"])


@_rule(*_REDUCTIONS)
def _reduce(graph: Graph, eqn: Any, x: Value) -> Value:
    return graph(f"Reduce{_REDUCTIONS[eqn.primitive.name]}", x, _ints(eqn.params["axes"]), keepdims=0)


_RULES |= {
    "clamp": lambda graph, eqn, low, x, high: graph("Min", graph("Max", x, low), high),
    "concatenate": lambda graph, eqn, *parts: graph("Concat", *parts, axis=eqn.params["dimension"]),
    "cumsum": lambda graph, eqn, x: graph("CumSum", x, eqn.params["axis"]),
    "custom_jvp_call": lambda graph, eqn, *inputs: translate(graph, eqn.params["call_jaxpr"], inputs),
    "integer_pow": lambda graph, eqn, x: graph("Pow", x, float(eqn.params["y"])),
    "is_finite": lambda graph, eqn, x: graph("Less", graph("Abs", x), np.inf),
    "jit": lambda graph, eqn, *inputs: translate(graph, eqn.params["jaxpr"], inputs),
    "log1p": lambda graph, eqn, x: graph("Log", graph("Add", x, 1.0)),
    "ne": lambda graph, eqn, *inputs: graph("Not", graph("Equal", *inputs)),
    "optimization_barrier": lambda graph, eqn, *inputs: [*inputs],
    "platform_index": lambda graph, eqn: np.array(0),  # the platform that is named first
    "rem": lambda graph, eqn, *inputs: graph("Mod", *inputs, fmod=1),
    "rsqrt": lambda graph, eqn, x: graph("Reciprocal", graph("Sqrt", x)),
    "square": lambda graph, eqn, x: graph("Mul", x, x),
    "stop_gradient": lambda graph, eqn, x: x,
    "top_k": lambda graph, eqn, x: _top(graph, x, eqn.params["k"], eqn.params["axis"], largest=True),
    "transpose": lambda graph, eqn, x: _permuted(graph, x, eqn.params["permutation"]),
} | dict.fromkeys(
    ("reshape", "squeeze"), lambda graph, eqn, x: graph("Reshape", x, _ints(eqn.outvars[0].aval.shape))
)
