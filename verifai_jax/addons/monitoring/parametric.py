"""Formulas with parameters, `always[0, ?T] (distance > ?d)`: numbers and times to be found.

    template = read_parametric("always[0, ?T] (distance > ?d)")
    template.names, template.times        # ('T', 'd'), {'T'}
    template.formula({"T": 4.0, "d": 2.0})
    template.direction("d")               # -1: a larger d is harder to satisfy

A text is parsed once. In the tree a numeric parameter is a signal named `?d`, and a time parameter
is a float that no text contains; a walk over the tree substitutes values for them.

The file `templates.toml` is a library of requirements that people often write:

    (gap,) = templates("time-gap")
    gap.requirement(time_gap=1.2)                # a Requirement with another constant
"""

import functools
import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any

from verifai_jax.core.messages.errors import check_names
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.expression import (
    Arithmetic,
    Expression,
    Number,
    Signal,
    constant_value,
    expression,
)
from verifai_jax.mtl.fitting import rebuilt
from verifai_jax.mtl.formula import Formula, Interval, Term
from verifai_jax.mtl.requirements import Requirement
from verifai_jax.mtl.sampled import Sampled, sampled_in
from verifai_jax.mtl.tree import postorder

_WORDS = re.compile(r'"[^"\n]*"|[\[\]),:]|\?([A-Za-z_]\w*)')
_START, _END = 1e-300, 1e300
"""Times of parameters while their values are unknown: multiples of these, below and above any that
a person writes, so that an interval with one of them and another number ends after it starts."""
_CLOSED = {">": ">=", "<": "<=", "!=": "!="}
_OPEN = {">=": ">", "<=": "<", "==": "=="}


@dataclass(frozen=True)
class Parametric:
    """A formula with parameters.

    - `text`: the text as written.
    - `tree`: the formula with signals and times as placeholders for the parameters.
    - `names`: the parameters in order of appearance.
    - `slots`: the times in the tree that are placeholders for parameters.
    """

    text: str
    tree: Formula
    names: tuple[str, ...]
    slots: Mapping[float, str]

    @property
    def times(self) -> frozenset[str]:
        """The parameters that are ends of intervals."""
        return frozenset(self.slots.values())

    def formula(self, values: Mapping[str, float]) -> Formula:
        """Return the formula with values for all parameters.

        A comparison with a parameter becomes non-strict, so that the formula holds at the tightest
        value too: `x > ?d` becomes `x >= 4.2`.

        **Raises:** `UnknownNameError` for values of other names; `ValueError` for an interval that
        ends before it starts.
        """
        check_names("parameter", values, self.names)
        return self._filled(self.tree, values, True)

    def _filled(self, f: Formula, values: Mapping[str, float], positive: bool | None) -> Formula:
        """Return a formula with values; `positive` is None if its comparisons stay as they are.

        What is counted can make the formula true, or false.
        """
        match f:
            case ast.Predicate(comparison, left, right):
                if _parameters(left, right):
                    equal = {True: _CLOSED, False: _OPEN, None: {}}[positive]
                    comparison = equal.get(comparison, comparison)
                left, right = (self._with_numbers(e, values) for e in (left, right))
                return ast.Predicate(comparison, left, right)
            case ast.Atom(e):
                if not _parameters(e):
                    return f
                comparison = ">=" if positive else ">"
                return ast.Predicate(comparison, self._with_numbers(e, values), Number(0.0))
            case ast.Leaf():
                return f
        if isinstance(f, ast.Not) and positive is not None:
            positive = not positive
        operands = [self._filled(part, values, positive) for part in f.operands()]
        if not f.operator.timed:
            return ast.build(f.operator.word, operands)
        return ast.build(f.operator.word, operands, self._interval(f.interval, values))

    def _interval(self, span: Interval, values: Mapping[str, float]) -> Interval:
        start, end = (
            values[self.slots[t]] if t in self.slots else t for t in (span.start, span.end)
        )
        return replace(span, start=start, end=end)

    def _with_numbers(self, e: Term, values: Mapping[str, float]) -> Expression:
        def change(part: Term) -> Term | None:
            if isinstance(part, Sampled):
                window = None if part.window is None else self._interval(part.window, values)
                return part.changed(
                    lambda a: (
                        self._filled(a, values, None)
                        if isinstance(a, Formula)
                        else rebuilt(a, change)
                    ),
                    window,
                )
            known = isinstance(part, Signal) and part.name.startswith("?")
            return Number(values[part.name[1:]]) if known else None  # pyright: ignore

        return rebuilt(e, change)

    def direction(self, name: str) -> int:
        """Return how the robustness changes as a parameter grows, judging from the formula.

        **Returns:** 1 if it never falls, -1 if it never rises, 0 if the formula does not show it.
        """
        signs = self._signs(self.tree, name)
        return signs.pop() if len(signs) == 1 else 0

    def _signs(self, f: Formula, name: str) -> set[int]:
        if isinstance(f, ast.Not):
            return {-sign for sign in self._signs(f.operand, name)}
        if isinstance(f, ast.Predicate):
            margin = Arithmetic("-", (expression(f.left), expression(f.right)))
            signs = _term_signs(margin, f"?{name}")
            if f.comparison in ("==", "!="):
                return {0} if signs else set()
            return signs if f.comparison in (">", ">=") else {-sign for sign in signs}
        if isinstance(f, ast.Atom):
            return _term_signs(f.expression, f"?{name}")
        signs = {sign for part in f.valued() for sign in self._signs(part, name)}
        if f.side and f.operator.timed:
            sign = f.sign if isinstance(f, ast.Window) else 1
            ends = ((f.interval.start, -sign), (f.interval.end, sign))
            signs |= {effect for time, effect in ends if self.slots.get(time) == name}
        return signs

    def range_of_time(self, name: str) -> tuple[float, float]:
        """Return the minimum and maximum of a time, given the other times."""
        low, high = 0.0, math.inf
        for part in postorder(self.tree):
            if isinstance(part, Formula) and part.side and part.operator.timed:
                start, end = part.interval.start, part.interval.end
                if self.slots.get(start) == name and end not in self.slots:
                    high = min(high, end)
                if self.slots.get(end) == name and start not in self.slots:
                    low = max(low, start)
        return low, high

    def together(self, one: str, other: str) -> bool:
        """Return whether two parameters occur in one comparison."""
        leaves = (part for part in self.tree.subformulas() if part.terms())
        return any({one, other} <= set(_parameters(*leaf.terms())) for leaf in leaves)


