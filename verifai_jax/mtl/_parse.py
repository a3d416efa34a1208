"""The text of a formula, read: `parse("always[0, 4] (abs(x) <= 2.4 & F[0,500ms] safe)")`.

One LALR grammar covers Boolean and arithmetic expressions, because two would collide on
parentheses; what may stand where is checked afterwards, on the tree, where the position is known.
It reads more than it accepts: chains and mixtures on which tools disagree are read and refused
with the parentheses that would settle them.
"""

import functools
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from verifai_jax.core.errors import unknown_name
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.formula import FUNCTIONS, Expression, Formula, Interval
from verifai_jax.mtl.printing import NAME, WORDS

_UNITS = {
    "s": Decimal(1),
    "ms": Decimal("1e-3"),
    "us": Decimal("1e-6"),
    "ns": Decimal("1e-9"),
    "min": Decimal(60),
}
_UNARY = ("always", "eventually", "historically", "once", "next", "prev", "weak_prev")
_BINARY = ("until", "weak_until", "release", "since")
_TIMED = ("always", "eventually", "historically", "once", *_BINARY)


class FormulaSyntaxError(ValueError):
    """A text that is not a formula; the message shows the place and what to write instead.

    `position` is the offset of the place in the text.
    """

    def __init__(self, reason: str, text: str, position: int, width: int = 1) -> None:
        self.position = position
        before = text[:position]
        line = before.count("\n")
        shown = text.split("\n")[line]
        column = position - (before.rfind("\n") + 1)
        carets = "^" * max(1, min(width, len(shown) - column))
        super().__init__(f"{reason}\n  {shown}\n  {' ' * column}{carets}")


