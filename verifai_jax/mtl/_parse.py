"""The parser of formulas: `parse("always[0, 4] (abs(x) <= 2.4 & F[0,500ms] safe)")`.

One LALR grammar covers Boolean and arithmetic expressions, because two would conflict on
parentheses; types are checked afterwards, on the tree, by `FormulaBuilder`. The grammar reads more
than is accepted, so that errors can suggest a correction.

`FormulaBuilder` refuses chains and mixtures of operators that tools read differently, and suggests
parentheses.
"""

import math
import re
from collections.abc import Mapping
from decimal import Decimal, DecimalException
from typing import Any

from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression_builder import MAX_DEPTH, ExpressionBuilder, Part
from verifai_jax.mtl.formula import Formula, Interval
from verifai_jax.mtl.grammar import FormulaSyntaxError, Tree, explain_error, operator_of, parser
from verifai_jax.mtl.sampled import unit_words
from verifai_jax.mtl.words import NAME, NUMBERS, OPERATORS, TIMES

MAX_TOKENS = 10_000
"""Words and symbols that a formula's text may have. Far more than a person writes: a file that
is given by mistake is refused before it is parsed."""
MAX_OFFERED = 300
"""Characters of a text that an error offers at most; a longer one would be cut when it is shown."""
TYPOGRAPHY = {
    "≤": "<=", "≥": ">=", "≠": "!=", "−": "-", "–": "-", "‑": "-", "×": "*", "·": "*", "÷": "/",
    "²": "**2", "³": "**3", "∧": "&", "∨": "|", "¬": "!", "→": "->", "⇒": "->", "↔": "<->",
    "⇔": "<->", "□": " always ", "◇": " eventually ", "\u00ad": "", "\u200b": "", "\u2060": "",
    "\ufeff": "",
}  # fmt: skip
"""Characters that word processors write, outside of quotation marks, as they are written here."""
_TYPED = re.compile(rf'"[^"\n]*"|[{"".join(TYPOGRAPHY)}]')
_TOKEN = re.compile(r'"[^"\n]*"|[\w.]+|\S')


def parse(
    text: str, constants: Mapping[str, float] | None = None,
    definitions: Mapping[str, Formula | str] | None = None,
) -> Formula:  # fmt: skip
    """Read a formula from its text.

    **Arguments:**
    - `text`: see the grammar in the documentation; times are in seconds unless a unit follows.
    - `constants`: numbers by name, which may also be ends of intervals.
    - `definitions`: sub-formulas by name, as text or formulas; a definition may use earlier ones.

    A text has at most 10 000 words and symbols. Parentheses may be nested 100 deep, and so may
    operators (`<->`, `xor`, weak until and release count as several); temporal operators may be
    nested 40 deep.

    **Raises:** `FormulaSyntaxError`, with a caret under the error and the expected symbols.
    """
    known: dict[str, Formula] = {}
    constants = dict(constants or {})
    for name, definition in (definitions or {}).items():
        if not NAME.fullmatch(name):
            raise ValueError(f"a definition's name must be an identifier; got {name!r}")
        if name in constants:
            raise ValueError(f"{name!r} is both a constant and a definition")
        known[name] = (
            _read(definition, constants, known) if isinstance(definition, str) else definition
        )
    return _read(text, constants, known)


def _read(
    text: str, constants: Mapping[str, float], known: Mapping[str, Formula], offers: bool = True
) -> Formula:
    """Read a formula; `offers` is whether an error may offer texts, each of which is read, too."""
    if not isinstance(text, str):
        raise TypeError(f"a formula's text is a str; got {type(text).__name__}")
    import lark

    text = text.translate(dict.fromkeys(map(ord, "“”„"), '"'))
    text = _TYPED.sub(lambda found: TYPOGRAPHY.get(found[0], found[0]), text)
    _check_size(text)
    try:
        tree = parser().parse(text)
    except lark.UnexpectedInput as error:
        try:  # Units of add-ons, which few texts have.
            tree = parser(unit_words()).parse(text)
        except lark.UnexpectedInput:
            raise explain_error(error, text) from None

    def reads(offered: str) -> bool:
        if not offers or len(offered) > MAX_OFFERED:
            return False
        try:
            _read(offered, constants, known, offers=False)
        except (FormulaSyntaxError, RecursionError):
            return False
        return True

    return FormulaBuilder(text, constants, known, reads).formula(tree)


