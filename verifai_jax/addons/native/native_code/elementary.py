"""Operations on single numbers: the C expression of each primitive of JAX.

A template has a pair of braces for each operand. Those of `OPERATORS` are C operators, which mix a
vector and a single number; those of `FUNCTIONS` are functions of the prelude, whose operands are
alike.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from verifai_jax.addons.native.native_code.values import Params, Untranslatable

OPERATORS = {
    "add": "{} + {}",
    "add_any": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "neg": "-{}",
    "square": "{0} * {0}",
    "and": "{} & {}",
    "or": "{} | {}",
    "xor": "{} ^ {}",
    "not": "~{}",
    "copy": "{}",
    "copy_p": "{}",
    "stop_gradient": "{}",
    "optimization_barrier": "{}",
    "rsqrt": "1.f / root({})",
    "logistic": "1.f / (1.f + exponential(-{}))",
    "exp2": "exponential({} * 0.693147180559945309f)",
}
"""C operators, of vectors and single numbers."""
FUNCTIONS = {
    "max": "greater({}, {})",
    "min": "lesser({}, {})",
    "abs": "absolute({})",
    "sign": "sign_of({})",
    "sqrt": "root({})",
    "floor": "rounded_down({})",
    "ceil": "rounded_up({})",
    "exp": "exponential({})",
    "log": "logarithm({})",
    "log1p": "logarithm1({})",
    "expm1": "exponential1({})",
    "tanh": "hyperbolic({})",
    "sin": "sine({})",
    "cos": "cosine({})",
    "tan": "tangent({})",
    "asin": "arcsine({})",
    "acos": "arccosine({})",
    "atan": "arctangent({})",
    "atan2": "angle({}, {})",
    "sinh": "sine_h({})",
    "cosh": "cosine_h({})",
    "asinh": "arcsine_h({})",
    "acosh": "arccosine_h({})",
    "atanh": "arctangent_h({})",
    "cbrt": "cube_root({})",
    "erf": "error_function({})",
    "erfc": "error_rest({})",
    "erf_inv": "inverse_error({})",
    "pow": "power({}, {})",
    "nextafter": "next_number({}, {})",
    "is_finite": "finite({})",
    "clamp": "lesser({2}, greater({0}, {1}))",
    "max of bounds": "greater_than_bound({}, {})",
    "min of bounds": "lesser_than_bound({}, {})",
    "clamp of bounds": "lesser_than_bound({2}, greater_than_bound({0}, {1}))",
}
"""Functions of the prelude, whose operands are all vectors or all single numbers. Bounds are
constants: the first operand, or the first and the last."""
COMPARISONS = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
NAMES = frozenset({
    *OPERATORS, *FUNCTIONS, *COMPARISONS, "lt_to", "le_to", "div", "rem", "round", "integer_pow",
    "select_n", "convert_element_type", "bitcast_convert_type", "shift_left",
    "shift_right_logical", "shift_right_arithmetic",
})  # fmt: skip
"""All primitives that compute each element of a result from the same elements of the operands."""
_FOLDED: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "neg": np.negative,
    "max": np.maximum,
    "min": np.minimum,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "not": np.bitwise_not,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "select_n": lambda which, *cases: cases[int(which)],
}


def fold(name: str, kind: str, values: list[np.generic]) -> Any:
    """Return the constant result of an operation on integers or truth values; None if unknown."""
    if name == "convert_element_type":
        return values[0] if isinstance(values[0], (np.integer, np.bool_)) or kind == "f" else None
    if name not in _FOLDED or not all(isinstance(v, (np.integer, np.bool_)) for v in values):
        if name == "select_n" and isinstance(values[0], (np.integer, np.bool_)):
            return _FOLDED[name](*values)
        return None
    with np.errstate(over="ignore"):
        return _FOLDED[name](*values)


def expression(name: str, params: Params, kinds: list[str], out: str) -> tuple[str, bool]:
    """Return the template of an operation, and whether its operands must have the same kind.

    **Arguments:**
    - `name`, `params`: those of the primitive.
    - `kinds`: the kinds of its operands.
    - `out`: the kind of its result.
    **Raises:** `Untranslatable` for an unknown primitive.
    """
    if name in OPERATORS:
        return OPERATORS[name], False
    if name in ("lt_to", "le_to"):
        sign = "<" if name == "lt_to" else "<="
        return (
            f"truth(in_order({{}}) {sign} in_order({{}}))"
            if kinds[0] == "f"
            else f"truth({{}} {sign} {{}})"
        ), False
    if name in COMPARISONS:
        return f"truth({{}} {COMPARISONS[name]} {{}})", False
    if name in FUNCTIONS:
        return FUNCTIONS[name], True
    if name == "div":
        return ("{} / {}", False) if out == "f" else ("quotient({}, {})", True)
    if name == "rem":
        return ("remainder_of({}, {})" if out == "f" else "residue({}, {})"), True
    if name == "round":
        nearest = int(params["rounding_method"]) == 1
        return ("nearest({})" if nearest else "rounded_away({})"), True
    if name == "integer_pow":
        return _power(int(params["y"])), False
    if name == "select_n":
        if kinds[0] != "b" or len(kinds) > 3:
            return _by_number(len(kinds) - 1), True
        return "choose({0}, {2}, {1})", True
    if name == "convert_element_type":
        return _conversion(kinds[0], out), False
    if name == "bitcast_convert_type":
        return {"f": "real_bits({})", "i": "whole_bits({})", "u": "to_bits({})"}[out], False
    if name.startswith("shift_"):
        return _shift(name, out), True
    raise Untranslatable(f"the operation {name}")


def _by_number(cases: int) -> str:
    text = f"{{{cases}}}"
    for case in range(cases - 2, -1, -1):
        text = f"choose(truth({{0}} == {case}), {{{case + 1}}}, {text})"
    return text


def _power(y: int) -> str:
    if y == 0:
        return "filled({0}, 1.f)"

    def product(n: int) -> str:
        if n == 1:
            return "{0}"
        half = product(n // 2)
        squared = f"({half} * {half})"
        return f"({squared} * {{0}})" if n % 2 else squared

    return product(y) if y > 0 else f"1.f / {product(-y)}"


def _conversion(source: str, out: str) -> str:
    if source == out:
        return "{}"
    if out == "b":
        return "truth({} != 0)" if source != "f" else "truth({} != 0.f)"
    if source == "b":
        return {"f": "to_real({} & 1)", "i": "({} & 1)", "u": "to_bits({} & 1)"}[out]
    if source == "f":
        return "to_whole({})" if out == "i" else "to_natural({})"
    return {"f": "to_real({})", "i": "whole_bits({})", "u": "to_bits({})"}[out]


def _shift(name: str, out: str) -> str:
    inside = "truth(to_bits({1}) < 32u)"
    if name == "shift_left":
        return f"choose({inside}, {{0}} << ({{1}} & 31), {{0}} & 0)"
    if name == "shift_right_logical":
        back = "whole_bits" if out == "i" else "to_bits"
        return f"choose({inside}, {back}(to_bits({{0}}) >> (to_bits({{1}}) & 31u)), {{0}} & 0)"
    if out == "u":
        raise Untranslatable("arithmetic shifts of natural numbers")
    return f"({{0}} >> choose({inside}, {{1}} & 31, {{1}} | 31))"
