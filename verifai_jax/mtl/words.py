"""The table of operators, the words of the text grammar, and the composition of texts.

    number_text(2.0), name_text("theta")                          # '2', 'theta'
    operator_text("always", "[0,4]", [Text("x <= 2", "leaf")])    # 'always[0,4] (x <= 2)'
    OPERATORS["always"].latex                                     # a backslash and 'Box'

This file does not depend on formulas, which pass their operator's word and their operands' texts.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")
"""Names of signals, constants and definitions that need no quotes."""
FUNCTIONS = {
    "abs": 1, "sqrt": 1, "sin": 1, "cos": 1, "exp": 1, "norm": 1, "min": 2, "max": 2
}  # fmt: skip
"""Functions of expressions, with the smallest number of their arguments."""
NUMBERS = {"pi": math.pi}
"""Numbers that a text may name without defining them; a signal of that name stands in quotes."""
TIMES = {
    "s": "1", "ms": "1e-3", "us": "1e-6", "ns": "1e-9", "min": "60", "h": "3600", "d": "86400"
}  # fmt: skip
"""Units that may follow a time, in seconds, as decimal numbers."""
ANGLES = {"deg": math.pi / 180, "rad": 1.0}
"""Units that may follow a number in an expression, in rad."""


class Comparison(NamedTuple):
    """A comparison of two expressions in LaTeX and in English, and that which negates it."""

    latex: str
    english: str
    opposite: str


COMPARISONS = {
    "<=": Comparison(r"\leq", "is at most", ">"),
    "<": Comparison("<", "is below", ">="),
    ">=": Comparison(r"\geq", "is at least", "<"),
    ">": Comparison(">", "is above", "<="),
    "==": Comparison("=", "equals", "!="),
    "!=": Comparison(r"\neq", "differs from", "=="),
}
"""Every comparison by its symbol."""


@dataclass(frozen=True)
class Operator:
    """The description of an operator; its node in `formula` defines its meaning.

    - `words`: the words and symbols that are read as this operator; the first is its name.
    - `latex`: symbol in LaTeX.
    - `english`: sentence, with `{0}` and `{1}` for the operands and `{when}` for the interval.
    - `operands`: 1 for a prefix operator, 2 for an infix operator.
    - `side`: the direction in which it looks; empty for a Boolean connective.
    - `timed`: whether it takes an interval.
    - `symbol`: the symbol printed instead of the first word.
    - `dual`: the operator that replaces it when a negation moves inwards: `!always f` is
      `eventually !f`; empty without a dual node.
    """

    words: tuple[str, ...]
    latex: str
    english: str
    operands: Literal[1, 2] = 1
    side: Literal["", "ahead", "back"] = ""
    timed: bool = False
    symbol: str = ""
    dual: str = ""

    @property
    def word(self) -> str:
        """The word that is its name."""
        return self.words[0]


OPERATORS: dict[str, Operator] = {
    operator.word: operator
    for operator in (
        Operator(
            ("always", "alw", "G", "[]"), r"\Box", "at all times{when}, {0}",
            side="ahead", timed=True, dual="eventually",
        ),
        Operator(
            ("eventually", "ev", "F", "<>"), r"\Diamond", "at some time{when}, {0}",
            side="ahead", timed=True, dual="always",
        ),
        Operator(
            ("historically", "hist", "H"), r"\boxminus", "at all times until now{when}, {0}",
            side="back", timed=True, dual="once",
        ),
        Operator(
            ("once", "O"), r"\diamondminus", "at some time until now{when}, {0}",
            side="back", timed=True, dual="historically",
        ),
        Operator(
            ("next", "X", "@"), r"\bigcirc", "at the next sample, {0}", side="ahead", dual="next",
        ),
        Operator(
            ("prev", "Y"), r"\ominus", "at the previous sample, {0}",
            side="back", dual="weak_prev",
        ),
        Operator(
            ("weak_prev",), r"\widetilde{\ominus}",
            "at the previous sample, if there is one, {0}", side="back", dual="prev",
        ),
        Operator(("rise",), r"\uparrow", "{0} begins to hold", side="back"),
        Operator(("fall",), r"\downarrow", "{0} ceases to hold", side="back"),
        Operator(
            ("until", "U"), r"\mathbin{\mathcal{U}}", "{0} until, at some time{when}, {1}",
            operands=2, side="ahead", timed=True,
        ),
        Operator(
            ("weak_until", "unless", "W"), r"\mathbin{\mathcal{W}}",
            "{0} until {1}{when}, or all the time", operands=2, side="ahead", timed=True,
        ),
        Operator(
            ("release", "R"), r"\mathbin{\mathcal{R}}",
            "{1} until {0} frees it{when}, or all the time", operands=2, side="ahead", timed=True,
        ),
        Operator(
            ("since", "S"), r"\mathbin{\mathcal{S}}", "{0} since, at some time{when}, {1}",
            operands=2, side="back", timed=True,
        ),
        Operator(("not", "!", "~"), r"\lnot", "it is not so that {0}", symbol="!"),
        Operator(
            ("and", "&&", "&"), r"\land", "{0} and {1}", operands=2, symbol="&", dual="or"
        ),
        Operator(("or", "||", "|"), r"\lor", "{0} or {1}", operands=2, symbol="|", dual="and"),
        Operator(
            ("implies", "->", "=>"), r"\rightarrow", "whenever {0}, {1}", operands=2, symbol="->"
        ),
        Operator(
            ("iff", "<->"), r"\leftrightarrow", "{0} exactly when {1}", operands=2, symbol="<->"
        ),
        # The symbol `^` is read, and not printed: it is read as a power, too.
        Operator(
            ("xor", "^"), r"\oplus", "either {0} or {1}, and not both", operands=2, symbol="xor"
        ),
    )
}  # fmt: skip
"""Every operator by its word: the one table that parsing, printing, rewriting, horizons, LaTeX and
English read."""
WORDS: dict[str, tuple[str, ...]] = {
    **{word: operator.words for word, operator in OPERATORS.items()},
    "TRUE": ("TRUE", "True", "true"),
    "FALSE": ("FALSE", "False", "false"),
}
"""Every word and symbol of the text grammar, by the operator or constant it stands for."""
RESERVED = frozenset(w for words in WORDS.values() for w in words if NAME.fullmatch(w))
"""Words that a signal's name can only be in quotes."""