def _check_size(text: str) -> None:
    """Refuse a text with more words and symbols, or parentheses in each other, than are read."""
    depth = 0
    for number, token in enumerate(_TOKEN.finditer(text)):
        depth += (token[0] == "(") - (token[0] == ")")
        reason = ""
        if number >= MAX_TOKENS:
            reason = f"a formula has at most {MAX_TOKENS} words and symbols"
        elif depth > MAX_DEPTH:
            reason = f"parentheses stand at most {MAX_DEPTH} deep within each other"
        if reason:
            raise FormulaSyntaxError(
                f"{reason}: name its parts by definitions", text, token.start()
            )


_CONNECTIVES = ("iff", "impl", "or_", "and_", "bin", "negation", "temporal")


class FormulaBuilder(ExpressionBuilder):
    """Builder of the formula of one text, which refuses ambiguous or ill-typed parts."""

    def _before(self, tree: Tree) -> None:
        if tree.data == "iff":
            self._refuse_powers(tree)

    def _iff(self, tree: Tree) -> Part:
        parts, words = self._operands(tree)
        if len(words) > 1:
            raise self._chained(parts, words)
        left, right = map(self._formula, parts)
        value = left.iff(right) if words[0].type == "IFF" else left ^ right
        return Part(value, *self._span(tree), rule="iff")

    def _impl(self, tree: Tree) -> Part:
        parts, words = self._operands(tree)
        self._refuse_open(parts, words, tree.children[::2])
        if len(words) > 1:
            raise self._chained(parts, words)
        left, right = map(self._formula, parts)
        return Part(left >> right, *self._span(tree), rule="impl")

    def _or(self, tree: Tree) -> Part:
        return self._joined(tree, ast.Or)

    def _and(self, tree: Tree) -> Part:
        return self._joined(tree, ast.And)

    def _joined(self, tree: Tree, kind: type[ast.And] | type[ast.Or]) -> Part:
        parts, words = self._operands(tree)
        self._refuse_open(parts, words, tree.children[::2])
        for part in parts:
            if part.rule == "bin":
                word = next(c for c in words if c)
                offer = self._offered(", as in ", f"({self._source(part)})")
                raise self._fail(
                    f"until and its like next to {str(word)!r} is ambiguous: put it in "
                    f"parentheses{offer}",
                    part.start,
                    part.end,
                )
        value = kind(tuple(map(self._formula, parts)))
        return Part(value, *self._span(tree), rule="join")

    def _refuse_powers(self, tree: Tree) -> None:
        """Refuse `x^2 < 1`, where `^` stands next to arithmetic: it means exclusive or.

        Between two comparisons it can mean nothing else, as these do not chain.
        """
        for k, word in enumerate(tree.children[1::2]):
            left = self._touching(tree.children[2 * k], -1)
            right = self._touching(tree.children[2 * k + 2], 0)
            kinds = [None if side is None else str(side.data) for side in (left, right)]
            if str(word) != "^" or kinds in ([None, None], ["cmp", "cmp"]):
                continue
            base = _text(self.text, _edge(tree.children[2 * k], -1))
            exponent = _text(self.text, _edge(tree.children[2 * k + 2], 0))
            power = self._offered("", f"{base}**{exponent}", within='"s" < {}') or "x**2"
            raise self._fail(
                f"'^' is exclusive or, and here it stands next to arithmetic: a power is written "
                f"{power}, and exclusive or (one formula) xor (the other)",
                word.start_pos,
                word.start_pos + 1,
            )

    def _touching(self, tree: Tree, side: int) -> Tree | None:
        """Return the arithmetic of an operand of `^` where it touches it, or None."""
        while tree.data in _CONNECTIVES and (side or tree.data not in ("negation", "temporal")):
            tree = tree.children[side]
        match tree.data:
            case "quoted" | "true" | "false" | "negation" | "temporal":
                return None
            case "parens":
                return tree if self._is_arithmetic(tree) else None
            case "name":
                return tree if str(tree.children[0]) in {**NUMBERS, **self.constants} else None
        return tree

    def _is_arithmetic(self, tree: Tree) -> bool:
        """Return whether a tree is an expression, by its rule alone."""
        while tree.data == "parens":
            tree = tree.children[0]
        if tree.data == "name":
            name = str(tree.children[0])
            return name in self.constants or name not in self.known
        return tree.data not in (*_CONNECTIVES, "cmp", "true", "false")

    def _bin(self, tree: Tree) -> Part:
        parts = [self._build(c) for c in tree.children[::3]]
        words, intervals = tree.children[1::3], tree.children[2::3]
        self._refuse_open(parts, words, tree.children[::3])
        if len(words) > 1:
            raise self._chained(parts, words)
        left, right = map(self._formula, parts)
        interval = self._interval(intervals[0])
        value = ast.build(operator_of(words[0]), (left, right), interval)
        return Part(value, *self._span(tree), rule="bin")

    def _refuse_open(self, parts: list[Part], words: list[Any], trees: list[Tree]) -> None:
        """Refuse `always a & b`: tools disagree on how far the word reaches."""
        is_open = [part.rule == "word" and not part.closed for part in parts]
        if not any(is_open[: len(words)]):
            return
        far = near = self._source(parts[-1])
        for k in reversed(range(len(words))):
            between = self.text[parts[k].end : parts[k + 1].start]
            source = self._source(parts[k])
            if is_open[k]:
                operator, operand = self._operator(trees[k], parts[k])
                far = f"{operator} ({operand}{between}{far})"
                near = f"({source}){between}{near}"
            else:
                far, near = f"{source}{between}{far}", f"{source}{between}{near}"
        first = is_open.index(True)
        operator, _ = self._operator(trees[first], parts[first])
        part = parts[first]
        offer = self._offered("write ", far, near)
        raise self._fail(
            f"the scope of {operator!r} is ambiguous: {offer or 'use parentheses'}",
            part.start,
            part.end,
        )

    def _operator(self, tree: Tree, part: Part) -> tuple[str, str]:
        """Return the operators before a part, with their intervals, and their operand.

        The grammar's own tree says where one ends: a text has blanks anywhere, or none.
        """
        start = part.start
        while tree.data in ("temporal", "negation"):
            tree = tree.children[-1]
            start = tree.meta.start_pos
        return self.text[part.start : start].strip(), self.text[start : part.end]

    def _negation(self, tree: Tree) -> Part:
        part = self._build(tree.children[1])
        start, end = self._span(tree)
        return Part(ast.Not(self._formula(part)), start, end, part.closed, part.rule)

    def _temporal(self, tree: Tree) -> Part:
        word, interval, operand = tree.children
        part = self._build(operand)
        value = self._formula(part)
        name = operator_of(word)
        if interval is not None and not OPERATORS[name].timed:
            raise self._fail(f"{str(word)!r} takes no interval", *self._span(interval))
        value = ast.build(name, (value,), self._interval(interval))
        symbol = not str(word).rstrip("_").islower()
        rule = part.rule if symbol else "word"
        return Part(value, *self._span(tree), closed=part.closed, rule=rule)

    def _interval(self, tree: Tree | None) -> Interval:
        if tree is None:
            return ast.EVERYTHING
        opening, *bounds, closing = tree.children
        low, high = map(self._bound, bounds)
        span = self._span(tree)
        if low < 0:
            raise self._fail("an interval starts at 0 or later", *span)
        if high < low:
            ends = (_text(self.text, child) for child in reversed(bounds))
            offer = self._offered(": write ", f"[{', '.join(ends)}]", within='F{} "s"')
            raise self._fail(f"an interval ends no earlier than it starts{offer}", *span)
        if low == float("inf"):
            raise self._fail("an interval starts at a finite time", *span)
        return Interval(low, high, opening == "(", closing == ")")

    def _bound(self, tree: Tree) -> float:
        if len(tree.children) == 1:
            name = str(tree.children[0])
            if name in ("inf", "infinity"):
                return float("inf")
            if name in self.constants:
                value = float(self.constants[name])
                if math.isnan(value):
                    raise self._fail(
                        f"the end of an interval is a number; {name} is NaN", *self._span(tree)
                    )
                return value
            raise self._fail(
                str(unknown_name("constant", name, ["inf", *self.constants])), *self._span(tree)
            )
        minus, number, unit = tree.children
        if str(unit or "s") not in TIMES:
            raise self._fail(str(unknown_name("unit of time", str(unit), TIMES)), *self._span(tree))
        try:
            value = float(Decimal(str(number)) * Decimal(TIMES[str(unit or "s")]))
        except (DecimalException, ValueError):
            value = math.inf
        if math.isinf(value):
            raise self._fail("a time must be a finite number of seconds, or inf", *self._span(tree))
        return -value if minus else value

    def _true(self, tree: Tree) -> Part:
        return Part(ast.TRUE, *self._span(tree), closed=True)

    def _false(self, tree: Tree) -> Part:
        return Part(ast.FALSE, *self._span(tree), closed=True)


def _edge(tree: Tree, side: int) -> Tree:
    """Return the first (0) or last (-1) operand in a tree outside of an open operator."""
    while tree.data in (*_CONNECTIVES, "cmp", "sum", "product", "power"):
        if not isinstance(tree.children[side], Tree):
            break
        tree = tree.children[side]
    return tree


def _text(text: str, tree: Tree) -> str:
    """Return the part of `text` that a node of the tree was read from."""
    return text[tree.meta.start_pos : tree.meta.end_pos]
