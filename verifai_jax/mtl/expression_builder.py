"""From the tree of a text to expressions: numbers, signals, arithmetic, comparisons.

Types are checked here and in `formula_builder`, on the tree, where the position is known. Errors
suggest corrected texts; each suggestion was parsed before it is shown.
"""

import inspect
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import (
    Arithmetic,
    Expression,
    Number,
    Signal,
)
from verifai_jax.mtl.formula import Formula, Interval
from verifai_jax.mtl.grammar import FormulaSyntaxError, Tree
from verifai_jax.mtl.sampled import text_functions
from verifai_jax.mtl.words import ANGLES, FUNCTIONS, NUMBERS, TIMES

MAX_DEPTH = 100
"""Operators, or parentheses, that may stand within each other: far from where Python gives up."""
MAX_TEMPORAL_DEPTH = 40
"""Temporal operators that may stand within each other: each is a loop of its own to compile."""


@dataclass
class Part:
    """The meaning of a part of the text, and its position."""

    value: Formula | Expression
    start: int
    end: int
    #: In parentheses, so that nothing to the right could be thought to belong to it.
    closed: bool = False
    rule: str = ""
    #: Minus signs in front of each other.
    signs: int = 0


class ExpressionBuilder:
    """Builder of the expressions and comparisons of one text.

    **Arguments:**
    - `text`: the text of the formula.
    - `constants`, `known`: numbers and formulas by name.
    - `reads`: a function that says whether a text is a formula; without it errors suggest no text.
    """

    def __init__(
        self, text: str, constants: Mapping[str, float], known: Mapping[str, Formula],
        reads: Callable[[str], bool] = lambda text: False,
    ) -> None:  # fmt: skip
        self.text = text
        self.constants = constants
        self.known = known
        self.reads = reads
        self.parts: dict[int, Part] = {}

    def formula(self, tree: Tree) -> Formula:
        """Return the formula of a tree."""
        return self._formula(self._build(tree))

    def _before(self, tree: Tree) -> None:
        """Refuse what can be refused before the operands are built."""

    def _fail(self, reason: str, start: int, end: int) -> FormulaSyntaxError:
        return FormulaSyntaxError(reason, self.text, start, end - start)

    def _source(self, part: Part) -> str:
        return self.text[part.start : part.end]

    def _offered(self, before: str, *texts: str, within: str = "{}") -> str:
        """Return the part of a message that offers texts: only those that can be read.

        **Arguments:**
        - `before`: what stands before the offers; nothing is said where none can be read.
        - `within`: a formula that contains the text, for a text that is not a formula itself.
        """
        texts = tuple(" ".join(map(str.strip, text.splitlines())) for text in texts)
        offers = [each for each in texts if self.reads(within.format(each))]
        return f"{before}{' or '.join(offers)}" if offers else ""

    def _formula(self, part: Part) -> Formula:
        if isinstance(part.value, Expression):
            try:
                return ast.Atom(part.value)
            except ValueError as error:
                raise self._fail(str(error), part.start, part.end) from None
        return part.value

    def _expression(self, part: Part) -> Expression:
        if isinstance(part.value, Formula):
            source = self._source(part)
            power = "; a power is written x**2" if "^" in source else ""
            raise self._fail(
                f"a number or a signal is needed here, not the formula {source!r}{power}",
                part.start,
                part.end,
            )
        return part.value

    def _build(self, tree: Tree) -> Part:
        """Return the meaning of a tree, building what is below it first and without recursion."""
        stack: list[tuple[Tree, bool]] = [(tree, False)]
        while stack:
            node, ready = stack.pop()
            if id(node) in self.parts:
                continue
            if ready:
                self.parts[id(node)] = self._built(node)
                continue
            self._before(node)
            stack.append((node, True))
            below = [c for c in node.children if isinstance(c, Tree) and c.data != "interval"]
            stack.extend((child, False) for child in reversed(below))
        return self.parts[id(tree)]

    def _built(self, tree: Tree) -> Part:
        try:
            part = getattr(self, f"_{tree.data}".rstrip("_"))(tree)
        except FormulaSyntaxError:
            raise
        except ValueError as error:
            raise self._fail(str(error), *self._span(tree)) from None
        if isinstance(part.value, Formula):
            limits = {
                "operators": (part.value.depth, MAX_DEPTH),
                "temporal operators": (part.value.temporal_depth, MAX_TEMPORAL_DEPTH),
            }
            for kind, (depth, limit) in limits.items():
                if depth > limit:
                    reason = f"{kind} stand at most {limit} deep within each other"
                    raise self._fail(reason, part.start, part.start + 1)
        return part

    def _span(self, tree: Tree) -> tuple[int, int]:
        return tree.meta.start_pos, tree.meta.end_pos

    def _operands(self, tree: Tree) -> tuple[list[Part], list[Any]]:
        return [self._build(c) for c in tree.children[::2]], tree.children[1::2]

    def _chained(self, parts: list[Part], words: list[Any]) -> FormulaSyntaxError:
        sources = [self._source(part) for part in parts]
        between = [self.text[p.end : q.start].strip() for p, q in itertools.pairwise(parts)]
        right, left = sources[-1], sources[0]
        for k in range(len(between)):
            left = f"{left if k == 0 else f'({left})'} {between[k]} {sources[k + 1]}"
            at = len(between) - 1 - k
            right = f"{sources[at]} {between[at]} {right if k == 0 else f'({right})'}"
        word = str(words[1])
        # A power is no formula, so it is read within one.
        within = '"s" < {}' if str(words[0]) == "**" else "{}"
        offer = self._offered("write ", right, left, within=within)
        return self._fail(
            f"a chain of {str(words[0])!r} is ambiguous: {offer or 'use parentheses'}",
            words[1].start_pos,
            words[1].start_pos + len(word),
        )

    def _cmp(self, tree: Tree) -> Part:
        parts, words = self._operands(tree)
        if len(words) > 1:
            sides = zip(itertools.pairwise(map(self._source, parts)), words, strict=True)
            offer = self._offered(": write ", " & ".join(f"({a} {w} {b})" for (a, b), w in sides))
            raise self._fail(
                f"comparisons do not chain{offer or ': join them by &'}",
                words[1].start_pos,
                words[1].start_pos + len(words[1]),
            )
        left, right = map(self._expression, parts)
        try:
            value = ast.Predicate(str(words[0]), left, right)
        except ValueError as error:
            raise self._fail(str(error), *self._span(tree)) from None
        return Part(value, *self._span(tree))

    def _sum(self, tree: Tree) -> Part:
        parts, words = self._operands(tree)
        value = self._expression(parts[0])
        for word, part in zip(words, parts[1:], strict=True):
            value = Arithmetic(str(word), (value, self._expression(part)))
        return Part(value, *self._span(tree))

    _product = _sum

    def _power(self, tree: Tree) -> Part:
        parts, words = self._operands(tree)
        if len(words) > 1:
            raise self._chained(parts, words)
        base, exponent = map(self._expression, parts)
        return Part(base**exponent, *self._span(tree))

    def _minus(self, tree: Tree) -> Part:
        part = self._build(tree.children[1])
        if part.signs >= MAX_DEPTH:
            reason = f"at most {MAX_DEPTH} minus signs stand in front of each other"
            raise self._fail(reason, part.start, part.start + 1)
        value = -self._expression(part)
        return Part(value, *self._span(tree), signs=part.signs + 1)

    def _number(self, tree: Tree) -> Part:
        number, unit = tree.children
        if unit is None:
            return Part(Number(float(number)), *self._span(tree))
        if (measured := text_functions().get("unit")) is not None:
            return Part(measured(str(number), str(unit)), *self._span(tree))
        size = ANGLES[str(unit)] if str(unit) in ANGLES else float(TIMES[str(unit)])
        return Part(Number(float(number) * size), *self._span(tree))

    def _name(self, tree: Tree) -> Part:
        name = str(tree.children[0])
        if name in self.constants:
            return Part(Number(float(self.constants[name])), *self._span(tree))
        if name in self.known:
            return Part(self.known[name], *self._span(tree))
        if name in NUMBERS:
            return Part(Number(NUMBERS[name]), *self._span(tree))
        if name in FUNCTIONS:
            raise self._fail(
                f"{name} is a function: write {name}({', '.join('xy'[: FUNCTIONS[name]])}), or "
                "quote it if it is a signal",
                *self._span(tree),
            )
        return Part(Signal(name), *self._span(tree))

    def _quoted(self, tree: Tree) -> Part:
        return Part(Signal(str(tree.children[0])[1:-1]), *self._span(tree))

    def _component(self, tree: Tree) -> Part:
        vector, index = tree.children
        part = self._build(vector)
        try:
            value = self._expression(part)[int(str(index))]
        except ValueError:
            raise self._fail(
                "a component is a signal and a whole number, as in p[0]", *self._span(tree)
            ) from None
        return Part(value, *self._span(tree))

    def _call(self, tree: Tree) -> Part:
        name, *arguments = cast("list[Any]", tree.children)
        span = self._span(tree)
        if str(name) == "pow" and len(arguments) == 2:
            base, exponent = (self._expression(self._build(c)) for c in arguments)
            return Part(base**exponent, *span)
        if str(name) not in FUNCTIONS:
            return Part(self._called(name, arguments), *span)
        for tree in arguments:
            if tree.data == "interval":
                raise self._fail(f"{name} takes numbers, and no interval", *self._span(tree))
        parts = tuple(self._expression(self._build(c)) for c in arguments)
        try:
            return Part(Arithmetic(str(name), parts), *span)
        except ValueError as error:
            raise self._fail(str(error), *span) from None

    def _called(self, name: Any, arguments: list[Tree]) -> Formula | Expression:
        """Return what a function that is not arithmetic makes of formulas, numbers, intervals."""
        known = text_functions()
        if str(name) not in known or str(name) == "unit":
            error = unknown_name("function", str(name), [*FUNCTIONS, *known])
            raise self._fail(str(error), name.start_pos, name.start_pos + len(name))
        given = [
            self._interval(tree) if tree.data == "interval" else self._build(tree).value
            for tree in arguments
        ]
        function = known[str(name)]
        try:
            inspect.signature(function).bind(*given)
        except TypeError as error:
            wanted = ", ".join(inspect.signature(function).parameters)
            reason = f"{name} takes ({wanted}): {error}"
            raise self._fail(reason, name.start_pos, name.start_pos + len(name)) from None
        return function(*given)

    def _interval(self, tree: Tree | None) -> Interval:
        """Return the interval of a tree."""
        raise NotImplementedError

    def _parens(self, tree: Tree) -> Part:
        part = self._build(tree.children[0])
        return Part(part.value, *self._span(tree), closed=True, signs=part.signs)
