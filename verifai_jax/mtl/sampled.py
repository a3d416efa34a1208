"""Functions of samples: numbers computed from the present sample and earlier ones.

    duration(signal("speed") > 30, 60)            # seconds of the last 60 s in which it held

A kind of function derives from `Sampled` and defines its value by `Operations`, which arrays, and
monitors that see one sample after the other, perform each in their own way. Kinds of add-ons are
called in texts by the names in `FUNCTIONS` of a module of the group `verifai_jax.formulas`.
"""

import abc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from verifai_jax.core.display.extensions import extension, extensions
from verifai_jax.mtl.expression import Expression, Number, Signal, constant_value, expression
from verifai_jax.mtl.formula import Formula, Interval, Term, formula
from verifai_jax.mtl.tree import Node, postorder
from verifai_jax.mtl.words import number_text

V = TypeVar("V")


class Operations(abc.ABC, Generic[V]):
    """The operations of functions of samples; `dt` is the time of a sample in seconds."""

    dt: float

    @abc.abstractmethod
    def number(self, value: float) -> V:
        """Return a number."""

    @abc.abstractmethod
    def apply(self, name: str, *values: V) -> V:
        """Compute an operator or a function of `Arithmetic`."""

    @abc.abstractmethod
    def before(self, x: V, n: int, held: bool = False) -> V:
        """Return the value `n` samples ago; before the first sample 0, or if `held` its value."""

    @abc.abstractmethod
    def latest(self, event: V, x: V) -> V:
        """Return `x` at the latest sample at which `event` was above 0, or at the first one."""

    def total(self, x: V, n: int) -> V:
        """Return the sum of the last `n` samples, or of those that there are."""
        # Sums of 1, 2, 4, ... samples: the same order of additions, and bits, wherever it is.
        return self._joined("+", x, n, False)

    def extreme(self, word: str, x: V, n: int) -> V:
        """Return the `"min"` or `"max"` of the last `n` samples, or of those that there are."""
        return self._joined(word, x, n, True)

    def _joined(self, word: str, x: V, n: int, held: bool) -> V:
        joined, ago, size = None, 0, 1
        while True:
            if n & size:
                part = self.before(x, ago, held) if ago else x
                joined = part if joined is None else self.apply(word, joined, part)
                ago += size
            if joined is not None and 2 * size > n:
                return joined
            x, size = self.apply(word, x, self.before(x, size, held)), 2 * size


@dataclass
class ArrayOperations(Operations[Any]):
    """The operations on arrays `[time, *lanes]`.

    - `xp`, `function`: NumPy or `jax.numpy`, and what computes a function by its name.
    - `running`: what computes the running maximum over time.
    - `like`: an array of the length and the type of the values.
    """

    dt: float
    xp: Any
    function: Callable[[str, list[Any]], Any]
    running: Callable[[Any], Any]
    like: Any

    def number(self, value: float) -> Any:
        return self.xp.full_like(self.like, value)

    def apply(self, name: str, *values: Any) -> Any:
        return self.function(name, list(values))

    def before(self, x: Any, n: int, held: bool = False) -> Any:
        first = self.xp.broadcast_to(x[:1] if held else self.xp.zeros_like(x[:1]), x.shape)
        return self.xp.concatenate([first[:n], x[: max(len(x) - n, 0)]])

    def latest(self, event: Any, x: Any) -> Any:
        event, x = self.xp.broadcast_arrays(event, x)
        now = self.xp.arange(len(x)).reshape((-1,) + (1,) * (x.ndim - 1))
        unknown = self.xp.isnan(event)
        rows = self.running(self.xp.where((event > 0) | unknown, now, 0))
        return self.xp.take_along_axis(self.xp.where(unknown, np.nan, x), rows, axis=0)


def held(truth: Any, xp: Any) -> Any:
    """Return 1 where a formula holds and 0 where not, of its truth; NaN where that is unknown."""
    return xp.where(xp.isnan(truth), np.nan, (truth > 0).astype(truth.dtype))


