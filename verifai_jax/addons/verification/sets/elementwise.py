"""Operations on single numbers, on sets of them."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.verification.sets import functions, whole
from verifai_jax.addons.verification.sets.form import Form, add, product, unknown
from verifai_jax.addons.verification.sets.interpreter import Equation, Interpreter, rule
from verifai_jax.addons.verification.sets.values import Value, as_form, as_whole, constant
from verifai_jax.addons.verification.sets.whole import Whole


def levelled(values: list[Any]) -> list[Any]:
    """Return operands of one shape: numbers that stand for arrays are repeated.

    All parts of a set need it, since a later sum counts the slopes as often as they stand there.
    """
    shapes = {value.shape for value in values}
    if len(shapes) == 1:
        return values
    shape = np.broadcast_shapes(*shapes)

    def widen(array: np.ndarray, leading: int) -> np.ndarray:
        front, missing = array.shape[:leading], len(shape) + leading - array.ndim
        wide = np.empty((*front, *shape), array.dtype)
        wide[...] = array.reshape(*front, *(1,) * missing, *array.shape[leading:])
        return wide

    return [value if value.shape == shape else value.moved(widen) for value in values]


_OF_TWO: dict[str, Callable[[Form, Form], Form]] = {
    "add": add, "add_any": add, "sub": lambda a, b: add(a, b, -1.0), "mul": product,
    "div": functions.quotient, "rem": functions.remainder, "max": functions.greater,
    "min": functions.lesser, "pow": functions.power, "atan2": functions.angle,
}  # fmt: skip


@rule(*_OF_TWO, "and", "or", "xor")
def _two(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    name = step.primitive.name
    if step.invars[0] is step.invars[1] and name == "mul" and isinstance(inputs[0], Form):
        return [functions.FUNCTIONS["square"](inputs[0])]
    a, b = levelled(inputs)
    if isinstance(a, Form):
        b = _as_real(b, a.dtype) if isinstance(b, Whole) else b
        return [_OF_TWO[name](a, b)]
    b = as_whole(b)
    # What all boxes share may wrap around, as the machine's numbers do.
    if name not in whole.OPERATIONS or (
        a.dtype != np.bool_ and a.common is not None and b.common is not None
    ):
        return t.concrete(step, inputs)
    return [whole.OPERATIONS[name](a, b)]


@rule(*functions.FUNCTIONS, "not")
def _one(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    (value,), name = inputs, step.primitive.name
    if isinstance(value, Form):
        return [functions.FUNCTIONS[name](value)]
    if name not in whole.FUNCTIONS:
        return t.concrete(step, inputs)
    return [whole.FUNCTIONS[name](value)]


@rule("integer_pow")
def _integer_power(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    (value,), exponent = inputs, int(step.params["y"])
    if isinstance(value, Whole):
        return t.concrete(step, inputs) if exponent < 0 else [whole.power(value, exponent)]
    return [functions.integer_power(value, exponent)]


@rule("round")
def _round(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    return [functions.nearest(as_form(inputs[0]), int(step.params["rounding_method"]) == 1)]


@rule("clamp")
def _clamp(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    low, x, high = levelled(inputs)
    if isinstance(x, Whole):
        x = whole.OPERATIONS["max"](x, as_whole(low))
        return [whole.OPERATIONS["min"](x, as_whole(high))]
    return [functions.lesser(functions.greater(x, as_form(low)), as_form(high))]


@rule("is_finite")
def _is_finite(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    low, high = as_form(inputs[0]).bounds()
    return [Whole.truth(np.isfinite(low) & np.isfinite(high), np.zeros(low.shape, bool))]


@rule(*whole.COMPARISONS)
def _compare(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    a, b = levelled(inputs)
    name = step.primitive.name
    if isinstance(a, Whole):
        b = as_whole(b)
        ends = (whole.exactly(np.subtract, *pair) for pair in ((a.low, b.high), (a.high, b.low)))
        return [whole.compared(name, *ends)]
    if step.invars[0] is step.invars[1]:
        # Only NaN differs from itself.
        low = np.where(unknown(*a.bounds()), -1, 0)
        return [whole.compared(name, low, -low)]
    return [whole.compared(name, *functions.difference(a, as_form(b)).bounds())]


@rule("lt_to", "le_to")
def _in_total_order(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    """Compare floats in an order in which zeros have signs: only different numbers are decided."""
    a, b = levelled(inputs)
    low, high = functions.difference(as_form(a), as_form(b)).bounds()
    return [Whole.truth(high < 0, low > 0)]


@rule("select_n")
def _select(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    which, *cases = levelled(inputs)
    return [select(as_whole(which), cases)]


def of_rank(which: Whole, like: Value) -> Whole:
    """Return one number for each box, with the rank of an array."""
    rank = (1,) * len(like.shape)
    return which.moved(lambda array, lead: array.reshape(*array.shape[:lead], *rank))


def select(which: Whole, cases: list[Value]) -> Value:
    """Select one of several cases by an index that may be undecided."""
    result = cases[0]
    for number, case in enumerate(cases[1:], 1):
        truth = which.low >= number
        maybe = (which.high >= number) & ~truth
        if isinstance(result, Form):
            result = functions.selected(truth, maybe, result, as_form(case))
        else:
            result = whole.selected(truth, maybe, as_whole(result), as_whole(case))
    return result


def _as_real(value: Whole, dtype: np.dtype) -> Form:
    low, high = value.low.astype(np.float64), value.high.astype(np.float64)
    exact = np.array_equal(low, low.astype(dtype)) and np.array_equal(high, high.astype(dtype))
    form = Form.between(low, high, dtype)
    if exact and max(np.abs(low).max(initial=0), np.abs(high).max(initial=0)) <= 2**24:
        return form
    return add(form, Form.constant(np.zeros(form.shape), dtype))


@rule("convert_element_type", "reduce_precision")
def _convert(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    (value,), dtype = inputs, np.dtype(step.outvars[0].aval.dtype)
    if jnp.issubdtype(dtype, jnp.floating):
        if isinstance(value, Whole):
            return [_as_real(value, dtype)]
        if value.dtype == dtype and step.primitive.name == "convert_element_type":
            return [value]
        if step.primitive.name == "reduce_precision":
            raise NotImplementedError("a reduction of precision")
        if dtype.itemsize >= value.dtype.itemsize:
            return [value.of_type(dtype)]
        return [add(value.of_type(dtype), Form.constant(np.zeros(value.shape), dtype))]
    if isinstance(value, Whole):
        if dtype == np.bool_:
            return [whole.compared("ne", np.sign(value.low), np.sign(value.high))]
        if value.is_point:
            exact = value.low.astype(dtype).astype(np.int64)
            return [Whole(exact, exact, dtype)]
        return [Whole(value.low, value.high, dtype)]
    low, high = value.bounds()
    if dtype == np.bool_:
        return [whole.compared("ne", np.sign(low), np.sign(high))]
    # Of what does not fit the machine may make any number, as of integers that leave their type.
    far = ~((np.abs(low) < whole.FAR) & (np.abs(high) < whole.FAR))
    ends = zip(whole.limits(np.dtype(np.int64)), (low, high), strict=True)
    first, last = (np.where(far, upper, np.trunc(end).astype(np.int64)) for upper, end in ends)
    return [Whole(first, last, dtype)]


@rule(
    "copy", "copy_p", "stop_gradient", "optimization_barrier", "device_put", "sharding_constraint"
)
def _same(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    return inputs


@rule("iota")
def _iota(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    shape, axis = step.params["shape"], step.params["dimension"]
    along = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return [constant(np.broadcast_to(along, shape), step.params["dtype"])]
