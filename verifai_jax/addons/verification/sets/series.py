"""Taylor series of the solutions of a differential equation, on sets.

    rates = Rates(program, order=4)                     # of a time and a state, as JAX traced it
    rates(interpreter, shared, [time, *state], 3)[k][i] # set of the k-th coefficient of rate i

The operations of the rates become nodes, each once. Products are convolutions, and coefficients of
a function follow from its derivative, more nodes: `k y[k] = sum_i i x[i] f'(x)[k - i]`.

Source: R. Moore, Methods and applications of interval analysis, SIAM (1979), section 3.4.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from verifai_jax.addons.verification.sets.elementwise import levelled
from verifai_jax.addons.verification.sets.form import Form, add, negative, product, scaled
from verifai_jax.addons.verification.sets.functions import FUNCTIONS, quotient
from verifai_jax.addons.verification.sets.interpreter import Equation, Interpreter, Program
from verifai_jax.addons.verification.sets.values import MissingRule, Value, constant
from verifai_jax.core.compute.jaxprs import called, run_through
from verifai_jax.core.user_code.user_errors import source_line

CURVED = frozenset({
    "acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cos", "cosh", "erf", "erfc", "exp",
    "expm1", "integer_pow", "log", "log1p", "logistic", "pow", "rsqrt", "sin", "sinh", "sqrt",
    "square", "tan", "tanh",
})  # fmt: skip
"""Functions with derivatives of all orders, which JAX knows."""
SLOPES: dict[str, Callable[[Array], Array]] = {
    "asinh": lambda x: jax.lax.rsqrt(1 + x * x), "erf": lambda x: 2 / np.pi**0.5 * jnp.exp(-x * x),
    "erfc": lambda x: -2 / np.pi**0.5 * jnp.exp(-x * x),
}  # fmt: skip
"""Derivatives in one formula, for which JAX 0.12 has branches by the size of the number."""
LINEAR = frozenset({
    "add", "add_any", "broadcast_in_dim", "concatenate", "copy", "convert_element_type", "cumsum",
    "neg", "reduce_sum", "reshape", "rev", "slice", "split", "squeeze", "stack", "sub", "transpose",
    "unstack",
})  # fmt: skip
"""Operations that are linear in all of their operands together."""
SMOOTH = CURVED | LINEAR | {"div", "dot_general", "mul"}
CHOOSING = {"select_n": (1, None), "dynamic_slice": (0, 1), "gather": (0, 1)}
"""Operations that are linear in these operands alone; the others choose among them."""


class Node(NamedTuple):
    """One result of an operation, or without one an input; it may depend on time and state."""

    step: Equation | None
    operands: tuple[int, ...]
    number: int
    varies: bool


class Rates:
    """The rates of a differential equation as nodes, with coefficients up to an order.

    Its program has the shared operands, which do not vary, as constants; time and state are inputs.

    **Raises:** `MissingRule` for rates that are not smooth, with the operation and its line.
    """

    def __init__(self, program: Program, order: int) -> None:
        self.order, self.nodes, self.numbers = order, list[Node](), dict[int, tuple]()
        self._known: dict[tuple, list[int]] = {}
        self._slopes: dict[int, list[tuple[int, int]]] = {}
        shared = [self._new(None, (), i, False) for i in range(len(program.constvars))]
        self.moving = [self._new(None, (), i, True) for i in range(len(program.invars))]
        self.results = run_through(program, shared, self.moving, self._literal, self._added)
        self.need = dict[int, int]()
        """Greatest orders of nodes that coefficients of the results need."""
        asked = [(result, order) for result in self.results]
        while asked:
            node, depth = asked.pop()
            if depth <= self.need.get(node, -1):
                continue
            self.need[node] = depth
            asked += [(operand, depth) for operand in self.nodes[node].operands]
            asked += [(slope, depth - 1) for _, slope in self.slopes(node)] if depth else []

    def _new(self, step: Equation | None, operands: tuple, number: int, varies: bool) -> int:
        self.nodes.append(Node(step, operands, number, varies))
        return len(self.nodes) - 1

    def _number(self, value: ArrayLike, dtype: np.dtype) -> int:
        key = np.asarray(value).tobytes(), np.shape(value), str(dtype)
        if key not in self._known:
            self._known[key] = [self._new(None, (), -1, False)]
            self.numbers[self._known[key][0]] = value, dtype
        return self._known[key][0]

    def _through(self, closed: Program, operands: Sequence[int]) -> list[int]:
        """Return the results of a program; one without constants may be a `Jaxpr`."""
        consts = [self._number(c, np.asarray(c).dtype) for c in getattr(closed, "consts", ())]
        inner = getattr(closed, "jaxpr", closed)
        return run_through(inner, consts, operands, self._literal, self._added)

    def _literal(self, each: Any) -> int:
        return self._number(each.val, each.aval.dtype)

    def _added(self, step: Equation, operands: Sequence[int]) -> list[int]:
        inner, name = called(step), step.primitive.name
        if inner is not None:
            return self._through(inner, operands)
        if name == "integer_pow" and step.params["y"] == 1:
            return [*operands]
        for one, other in ((0, -1), (-1, 0)) if name == "mul" else ():
            if np.array_equal(self.numbers.get(operands[one], (0.0,))[0], 1.0):
                # What derivatives of functions multiply by.
                return [operands[other]]
        varies = [self.nodes[each].varies for each in operands]
        if name == "pow" and varies[1]:
            forms = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in step.invars]
            power = jax.make_jaxpr(lambda x, y: jnp.exp(y * jnp.log(x)))(*forms)
            return self._through(power, operands)
        first, last = CHOOSING.get(name, (0, None))
        choices = varies[:first] + ([] if last is None else varies[last:])
        real = all(jnp.issubdtype(out.aval.dtype, jnp.floating) for out in step.outvars)
        smooth = name in SMOOTH or (name in CHOOSING and not any(choices))
        if any(varies) and not (smooth and real):
            line = source_line(step.source_info.traceback)
            raise MissingRule(
                f"the dynamics apply {name} to the state or the time{f' ({line})' * bool(line)}, "
                "which is not smooth, or has no Taylor series here: continuous=True needs smooth "
                "dynamics; move switching and saturation into the controller"
            )
        if name == "square" or (name == "integer_pow" and step.params["y"] == 2):
            operands = [*operands, *operands]
        key = step.primitive, str(step.params), *operands
        if key not in self._known:
            self._known[key] = [
                self._new(step, tuple(operands), i, any(varies)) for i in range(len(step.outvars))
            ]
        return self._known[key]

    def _is_square(self, number: int) -> bool:
        step, operands, *_ = self.nodes[number]
        names = ("mul", "square", "integer_pow")
        return step is not None and step.primitive.name in names and operands[1:] == operands[:1]

    def slopes(self, number: int) -> list[tuple[int, int]]:
        """Return the operands of a function that vary, each with the derivative by it."""
        step, operands, _, varies = self.nodes[number]
        if step is None or not varies or step.primitive.name not in CURVED:
            return []
        if number not in self._slopes and not self._is_square(number):
            forms = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in step.invars]
            self._slopes[number] = []
            for i, operand in enumerate(operands):

                def slope(*values: Array, i: int = i) -> Array:
                    def of(x: Array) -> Array:
                        return step.primitive.bind(*values[:i], x, *values[i + 1 :], **step.params)

                    return jax.jvp(of, (values[i],), (jnp.ones_like(values[i]),))[1]

                if self.nodes[operand].varies:
                    program = jax.make_jaxpr(SLOPES.get(step.primitive.name, slope))(*forms)
                    (found,) = self._through(program, operands)
                    self._slopes[number].append((operand, found))
        return self._slopes.get(number, [])

    def __call__(
        self, t: Interpreter, shared: Sequence[Value], moving: Sequence[Form], order: int
    ) -> list[list[Any]]:
        """Return the coefficients of the rates at a time and a state, from order 0 on."""
        known: dict[tuple[int, int], Value | None] = {}
        for number, node in enumerate(self.nodes):
            if number in self.numbers:
                known[number, 0] = constant(*self.numbers[number])
            elif node.step is None:
                known[number, 0] = (moving if node.varies else shared)[node.number]
        one = constant(np.ones(moving[0].shape), moving[0].dtype)

        def coefficient(number: int, k: int) -> Any:
            """Return a coefficient, None if it is zero."""
            return known[number, k] if self.nodes[number].varies or not k else None

        def zeros(number: int) -> Any:
            like = coefficient(number, 0)
            return constant(np.zeros(like.shape), like.dtype)

        def added(number: int, k: int) -> Value | None:
            (step, operands, output, _), find = self.nodes[number], coefficient
            assert step is not None
            name, square = step.primitive.name, self._is_square(number)
            if not k:
                first = [find(each, 0) for each in operands]
                return FUNCTIONS["square"](first[0]) if square else t.step(step, first)[output]
            a, b = ([find(operands[at], i) for i in range(k + 1)] for at in (0, -1))
            if square:
                found = _dotted(a[: (k + 1) // 2], b[: k // 2 : -1])
                middle = None if k % 2 else a[k // 2]
                middle = middle and FUNCTIONS["square"](middle)
                return _sum([found and scaled(found, np.array(2.0)), middle])
            if name == "mul":
                return _dotted(a, b[::-1])
            if name == "dot_general":
                pairs = [(x, y) for x, y in zip(a, b[::-1], strict=True) if x and y]
                return _sum([t.step(step, [*pair])[0] for pair in pairs])
            if name == "div":
                rest = _dotted([find(number, i) for i in range(k)], b[:0:-1])
                rest = _sum([a[k], rest and negative(rest)])
                return rest and quotient(*levelled([rest, b[0]]))
            if name in CURVED:
                pairs = [(*both, i) for both in self.slopes(number) for i in range(1, k + 1)]
                moves = [(find(each, i), np.array(i / k)) for each, _, i in pairs]
                rates = [find(slope, k - i) for _, slope, i in pairs]
                return _dotted([x and scaled(x, share) for x, share in moves], rates)
            if name in ("add", "add_any", "sub"):
                return _sum([a[k], negative(b[k]) if name == "sub" and b[k] else b[k]])
            moved = range(len(operands))[slice(*CHOOSING.get(name, (0, None)))]
            if not any(find(operands[i], k) for i in moved):
                return None
            return t.step(step, [
                (find(each, k) or zeros(each)) if i in moved else find(each, 0)
                for i, each in enumerate(operands)
            ])[output]  # fmt: skip

        for k in range(order + 1):
            if k:
                known[self.moving[0], k] = one if k == 1 else None
                for number, result in zip(self.moving[1:], self.results, strict=True):
                    rate = coefficient(result, k - 1)
                    known[number, k] = rate and scaled(rate, np.array(1 / k))
            for number, node in enumerate(self.nodes):
                wanted = self.need.get(number, -1) - self.order + order >= k
                if node.step is not None and wanted and (node.varies or not k):
                    known[number, k] = added(number, k)
        orders = range(order + 1)
        return [[coefficient(i, k) or zeros(i) for i in self.results] for k in orders]


def _dotted(first: Sequence[Any], second: Sequence[Any]) -> Form | None:
    """Return the sum of products of two rows, in which None is zero."""
    pairs = [levelled([a, b]) for a, b in zip(first, second, strict=True) if a and b]
    return _sum([product(a, b, narrow=False) for a, b in pairs])


def _sum(terms: Sequence[Any]) -> Form | None:
    """Return the sum of a row."""
    forms = [term for term in terms if term is not None]
    return functools.reduce(lambda a, b: add(*levelled([a, b])), forms) if forms else None