@dataclass(frozen=True, eq=False, repr=False)
class Sampled(Signal, abc.ABC):
    """A number computed from the samples of its operands up to now; made by `of`.

    Like any signal of a recording, it keeps its last value under the end "hold". A subclass has
    `function`, its word in texts; `english`, with places for operands and `{window}`; and `value`.
    """

    operands: tuple[Formula | Expression, ...]
    window: Interval | None = None
    function: ClassVar[str] = ""
    english: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for part in (part for f in self.counted for part in f.subformulas(valued=True)):
            if part.side == "ahead":
                raise ValueError(
                    f"what is counted must be known at the present sample, but {part} looks ahead: "
                    "use an operator that looks back, such as once"
                )
        if self.window is not None and math.isinf(self.window.end):
            raise ValueError(f"the window of {self.function} has an end; got {self.window}")

    @classmethod
    def of(
        cls, operands: Sequence[Formula | Term | float], window: Term | Interval | float | None
    ) -> "Sampled":  # fmt: skip
        """Return the function of operands over a window, of seconds up to now if it is a number.

        **Raises:** `ValueError` for a formula that looks ahead, and for a window that is not
        positive and finite.
        """
        if isinstance(window, Term):
            asked = expression(window)
            window = asked.seconds if isinstance(asked, Number) else constant_value(asked)
            if window is None:
                raise ValueError(f"the window of {cls.function} is a number of seconds")
        if isinstance(window, float | int):
            if not (window > 0 and math.isfinite(window)):
                raise ValueError(
                    f"the window of {cls.function} must be a positive number of seconds; "
                    f"got {window:zg}"
                )
            window = Interval(0.0, float(window), open_end=True)
        own = tuple(each if isinstance(each, Formula) else expression(each) for each in operands)
        text = ", ".join([*map(str, own), *([] if window is None else [window_text(window)])])
        return cls(f"{cls.function}({text})", own, window)

    @abc.abstractmethod
    def value(self, of: Operations[V], operands: Sequence[V], first: int, last: int) -> V:
        """Compute it.

        **Arguments:**
        - `of`: the operations.
        - `operands`: the values of the operands; of a formula 1 where it holds and 0 where not, NaN
          where that is unknown.
        - `first`, `last`: the window in samples before now.
        """

    def computed(
        self, of: Operations[V], truth: Callable[[Formula], V], number: Callable[[Expression], V],
        span: Callable[[Interval], tuple[int, float]],
    ) -> V:  # fmt: skip
        """Compute it by what gives 1 where a formula holds, numbers, and windows in samples."""
        operands = [truth(p) if isinstance(p, Formula) else number(p) for p in self.operands]
        first, last = (0, 0) if self.window is None else span(self.window)
        return self.value(of, operands, first, int(last))

    def changed(self, change: Callable[[Any], Any], window: Interval | None = None) -> "Sampled":
        """Return the same function of changed operands, and of another window if one is given."""
        return self.of([change(each) for each in self.operands], window or self.window)

    @property
    def counted(self) -> tuple[Formula, ...]:
        """The operands that are formulas."""
        return tuple(each for each in self.operands if isinstance(each, Formula))

    @property
    def is_signal(self) -> bool:
        """False, because its text is that of a function."""
        return False

    def below(self) -> tuple[Node, ...]:
        """Return nothing, so that a walk over expressions meets no formula."""
        return ()

    def signals(self) -> tuple[str, ...]:
        """Return the names of the signals of the operands."""
        return tuple(dict.fromkeys(name for each in self.operands for name in each.signals()))

    def text(self, outer: int = 0) -> str:
        """Return the text of the function."""
        return self.name


class Duration(Sampled):
    """The seconds, within a window, in which a formula held; each sample counts as one period."""

    function = "duration"
    english = "the number of seconds of {window} in which {0}"

    def value(self, of: Operations[V], operands: Sequence[V], first: int, last: int) -> V:
        count = of.total(of.before(operands[0], first), last - first + 1)
        return of.apply("*", count, of.number(of.dt))


def duration(operand: Formula | Term, window: Term | Interval | float) -> Sampled:
    """Count the seconds, within the last `window` seconds, in which a formula held.

    `always(duration(signal("speed") > 30, 60) <= 3)` is "at most 3 s in any 60 s", in text
    `always duration(speed > 30, 60) <= 3`. There are no samples before the first one.

    **Raises:** `ValueError` for a formula that looks ahead, and for a window that is not positive.
    """
    return Duration.of([formula(operand)], window)


def window_text(window: Interval) -> str:
    """Return the text of a window: the number alone of `[0,5)`, which is the last 5 s."""
    plain = window.start == 0 and window.open_end and not window.open_start
    return number_text(window.end) if plain else str(window)


def text_functions() -> dict[str, Callable[..., Any]]:
    """Return what a text may call, beyond arithmetic, by its name."""
    found: dict[str, Callable[..., Any]] = {"duration": duration}
    for point in extensions("verifai_jax.formulas"):
        module = extension("verifai_jax.formulas", point)
        names = getattr(module, "FUNCTIONS", {})
        found |= {word: getattr(module, name) for word, name in names.items()}
    return found


def unit_words() -> tuple[str, ...]:
    """Return the units of add-ons that may follow a number in a text."""
    modules = [extension("verifai_jax.formulas", p) for p in extensions("verifai_jax.formulas")]
    return tuple(word for module in modules for word in getattr(module, "UNITS", ()))


def sampled_in(*formulas: Formula) -> tuple[Sampled, ...]:
    """Return the functions of samples in formulas, also those within one another, each once."""
    found: dict[Sampled, None] = {}
    todo: list[Formula | Term] = list(formulas)
    while todo:
        part = todo.pop()
        if isinstance(part, Formula):
            todo += [term for leaf in part.subformulas() for term in leaf.terms()]
            continue
        for each in postorder(part):
            if isinstance(each, Sampled) and each not in found:
                found[each] = None
                todo += each.operands
    return tuple(found)


def with_counted(*formulas: Formula) -> list[Formula]:
    """Return formulas together with those that their functions of samples read."""
    counted = (each for found in sampled_in(*formulas) for each in found.counted)
    return list(dict.fromkeys([*formulas, *counted]))
