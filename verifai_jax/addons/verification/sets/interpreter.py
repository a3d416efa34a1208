"""The interpreter: a program that JAX traced, evaluated with sets, many boxes at once.

    values = Interpreter(boxes=512, features=3).closed(jaxpr, inputs)    # or `MissingRule`

The tables of `elementwise.py`, `arrays.py` and `control_flow.py` define the operations by the names
of JAX's primitives.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias
from weakref import WeakKeyDictionary

import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.verification.sets.values import MissingRule, Value, constant
from verifai_jax.addons.verification.sets.whole import Whole
from verifai_jax.core.compute.jaxprs import called, run_through
from verifai_jax.core.user_code.user_errors import source_line

Params: TypeAlias = dict[str, Any]
Equation: TypeAlias = Any
"""A step of a program, `jax.core.JaxprEqn`."""
Program: TypeAlias = Any
"""A `Jaxpr` or a `ClosedJaxpr`."""
Rule: TypeAlias = Callable[["Interpreter", Equation, list[Value]], list[Value]]
RULES: dict[str, Rule] = {}
"""What each primitive does with sets, by its name."""
Shortcut: TypeAlias = Callable[["Interpreter", Program, list[Value]], list[Value] | None]
SHORTCUTS: dict[str, Shortcut] = {}
"""What functions do with sets as a whole, by the name of their call; None to go inside."""
_CONSTANTS: WeakKeyDictionary[Program, tuple[list[Value], dict[int, Value]]] = WeakKeyDictionary()
"""The constants of programs as sets, and the numbers in them by identity: those of all batches."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Register a rule for primitives with these names."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, function))
        return function

    return register


class Interpreter:
    """Evaluates programs with sets, for a batch of boxes and so many symbols of features."""

    def __init__(self, boxes: int, features: int) -> None:
        self.boxes, self.features = boxes, features
        # Once 32 MB are freed, which nobody touched, the C library keeps what arrays leave, and
        # does not spend a third of the time on new pages of zeros.
        np.empty(2**22 - 2**12)
        self.latest: tuple[Any, ...] | None = None
        """The last step of a differential equation: what it was made of, and its results."""

    def __call__(self, program: Program, inputs: Sequence[Value]) -> list[Value]:
        """Evaluate a traced program; what is not defined is bounded by (-inf, inf).

        **Raises:** `MissingRule` for an operation without a rule, with its name and its line.
        """
        with np.errstate(all="ignore"):
            return self.closed(program, inputs)

    def closed(self, program: Program, inputs: Sequence[Value]) -> list[Value]:
        """Evaluate a program with its constants, or one without constants."""
        inner = getattr(program, "jaxpr", program)
        if (found := _CONSTANTS.get(program)) is None:
            pairs = zip(inner.constvars, getattr(program, "consts", ()), strict=True)
            known = [constant(value, variable.aval.dtype) for variable, value in pairs]
            found = _CONSTANTS[program] = known, {}

        def literal(each: Any) -> Value:
            if id(each) not in found[1]:
                found[1][id(each)] = constant(each.val, each.aval.dtype)
            return found[1][id(each)]

        return run_through(inner, found[0], inputs, literal, self.step)

    def step(self, step: Equation, inputs: list[Value]) -> list[Value]:
        """Evaluate one operation."""
        name = step.primitive.name
        if (inner := called(step)) is not None:
            short = SHORTCUTS.get(step.params.get("name", name))
            results = None if short is None else short(self, inner, inputs)
            return self.closed(inner, inputs) if results is None else results
        found = RULES.get(name)
        if found is None:
            return self.concrete(step, inputs)
        try:
            results = found(self, step, inputs)
            for value, out in zip(results, step.outvars, strict=True):
                form = out.aval
                if value.shape != form.shape or value.dtype != form.dtype:
                    raise NotImplementedError(f"a result of type {form.str_short()}")
            return results
        except MissingRule:
            raise
        except NotImplementedError as error:
            raise MissingRule(f"{error}, by the operation {name}{_where(step)}") from error

    def concrete(self, step: Equation, inputs: list[Value]) -> list[Value]:
        """Evaluate by JAX an operation on integers equal for all boxes, or raise `MissingRule`."""
        arrays = [v.common if isinstance(v, Whole) else None for v in inputs]
        forms = [out.aval.dtype for out in step.outvars]
        exact = all(jnp.issubdtype(f, jnp.integer) or f == jnp.bool_ for f in forms)
        if not exact or any(array is None for array in arrays):
            name = step.primitive.name
            raise MissingRule(f"sets cannot go through the operation {name}{_where(step)}")
        results = step.primitive.bind(*map(jnp.asarray, arrays), **step.params)
        results = results if step.primitive.multiple_results else [results]
        return [constant(r, f) for r, f in zip(results, forms, strict=True)]


def _where(step: Equation) -> str:
    line = source_line(step.source_info.traceback)
    return f" ({line})" if line else ""
