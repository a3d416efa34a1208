"""The margins of a formula's leaves as lines of C over the numbers of a sample.

code = margin_code(plan, sizes={"p": 3})
code.columns                    # (("x", None), ("p", 0), ...): what x[0], x[1] ... are
code.lines, code.leaves         # "const double a2 = x[0] - x[1];" ..., and "a2" ...
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from verifai_jax.mtl.expression import Arithmetic, Component, Duration, Number, Signal
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.streams import Plan
from verifai_jax.mtl.tree import missing_case, postorder

FEW = 64
"""Powers by a whole number up to this one are products, as in JAX."""

_FUNCTIONS = {"abs": "fabs", "**": "pow", **{name: name for name in ("sqrt", "sin", "cos", "exp")}}


class MarginCode(NamedTuple):
    """Code that computes margins.

    - `columns`: name of the signal, and the index of a component of a vector.
    - `leaves`: the text of each margin, after the lines.
    - `counts`: of each duration, the code of what is counted, and its columns among these.
    """

    columns: tuple[tuple[str, int | None], ...]
    lines: tuple[str, ...]
    leaves: tuple[str, ...]
    counts: tuple[tuple["MarginCode", tuple[int, ...]], ...]


def margin_code(plan: Plan, sizes: Mapping[str, int]) -> MarginCode:
    """Return the code of a plan's leaves, each with the sign of its margin.

    A duration is read as `n0`, `n1` ..., which the lines before these have.

    **Arguments:**

    - `sizes`: number of components of the signals of which a norm is taken.

    **Raises:** `ValueError` for a norm of a signal without a size.
    """
    code = _Code(sizes, [count.duration for count in plan.counts])
    texts = tuple(code.leaf(f, sign, plan.top == 1) for f, sign in plan.leaves)
    counts: list[tuple[MarginCode, tuple[int, ...]]] = []
    for count in plan.counts:
        inner = margin_code(count.plan, sizes)
        counts.append((inner, tuple(code.index(*column) for column in inner.columns)))
    lines = tuple(f"const double {name} = {text};" for text, name in code.names.items())
    return MarginCode(tuple(code.columns), lines, texts, tuple(counts))


class _Code:
    def __init__(self, sizes: Mapping[str, int], counted: Sequence[Duration]) -> None:
        self.sizes = sizes
        self.counted = {each: f"n{k}" for k, each in enumerate(counted)}
        self.columns: dict[tuple[str, int | None], int] = {}
        self.names: dict[str, str] = {}

    def named(self, text: str) -> str:
        """Return the name of the line that computes this, one for all that need it."""
        return self.names.setdefault(text, f"a{len(self.names)}")

    def index(self, name: str, index: int | None = None) -> int:
        return self.columns.setdefault((name, index), len(self.columns))

    def column(self, name: str, index: int | None = None) -> str:
        return f"x[{self.index(name, index)}]"

    def leaf(self, f: Formula, sign: int, boolean: bool) -> str:
        left, comparison, right = f.compared or (*f.terms(), ">", None)
        margin = self.expression(left)
        if right is not None:
            sides = (margin, self.expression(right))
            margin = self.named(" - ".join(sides[::-1] if comparison in ("<", "<=") else sides))
        if comparison in ("==", "!="):
            margin = self.named(f"fabs({margin})")
        if comparison == "==":
            margin = self.named(f"-{margin}")
        if boolean:
            at_zero = str(comparison in (">=", "<=", "==")).lower()
            margin = self.named(f"vj_truth({margin}, {at_zero})")
        return margin if sign > 0 else self.named(f"-{margin}")

    def expression(self, e: Term) -> str:
        texts: dict[int, str] = {}

        def text(part: Term) -> str:
            if isinstance(part, Duration):
                return self.counted[part]
            # A signal is a number here, and a vector within its component or norm.
            return self.column(part.name) if isinstance(part, Signal) else texts[id(part)]

        for part in postorder(e):
            if not isinstance(part, Signal):
                texts[id(part)] = self.part(part, text)
        return text(e)

    def part(self, part: Term, text: Callable[[Term], str]) -> str:
        match part:
            case Number(value):
                return f"({value!r})"
            case Component(Signal(name), index):
                return self.column(name, index)
            case Arithmetic("norm", (Signal(name),)):
                inputs = [self.column(name, k) for k in range(self.size(name))]
                return self.named(f"sqrt({' + '.join(f'({a} * {a})' for a in inputs)})")
            case Arithmetic("min" | "max" as name, arguments):
                joined, *others = map(text, arguments)
                for other in others:
                    joined = f"vj_best({1 if name == 'max' else -1}, {joined}, {other})"
                return self.named(joined)
            case Arithmetic("**", (base, Number(power))) if (
                power.is_integer() and abs(power) <= FEW
            ):
                return self.named(f"vj_power({text(base)}, {int(power)})")
            case Arithmetic("+" | "-" | "*" | "/" as name, (one, other)):
                return self.named(f"{text(one)} {name} {text(other)}")
            case Arithmetic("neg", (one,)):
                return self.named(f"-{text(one)}")
            case Arithmetic(name, arguments) if name in _FUNCTIONS:
                return self.named(f"{_FUNCTIONS[name]}({', '.join(map(text, arguments))})")
            case Arithmetic("norm", (argument,)):
                raise TypeError(f"norm takes a vector signal; got norm({argument})")
        raise missing_case("the exported margin", part)

    def size(self, name: str) -> int:
        if name not in self.sizes:
            raise ValueError(
                f"norm({name}) needs the number of components of {name}: give it, as in "
                f'sizes={{"{name}": 3}}'
            )
        return self.sizes[name]
