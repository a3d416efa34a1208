"""The margins of a formula's leaves as operations on the numbers of a sample, in C or in Python.

front = margins(plan, sizes={"p": 3})
front.columns                   # (("x", None), ("p", 0), ...): what the numbers of a sample are
front.steps                     # Step("-", (0, 1)), ..., each of results before it
front.leaves                    # the results that are the margins
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from verifai_jax.mtl.evaluate import span_of
from verifai_jax.mtl.expression import Arithmetic, Component, Number, Signal
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.sampled import Operations, Sampled
from verifai_jax.mtl.semantics import boolean
from verifai_jax.mtl.streams import Plan, streams
from verifai_jax.mtl.tree import missing_case, postorder

FEW = 64
"""Powers by a whole number up to this one are products, as in JAX."""
ALONE = "\0"


class Step(NamedTuple):
    """One operation on earlier results.

    - `kind`: a kind of `Arithmetic`, or one of these: `column` and `count` (number `number` of the
      sample, or of the counted formulas), `number`, `power` (with the integer `number`), `truth`
      (1 or -1 by the sign; `number` is 1 if zero counts as true). Some remember: `delay` and `lag`
      give the input `number` samples ago, before that exists 0 or the first one; `latest` the
      second input at the latest sample at which the first was above 0, or at the first sample.
    """

    kind: str
    inputs: tuple[int, ...] = ()
    number: float = 0.0


class Margins(NamedTuple):
    """Operations that compute margins.

    - `columns`: the name of each signal, and the index of a component of a vector. With `apart` a
      signal that is a formula by itself has another column there, with `ALONE` before its name.
    - `leaves`: the index of the result that is each leaf's margin.
    - `counts`: for each counted formula its plan, its margins, and its columns among these.
    """

    columns: tuple[tuple[str, int | None], ...]
    steps: tuple[Step, ...]
    leaves: tuple[int, ...]
    counts: tuple[tuple[Plan, "Margins", tuple[int, ...]], ...]


def margins(plan: Plan, sizes: Mapping[str, int], apart: bool = False) -> Margins:
    """Return the signed margins of a plan's leaves; common parts occur once.

    **Arguments:**
    - `sizes`: number of components of the signals whose norm is used.
    - `apart`: whether a signal that is a formula by itself has a column of its own there, as a
      truth value is 1 or -1 there, and 1 or 0 in expressions.
    **Raises:** `ValueError` for a norm of a signal without a size.
    """
    made = _Builder(plan, sizes, apart)
    leaves = tuple(made.leaf(f, sign, plan.top == 1) for f, sign in plan.leaves)
    counts: list[tuple[Plan, Margins, tuple[int, ...]]] = []
    for counted in made.counted:
        inner = streams(counted, plan.dt, boolean, every=True)
        front = margins(inner, sizes, apart)
        counts.append((inner, front, tuple(made.number_of(*column) for column in front.columns)))
    return Margins(tuple(made.columns), tuple(made.steps), leaves, tuple(counts))


class _Builder(Operations[int]):
    def __init__(self, plan: Plan, sizes: Mapping[str, int], apart: bool) -> None:
        self.sizes = sizes
        self.alone = ALONE if apart else ""
        self.dt = plan.dt
        self.counted: dict[Formula, int] = {}
        self.columns: dict[tuple[str, int | None], int] = {}
        self.steps: dict[Step, int] = {}

    def step(self, kind: str, *inputs: int, number: float = 0.0) -> int:
        """Return the number of the operation's result, one for all that need it."""
        return self.steps.setdefault(Step(kind, inputs, number), len(self.steps))

    def number_of(self, name: str, index: int | None = None) -> int:
        return self.columns.setdefault((name, index), len(self.columns))

    def column(self, name: str, index: int | None = None) -> int:
        return self.step("column", number=self.number_of(name, index))

    def number(self, value: float) -> int:
        return self.step("number", number=value)

    def apply(self, name: str, *values: int) -> int:
        return self.step(name, *values)

    def before(self, x: int, n: int, held: bool = False) -> int:
        return self.step("lag" if held else "delay", x, number=n) if n else x

    def latest(self, event: int, x: int) -> int:
        return self.step("latest", event, x)

    def holds(self, f: Formula) -> int:
        """Return the number of the result that is 1 where a formula holds and 0 where not."""
        return self.step("count", number=self.counted.setdefault(f, len(self.counted)))

    def sampled(self, e: Sampled) -> int:
        return e.computed(self, self.holds, self.expression, lambda w: span_of(w, self.dt))

    def leaf(self, f: Formula, sign: int, boolean: bool) -> int:
        left, comparison, right = f.compared or (*f.terms(), ">", None)
        match left if right is None else None:
            case Signal(name):
                margin = self.column(self.alone + name)
            case Component(Signal(name), index):
                margin = self.column(self.alone + name, index)
            case _:
                margin = self.expression(left)
        if right is not None:
            sides = (margin, self.expression(right))
            margin = self.step("-", *(sides[::-1] if comparison in ("<", "<=") else sides))
        if comparison in ("==", "!="):
            margin = self.step("abs", margin)
        if comparison == "==":
            margin = self.step("neg", margin)
        if boolean:
            margin = self.step("truth", margin, number=float(comparison in (">=", "<=", "==")))
        return margin if sign > 0 else self.step("neg", margin)

    def expression(self, e: Term) -> int:
        results: dict[int, int] = {}

        def result(part: Term) -> int:
            if isinstance(part, Sampled):
                return self.sampled(part)
            # A signal is a number here, and a vector within its component or norm.
            return self.column(part.name) if isinstance(part, Signal) else results[id(part)]

        for part in postorder(e):
            if not isinstance(part, Signal):
                results[id(part)] = self.part(part, result)
        return result(e)

    def part(self, part: Term, result: Callable[[Term], int]) -> int:
        match part:
            case Number(value):
                return self.step("number", number=value)
            case Component(Signal(name), index):
                return self.column(name, index)
            case Arithmetic("norm", (Signal(name),)):
                return self.step("norm", *(self.column(name, k) for k in range(self.size(name))))
            case Arithmetic("norm", (argument,)):
                raise TypeError(f"norm takes a vector signal; got norm({argument})")
            case Arithmetic("**", (base, Number(power))) if (
                power.is_integer() and abs(power) <= FEW
            ):
                return self.step("power", result(base), number=power)
            case Arithmetic(name, arguments):
                return self.step(name, *map(result, arguments))
        raise missing_case("the margin", part)

    def size(self, name: str) -> int:
        if name not in self.sizes:
            raise ValueError(
                f"norm({name}) needs the number of components of {name}: give it, as in "
                f'sizes={{"{name}": 3}}'
            )
        return self.sizes[name]