def parse(
    text: str,
    constants: Mapping[str, float] | None = None,
    definitions: Mapping[str, Formula | str] | None = None,
) -> Formula:
    """Read a formula.

    **Arguments:**

    - `text`: see the grammar in the documentation; times are in seconds unless a unit follows.
    - `constants`: numbers by name, also usable as the ends of intervals.
    - `definitions`: sub-formulas by name, as text or formulas; a text may use the names before it.

    **Raises:** `FormulaSyntaxError`, with a caret under the place and what is expected there.
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


def _read(text: str, constants: Mapping[str, float], known: Mapping[str, Formula]) -> Formula:
    if not isinstance(text, str):
        raise TypeError(f"a formula's text is a str; got {type(text).__name__}")
    import lark

    try:
        tree = _parser().parse(text)
    except lark.UnexpectedInput as error:
        raise _explained(error, text) from None
    return _Builder(text, constants, known).formula(tree)


@functools.cache
def _parser() -> Any:
    import lark

    def keyword(word: str) -> str:
        # An underscore may join an operator to its interval: `alw_[0,10]`.
        joint = r"(?:(?![\w.])|_(?=\s*\[))"
        alternatives = []
        for option in sorted(WORDS[word], key=len, reverse=True):
            if NAME.fullmatch(option):
                alternatives.append(option + joint)
            else:
                escaped = "".join("\\" + c for c in option)
                alternatives.append(escaped + r"(?:_(?=\s*\[))?")
        return f"/{'|'.join(alternatives)}/"

    unary = "\n".join(f"{w.upper()}.3: {keyword(w)}" for w in _UNARY)
    binary = "\n".join(f"{w.upper()}.3: {keyword(w)}" for w in _BINARY)
    # XOR, IFF and IMPLIES come before the comparisons that start like them.
    joints = "\n".join(
        f"{w.upper()}.4: {keyword(w)}" for w in ("iff", "xor", "implies", "or", "and")
    )
    grammar = rf"""
        ?start: iff
        ?iff: impl ((IFF | XOR) impl)*
        ?impl: or_ (IMPLIES or_)*
        ?or_: and_ (OR and_)*
        ?and_: bin (AND bin)*
        ?bin: unary (_binary unary)*
        _binary: ({" | ".join(w.upper() for w in _BINARY)}) [interval]
        ?unary: NOT unary -> negation
              | ({" | ".join(w.upper() for w in _UNARY)}) [interval] unary -> temporal
              | cmp
        ?cmp: sum (COMPARISON sum)*
        ?sum: product ((PLUS | MINUS) product)*
        ?product: factor ((STAR | SLASH) factor)*
        ?factor: MINUS factor -> minus
               | postfix
        ?postfix: atom
                | atom "[" NUMBER "]" -> component
        ?atom: NUMBER -> number
             | NAME -> name
             | QUOTED -> quoted
             | TRUE -> true
             | FALSE -> false
             | NAME "(" iff ("," iff)* ")" -> call
             | "(" iff ")" -> parens
        interval: "[" bound ("," | ":") bound "]"
        bound: [MINUS] NUMBER [UNIT] | NAME

        {unary}
        {binary}
        {joints}
        NOT.2: {keyword("not")}
        TRUE.3: {keyword("TRUE")}
        FALSE.3: {keyword("FALSE")}
        COMPARISON.3: />=|<=|==|!=|>|</
        PLUS: "+"
        MINUS: "-"
        STAR: "*"
        SLASH: "/"
        UNIT.5: /(?:min|ms|us|ns|s)(?!\w)/
        NUMBER: /(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?/
        NAME: /{NAME.pattern}/
        QUOTED: /"[^"\n]+"/
        %ignore /\s+/
    """
    return lark.Lark(
        grammar,
        parser="lalr",
        lexer="contextual",
        propagate_positions=True,
        maybe_placeholders=True,
    )


_GROUPS = (
    ({"NUMBER", "NAME", "QUOTED"}, "a signal or a number"),
    ({"NOT"}, "'!'"),
    ({"ALWAYS"}, "a temporal operator (always, eventually, ...)"),
    ({"LPAR"}, "'('"),
    ({"AND", "OR"}, "'&', '|', '->'"),
    ({"UNTIL"}, "until"),
    ({"COMPARISON"}, "a comparison (<=, >, ...)"),
    ({"PLUS"}, "arithmetic"),
    ({"UNIT"}, "a unit (s, ms, us, ns, min)"),
    ({"COMMA"}, "','"),
    ({"COLON"}, "':'"),
    ({"RPAR"}, "')'"),
    ({"LSQB"}, "'['"),
    ({"RSQB"}, "']'"),
    ({"$END"}, "the end"),
)


def _explained(error: Any, text: str) -> FormulaSyntaxError:
    import lark

    if not text.strip():
        return FormulaSyntaxError("a formula is needed; got an empty text", text, 0)
    at_end = isinstance(error, lark.UnexpectedEOF) or (
        isinstance(error, lark.UnexpectedToken) and error.token.type == "$END"
    )
    if at_end:
        position, width, found = len(text.rstrip()), 1, "the end of the text"
    elif isinstance(error, lark.UnexpectedToken):
        position = error.token.start_pos or 0
        width, found = len(error.token), f"{str(error.token)!r}"
    else:
        position = error.pos_in_stream or 0
        width, found = 1, f"{text[position]!r}"
    if found == "'='":
        return FormulaSyntaxError(
            "'=' is no comparison: write == for equal, >= or <=", text, position
        )
    if found == "')'" and text[:position].count("(") == text[:position].count(")"):
        return FormulaSyntaxError("there is no '(' for this ')'", text, position)
    expected = set(getattr(error, "accepts", None) or getattr(error, "expected", None) or ())
    expected |= set(getattr(error, "allowed", None) or ())
    words = [word for names, word in _GROUPS if names & expected]
    wanted = " or ".join(filter(None, (", ".join(words[:-1]), words[-1] if words else "")))
    return FormulaSyntaxError(f"expected {wanted}, but found {found}", text, position, width)


@dataclass
class _Part:
    """What a piece of the text means, and where it stands."""

    value: Formula | Expression
    start: int
    end: int
    #: In parentheses, so that nothing to the right could be thought to belong to it.
    closed: bool = False
    rule: str = ""


class _Builder:
    """Turns the tree of one text into a formula, refusing what is ambiguous or ill-typed."""

    def __init__(
        self, text: str, constants: Mapping[str, float], known: Mapping[str, Formula]
    ) -> None:
        self.text = text
        self.constants = constants
        self.known = known

    def formula(self, tree: Any) -> Formula:
        return self._formula(self._build(tree))

    def _fail(self, reason: str, start: int, end: int) -> FormulaSyntaxError:
        return FormulaSyntaxError(reason, self.text, start, end - start)

    def _source(self, part: _Part) -> str:
        return self.text[part.start : part.end]

    def _formula(self, part: _Part) -> Formula:
        if isinstance(part.value, Expression):
            if isinstance(part.value, ast.Number):
                raise self._fail(
                    f"a formula is needed here, not the number {self._source(part)}",
                    part.start,
                    part.end,
                )
            return ast.Atom(part.value)
        return part.value

    def _expression(self, part: _Part) -> Expression:
        if isinstance(part.value, Formula):
            raise self._fail(
                f"a number or a signal is needed here, not the formula {self._source(part)!r}",
                part.start,
                part.end,
            )
        return part.value

    def _build(self, tree: Any) -> _Part:
        return getattr(self, f"_{tree.data}".rstrip("_"))(tree)

    def _span(self, tree: Any) -> tuple[int, int]:
        return tree.meta.start_pos, tree.meta.end_pos

    def _operands(self, tree: Any) -> tuple[list[_Part], list[Any]]:
        return [self._build(c) for c in tree.children[::2]], tree.children[1::2]

    # Boolean connectives

    def _iff(self, tree: Any) -> _Part:
        parts, words = self._operands(tree)
        if len(words) > 1:
            raise self._chained(parts, words, "either")
        left, right = map(self._formula, parts)
        value = left.iff(right) if words[0].type == "IFF" else left ^ right
        return _Part(value, *self._span(tree), rule="iff")

    def _impl(self, tree: Any) -> _Part:
        parts, words = self._operands(tree)
        self._refuse_open(parts, words)
        if len(words) > 1:
            raise self._chained(parts, words, "right")
        left, right = map(self._formula, parts)
        return _Part(left >> right, *self._span(tree), rule="impl")

    def _or(self, tree: Any) -> _Part:
        return self._joined(tree, ast.Or)

    def _and(self, tree: Any) -> _Part:
        return self._joined(tree, ast.And)

    def _joined(self, tree: Any, kind: type[ast.And] | type[ast.Or]) -> _Part:
        parts, words = self._operands(tree)
        self._refuse_open(parts, words)
        for part in parts:
            if part.rule == "bin":
                word = next(c for c in words if c)
                raise self._fail(
                    f"until and its like beside {str(word)!r} is ambiguous: put it in "
                    f"parentheses, as in ({self._source(part)})",
                    part.start,
                    part.end,
                )
        value = kind(tuple(map(self._formula, parts)))
        return _Part(value, *self._span(tree), rule="join")

    def _bin(self, tree: Any) -> _Part:
        parts = [self._build(c) for c in tree.children[::3]]
        words, intervals = tree.children[1::3], tree.children[2::3]
        self._refuse_open(parts, words)
        if len(words) > 1:
            raise self._chained(parts, words, "right")
        left, right = map(self._formula, parts)
        interval = self._interval(intervals[0])
        a, b = interval.start, interval.end
        value = getattr(left, words[0].type.lower())(right, a, b)
        return _Part(value, *self._span(tree), rule="bin")

    def _chained(self, parts: list[_Part], words: list[Any], side: str) -> FormulaSyntaxError:
        a, b, c = map(self._source, parts[:3])
        between = [self.text[p.end : q.start].strip() for p, q in itertools.pairwise(parts)]
        first, second = between[0], between[1]
        word = str(words[1])
        return self._fail(
            f"a chain of {str(words[0])!r} is ambiguous: write {a} {first} ({b} {second} {c}) "
            f"or ({a} {first} {b}) {second} {c}",
            words[1].start_pos,
            words[1].start_pos + len(word),
        )

    def _refuse_open(self, parts: list[_Part], words: list[Any]) -> None:
        """`always a & b`: tools disagree on how far the word reaches."""
        for part, word in zip(parts, words, strict=False):
            if part.rule == "word" and not part.closed:
                operator, _, operand = self._source(part).partition(" ")
                tail = self._source(parts[-1]) if len(parts) == 2 else "..."
                raise self._fail(
                    f"how far {operator!r} reaches is ambiguous: write {operator} "
                    f"({operand.strip()} {word} {tail}) or ({self._source(part)}) {word} {tail}",
                    part.start,
                    part.end,
                )

    # Operators of one operand

    def _negation(self, tree: Any) -> _Part:
        part = self._build(tree.children[1])
        start, end = self._span(tree)
        return _Part(ast.Not(self._formula(part)), start, end, part.closed, part.rule)

    def _temporal(self, tree: Any) -> _Part:
        word, interval, operand = tree.children
        part = self._build(operand)
        value = self._formula(part)
        name = word.type.lower()
        if interval is not None and name not in _TIMED:
            raise self._fail(f"{str(word)!r} takes no interval", *self._span(interval))
        span = self._interval(interval)
        match name:
            case "next":
                value = ast.Next(value)
            case "prev" | "weak_prev":
                value = ast.Prev(value, weak=name.startswith("weak"))
            case _:
                value = getattr(ast, name.capitalize())(value, span)
        symbol = not str(word).rstrip("_").islower()
        rule = part.rule if symbol else "word"
        return _Part(value, *self._span(tree), closed=part.closed, rule=rule)

    def _interval(self, tree: Any) -> Interval:
        if tree is None:
            return ast.EVERYTHING
        low, high = (self._bound(child) for child in tree.children)
        span = self._span(tree)
        if low < 0:
            raise self._fail("an interval starts at 0 or later", *span)
        if high < low:
            raise self._fail(
                f"an interval ends no earlier than it starts: write "
                f"[{_text(self.text, tree.children[1])}, "
                f"{_text(self.text, tree.children[0])}]",
                *span,
            )
        if low == float("inf"):
            raise self._fail("an interval starts at a finite time", *span)
        return Interval(low, high)

    def _bound(self, tree: Any) -> float:
        if len(tree.children) == 1:
            name = str(tree.children[0])
            if name in ("inf", "infinity"):
                return float("inf")
            if name in self.constants:
                return float(self.constants[name])
            raise self._fail(
                str(unknown_name("constant", name, ["inf", *self.constants])), *self._span(tree)
            )
        minus, number, unit = tree.children
        value = float(Decimal(str(number)) * _UNITS[str(unit or "s")])
        return -value if minus else value

    # Comparisons and arithmetic

    def _cmp(self, tree: Any) -> _Part:
        parts, words = self._operands(tree)
        if len(words) > 1:
            a, b, c = map(self._source, parts[:3])
            raise self._fail(
                f"comparisons do not chain: write ({a} {words[0]} {b}) & ({b} {words[1]} {c})",
                words[1].start_pos,
                words[1].start_pos + len(words[1]),
            )
        left, right = map(self._expression, parts)
        value = ast.Predicate(str(words[0]), left, right)
        return _Part(value, *self._span(tree))

    def _sum(self, tree: Any) -> _Part:
        parts, words = self._operands(tree)
        value = self._expression(parts[0])
        for word, part in zip(words, parts[1:], strict=True):
            value = ast.Arithmetic(str(word), (value, self._expression(part)))
        return _Part(value, *self._span(tree))

    _product = _sum

    def _minus(self, tree: Any) -> _Part:
        part = self._build(tree.children[1])
        return _Part(-self._expression(part), *self._span(tree))

    def _number(self, tree: Any) -> _Part:
        return _Part(ast.Number(float(tree.children[0])), *self._span(tree))

    def _name(self, tree: Any) -> _Part:
        name = str(tree.children[0])
        if name in self.constants:
            return _Part(ast.Number(float(self.constants[name])), *self._span(tree))
        if name in self.known:
            return _Part(self.known[name], *self._span(tree))
        if name in FUNCTIONS:
            raise self._fail(
                f"{name} is a function: write {name}(...), or quote it if it is a signal",
                *self._span(tree),
            )
        return _Part(ast.Signal(name), *self._span(tree))

    def _quoted(self, tree: Any) -> _Part:
        return _Part(ast.Signal(str(tree.children[0])[1:-1]), *self._span(tree))

    def _true(self, tree: Any) -> _Part:
        return _Part(ast.TRUE, *self._span(tree), closed=True)

    def _false(self, tree: Any) -> _Part:
        return _Part(ast.FALSE, *self._span(tree), closed=True)

    def _component(self, tree: Any) -> _Part:
        vector, index = tree.children
        part = self._build(vector)
        try:
            value = self._expression(part)[int(str(index))]
        except ValueError:
            raise self._fail(
                "a component is a signal and a whole number, as in p[0]", *self._span(tree)
            ) from None
        return _Part(value, *self._span(tree))

    def _call(self, tree: Any) -> _Part:
        name, *arguments = tree.children
        span = self._span(tree)
        if str(name) not in FUNCTIONS:
            error = unknown_name("function", str(name), FUNCTIONS)
            raise self._fail(str(error), name.start_pos, name.start_pos + len(name))
        parts = tuple(self._expression(self._build(c)) for c in arguments)
        try:
            return _Part(ast.Arithmetic(str(name), parts), *span)
        except ValueError as error:
            raise self._fail(str(error), *span) from None

    def _parens(self, tree: Any) -> _Part:
        part = self._build(tree.children[0])
        return _Part(part.value, *self._span(tree), closed=True)


def _text(text: str, tree: Any) -> str:
    """The piece of `text` that a node of the tree was read from."""
    return text[tree.meta.start_pos : tree.meta.end_pos]
