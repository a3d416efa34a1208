"""The text grammar of formulas: its parser, and its error messages."""

import difflib
import functools
import re
from typing import Any, Protocol, runtime_checkable

from verifai_jax.core.display.lazy import uncollected
from verifai_jax.mtl.words import ANGLES, NAME, OPERATORS, RESERVED, TIMES, WORDS

_BEFORE, _BETWEEN = (
    tuple(word for word, o in OPERATORS.items() if o.side and o.operands == n) for n in (1, 2)
)
"""Temporal operators in front of one operand, and between two."""
_OPERATOR = {option: word for word in (*_BEFORE, *_BETWEEN) for option in WORDS[word]}
_MAX_SHOWN = 400
"""Greatest number of characters of a text that an error shows: a few lines of a terminal."""
_MAX_REASON = 800
"""Greatest number of characters of what an error says, which may quote parts of the text: twice
what is shown of a text, so that a quotation and the advice fit."""


class FormulaSyntaxError(ValueError):
    """An error for a text that is not a formula; the message shows the position and a correction.

    `position` is the offset of the error in the text.
    """

    def __init__(self, reason: str, text: str, position: int, width: int = 1) -> None:
        self.position = position
        if len(reason) > _MAX_REASON:
            half = _MAX_REASON // 2
            reason = f"{reason[:half]} ... {reason[-half:]}"
        before = text[:position]
        line = before.count("\n")
        shown = text.split("\n")[line]
        column = position - (before.rfind("\n") + 1)
        if len(shown) > _MAX_SHOWN:
            # Around the error alone: a text may be as long as a book.
            cut = max(0, column - _MAX_SHOWN // 2)
            shown, column = shown[cut : cut + _MAX_SHOWN], column - cut
        carets = "^" * max(1, min(width, len(shown) - column))
        super().__init__(f"{reason}\n  {shown}\n  {' ' * column}{carets}")


@runtime_checkable
class Extent(Protocol):
    """A part of the text, from `start_pos` up to `end_pos`, which is excluded."""

    start_pos: int
    end_pos: int


@runtime_checkable
class Tree(Protocol):
    """A node of the parser's tree: a rule, and its parts (trees, words of the text, or None)."""

    data: str
    children: list[Any]
    meta: Extent


@functools.cache
@uncollected()
def parser(units: tuple[str, ...] = ()) -> Any:
    """Return the LALR parser, made once.

    **Arguments:**
    - `units`: words that may follow a number, besides times and angles.
    """
    import lark

    known = sorted({*TIMES, *ANGLES, *units}, key=len, reverse=True)
    after = "|".join(re.escape(unit).replace("/", r"\/") for unit in known)

    def keyword(*words: str) -> str:
        # An underscore may join an operator to its interval: `alw_[0,10]`.
        joint = r"(?:(?![\w.])|_(?=\s*\[))"
        alternatives = []
        for option in sorted((o for word in words for o in WORDS[word]), key=len, reverse=True):
            if NAME.fullmatch(option):
                alternatives.append(option + joint)
            else:
                escaped = "".join("\\" + c for c in option)
                alternatives.append(escaped + r"(?:_(?=\s*\[))?")
        return f"/{'|'.join(alternatives)}/"

    # XOR, IFF and IMPLIES come before the comparisons that start like them.
    joints = "\n".join(
        f"{w.upper()}.4: {keyword(w)}" for w in ("iff", "xor", "implies", "or", "and")
    )
    # One terminal for all operators of a kind: the parser's tables grow with their number, and it
    # is made in each process.
    grammar = rf"""
        ?start: iff
        ?iff: impl ((IFF | XOR) impl)*
        ?impl: or_ (IMPLIES or_)*
        ?or_: and_ (OR and_)*
        ?and_: bin (AND bin)*
        ?bin: unary (BETWEEN [interval] unary)*
        ?unary: NOT unary -> negation
              | BEFORE [interval] unary -> temporal
              | cmp
        ?cmp: sum (COMPARISON sum)*
        ?sum: product ((PLUS | MINUS) product)*
        ?product: factor ((STAR | SLASH) factor)*
        ?factor: MINUS factor -> minus
               | power
        ?power: postfix (POWER exponent)*
        ?exponent: MINUS exponent -> minus
                 | postfix
        ?postfix: atom
                | atom "[" NUMBER "]" -> component
        ?atom: NUMBER [UNIT] -> number
             | NAME -> name
             | QUOTED -> quoted
             | TRUE -> true
             | FALSE -> false
             | NAME "(" _argument ("," _argument)* ")" -> call
             | "(" iff ")" -> parens
        _argument: iff | interval
        interval: (LSQB | LPAR) bound ("," | ":") bound (RSQB | RPAR)
        bound: [MINUS] NUMBER [UNIT] | NAME

        BEFORE.3: {keyword(*_BEFORE)}
        BETWEEN.3: {keyword(*_BETWEEN)}
        {joints}
        NOT.2: {keyword("not")}
        TRUE.3: {keyword("TRUE")}
        FALSE.3: {keyword("FALSE")}
        COMPARISON.3: />=|<=|==|!=|>|</
        PLUS: "+"
        MINUS: "-"
        POWER: "**"
        STAR: "*"
        SLASH: "/"
        UNIT.5: /(?:{after})(?!\w|\/[A-Za-z]|\^|\*\*)/
        LSQB: "["
        RSQB: "]"
        LPAR: "("
        RPAR: ")"
        NUMBER: /(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?/
        NAME: /{NAME.pattern}/
        QUOTED: /"[^"\n]+"/
        %ignore /\s+/
    """
    return lark.Lark(
        grammar, parser="lalr", lexer="contextual", propagate_positions=True,
        maybe_placeholders=True,
    )  # fmt: skip


def operator_of(word: str) -> str:
    """Return the name of a temporal operator from its word in a text."""
    return _OPERATOR[word] if word in _OPERATOR else _OPERATOR[word.removesuffix("_")]


_GROUPS = (
    ({"NUMBER", "NAME", "QUOTED"}, "a signal or a number"),
    ({"NOT"}, "'!'"),
    ({"BEFORE"}, "a temporal operator (always, eventually, ...)"),
    ({"LPAR"}, "'('"),
    ({"AND", "OR"}, "'&', '|', '->'"),
    ({"BETWEEN"}, "until"),
    ({"COMPARISON"}, "a comparison (<=, >, ...)"),
    ({"PLUS"}, "arithmetic"),
    ({"UNIT"}, "a unit (s, ms, us, ns, min, h, d)"),
    ({"COMMA"}, "','"),
    ({"COLON"}, "':'"),
    ({"RPAR"}, "')'"),
    ({"LSQB"}, "'['"),
    ({"RSQB"}, "']'"),
    ({"$END"}, "the end"),
)


def explain_error(error: Exception, text: str) -> FormulaSyntaxError:
    """Turn an error of the parser into one that shows its position and the expected words."""
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
        position = getattr(error, "pos_in_stream", None) or 0
        width, found = 1, f"{text[position]!r}"
    if found == "'='":
        return FormulaSyntaxError(
            "'=' is not a comparison: write == for equal, >= or <=", text, position
        )
    if found == "')'" and text[:position].count("(") == text[:position].count(")"):
        return FormulaSyntaxError("there is no '(' for this ')'", text, position)
    expected = set(getattr(error, "accepts", None) or getattr(error, "expected", None) or ())
    expected |= set(getattr(error, "allowed", None) or ())
    words = [word for names, word in _GROUPS if names & expected]
    wanted = " or ".join(filter(None, (", ".join(words[:-1]), words[-1] if words else "")))
    advice = _habit(text, position, bool(expected & {"NUMBER"})) or _misspelt_word(text[:position])
    message = f"expected {wanted}, but found {found}{advice}"
    return FormulaSyntaxError(message, text, position, width)


def _habit(text: str, position: int, operand: bool) -> str:
    """Return advice on what is written otherwise elsewhere: `|x|`, and units of numbers."""
    bars = re.match(r"\|([^|]+)\|", text[position:]) if operand else None
    if bars:
        return f"; write abs({bars[1].strip()}) for {bars[0]}"
    number = re.search(r"(?<![\w.])([\d.]+)\s*$", text[:position])
    unit = re.match(r"%|[A-Za-z][\w/^]*", text[position:])
    if not (number and unit and unit[0] not in RESERVED):
        return ""
    return (
        f"; if {unit[0]!r} is a unit, leave it out and give the number in the unit of the signal, "
        "or in one of vj.mtl.UNITS"
    )


def _misspelt_word(before: str) -> str:
    """Suggest the operator that was probably meant by the name at the end of a text."""
    name = re.search(r"([A-Za-z_]\w*)\s*(\[[^\]]*\]?)?\s*$", before)
    if name is None or name[1] in RESERVED:
        return ""
    near = difflib.get_close_matches(name[1], [w for w in RESERVED if len(w) > 3], n=1, cutoff=0.75)
    return f"; did you mean {near[0]!r} instead of {name[1]!r}?" if near else ""