def read_parametric(
    text: str, constants: Mapping[str, float] | None = None,
    definitions: Mapping[str, Formula | str] | None = None,
) -> Parametric:  # fmt: skip
    """Read a formula in which `?name` is a parameter for numbers or ends of intervals.

    **Arguments:**
    - `constants`, `definitions`: as in `parse`.
    **Raises:** the `FormulaSyntaxError` of `parse`; `ValueError` for a name used both as a number
    and as a time, or a text without a parameter.
    """
    if not isinstance(text, str):
        raise TypeError(f"the text of a formula with parameters is needed; got {text!r}")
    names: dict[str, bool] = {}
    slots: dict[float, str] = {}
    known: dict[str, float] = dict(constants or {})
    inside = False

    def put(match: re.Match[str]) -> str:
        nonlocal inside
        word, name = match[0], match[1]
        inside = (inside or word == "[") and word not in ("]", ")")
        if name is None:
            return word
        if names.setdefault(name, inside) != inside:
            raise ValueError(
                f"?{name} is used both as an end of an interval and as a number in {text!r}: "
                "use two names"
            )
        if not inside:
            return f'"?{name}"'
        is_end = match.string[: match.start()].rstrip()[-1] in ",:"
        slot = (len(slots) + 1) * (_END if is_end else _START)
        slots[slot] = name
        known[f"{name}__{len(slots)}"] = slot
        return f"{name}__{len(slots)}"

    plain = _WORDS.sub(put, text)
    if not names:
        raise ValueError(
            f"{text!r} has no parameter: write ?name for a number or a time that is to be found, "
            "as in always[0, ?T] (distance > ?d)"
        )
    tree = parse(plain, known, definitions)
    spans = [part.interval for part in tree.subformulas() if part.side and part.operator.timed]
    for span in [*spans, *(each.window for each in sampled_in(tree))]:
        if span and not span.closed and {span.start, span.end} & slots.keys():
            raise ValueError(
                f"a time that is to be found is an end that belongs to its interval, as in "
                f"[0, ?T]; got {text!r}"
            )
    return Parametric(text, tree, tuple(names), slots)