class Text(NamedTuple):
    """The text of a formula.

    - `text`: the text without outer parentheses.
    - `kind`: the kind of the text, which decides on parentheses: a `name` or constant, another
      `leaf`, a `negation`, another `prefix` operator, or an `infix` operator.
    """

    text: str
    kind: Literal["name", "leaf", "negation", "prefix", "infix"]

    def wrapped(self) -> str:
        """Return the text in parentheses, except for a name."""
        return self.text if self.kind == "name" else f"({self.text})"


def number_text(value: float) -> str:
    """Return the shortest text that parses to the same float; `inf` for infinity."""
    return str(int(value)) if abs(value) < 1e16 and value == int(value) else repr(value)


def name_text(name: str) -> str:
    """Return a signal's name, quoted if the grammar requires it."""
    taken = name in RESERVED or name in FUNCTIONS or name in NUMBERS
    bare = NAME.fullmatch(name) and not taken
    return name if bare else f'"{name}"'


def operator_text(word: str, interval: str, operands: Sequence[Text]) -> Text:
    """Return the text of an operator over operands.

    **Arguments:**
    - `word`: operator, a key of `OPERATORS`.
    - `interval`: text of its interval; empty if it has none.
    - `operands`: text of its operands.
    """
    symbol = OPERATORS[word].symbol
    if symbol and len(operands) == 1:
        return Text(f"{symbol}{operands[0].wrapped()}", "negation")
    if symbol:
        plain = ("name", "leaf", "negation")
        texts = [part.text if part.kind in plain else f"({part.text})" for part in operands]
        if word == "implies" and operands[1].kind == "prefix":
            texts[1] = operands[1].text
        return Text(f" {symbol} ".join(texts), "infix")
    if len(operands) == 1:
        (operand,) = operands
        chain = operand.kind in ("negation", "prefix")
        text = operand.text if chain else operand.wrapped()
        return Text(f"{word}{interval} {text}", "prefix")
    left, right = (operand.wrapped() for operand in operands)
    return Text(f"{left} {word}{interval} {right}", "infix")