def _parameters(*terms: Term) -> list[str]:
    return [name[1:] for term in terms for name in term.signals() if name.startswith("?")]


def _term_signs(e: Term, name: str) -> set[int]:
    """Return the directions in which an expression moves as a signal grows; 0 for unknown."""
    if name not in e.signals():
        return set()
    match e:
        case Sampled():
            return {0}
        case Signal():
            return {1}
        case Arithmetic("+" | "min" | "max" | "sqrt" | "exp", arguments):
            return {sign for a in arguments for sign in _term_signs(a, name)}
        case Arithmetic("-", (left, right)):
            return _term_signs(left, name) | {-sign for sign in _term_signs(right, name)}
        case Arithmetic("neg", (inner,)):
            return {-sign for sign in _term_signs(inner, name)}
        case Arithmetic("*" | "/" as word, (left, right)):
            if (factor := constant_value(right)) is not None:
                return {sign * _sign(factor) for sign in _term_signs(left, name)}
            if word == "*" and (factor := constant_value(left)) is not None:
                return {sign * _sign(factor) for sign in _term_signs(right, name)}
    return {0}


def _sign(number: float) -> int:
    return (number > 0) - (number < 0)


@dataclass(frozen=True)
class Template:
    """A requirement of the library to start from.

    - `id`: its identifier.
    - `domain`: its field, such as `"driving"`, `"flight"`, `"medical"`.
    - `text`: the sentence that the formula formalises.
    - `expression`: the formula as text, with names of `constants`.
    - `source`: a paper that has the idea, a benchmark, or what kind of document decides.
    - `signals`: units of the signals by name; `"1"` for flags and ratios.
    - `unit`: the unit of the robustness, if it has one.
    - `example`: whether the numbers are examples.
    """

    id: str
    domain: str
    text: str
    expression: str
    source: str
    signals: Mapping[str, str]
    unit: str = ""
    constants: Mapping[str, float] = field(default_factory=dict)
    example: bool = False

    @property
    def formula(self) -> Formula:
        """The formula with the constants of the library."""
        return parse(self.expression, self.constants)

    def requirement(self, **constants: float) -> Requirement:
        """Return a requirement made from it, with new values for some constants.

        **Raises:** `UnknownNameError` for a constant that it does not have.
        """
        check_names(f"constant of {self.id}", constants, self.constants)
        formula = parse(self.expression, {**self.constants, **constants})
        return Requirement(self.id, formula, self.text, self.unit, self.source)

    def __str__(self) -> str:
        units = ", ".join(f"{n} [{u}]" if u else n for n, u in self.signals.items())
        numbers = ", ".join(f"{name} = {value:zg}" for name, value in self.constants.items())
        lines = [f"{self.id} ({self.domain}): {self.text}", f"  {self.expression}"]
        lines += [f"  with {numbers}"] if numbers else []
        example = "; its numbers are examples" if self.example else ""
        return "\n".join([*lines, f"  signals {units}", f"  source  {self.source}{example}"])


def templates(words: str = "", domain: str | None = None) -> tuple[Template, ...]:
    """Return the templates that contain all of these words, in the order of the library.

    **Arguments:**
    - `words`: words to find in any field of a template, ignoring case; all templates when left out.
    - `domain`: the domain of the templates; all domains when left out.
    **Raises:** `UnknownNameError` for a domain without templates.
    """
    library = _library()
    if domain is not None:
        check_names("domain", [domain], dict.fromkeys(each.domain for each in library))
    own = (each for each in library if domain in (None, each.domain))
    wanted = words.lower().split()
    return tuple(t for t in own if all(word in f"{t} {t.unit}".lower() for word in wanted))


@functools.cache
def _library() -> tuple[Template, ...]:
    file = resources.files("verifai_jax.addons.monitoring").joinpath("templates.toml")
    entries: list[dict[str, Any]] = tomllib.loads(file.read_text(encoding="utf-8"))["template"]
    return tuple(Template(expression=entry.pop("formula"), **entry) for entry in entries)
