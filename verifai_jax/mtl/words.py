"""The words of the text grammar, and how operators are put together from the text of their parts.

    number_text(2.0), name_text("theta")                          # '2', 'theta'
    operator_text("always", "[0,4]", [Text("x <= 2", "leaf")])    # 'always[0,4] (x <= 2)'

Nothing here knows formulas: they hand over their operator's word and the text of their operands.
"""

import math
import re
from collections.abc import Sequence
from typing import Literal, NamedTuple

NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")
"""Names of signals, constants and definitions that need no quotes."""

FUNCTIONS = {"abs": 1, "sqrt": 1, "sin": 1, "cos": 1, "norm": 1, "min": 2, "max": 2}
"""Functions of expressions, by the least number of their arguments."""

NUMBERS = {"pi": math.pi}
"""Numbers that a text may name without defining them; a signal of that name stands in quotes."""

ANGLES = {"deg": math.pi / 180, "rad": 1.0}
"""Units that may follow a number in an expression, in rad."""

WORDS: dict[str, tuple[str, ...]] = {
    "always": ("always", "alw", "G", "[]"),
    "eventually": ("eventually", "ev", "F", "<>"),
    "historically": ("historically", "hist", "H"),
    "once": ("once", "O"),
    "next": ("next", "X", "@"),
    "prev": ("prev", "Y"),
    "weak_prev": ("weak_prev",),
    "until": ("until", "U"),
    "weak_until": ("weak_until", "unless", "W"),
    "release": ("release", "R"),
    "since": ("since", "S"),
    "not": ("not", "!", "~"),
    "and": ("and", "&&", "&"),
    "or": ("or", "||", "|"),
    "implies": ("implies", "->", "=>"),
    "iff": ("iff", "<->"),
    "xor": ("xor", "^"),
    "TRUE": ("TRUE", "True", "true"),
    "FALSE": ("FALSE", "False", "false"),
}
"""Every word and symbol of the text grammar, by the operator it stands for."""

RESERVED = frozenset(w for words in WORDS.values() for w in words if NAME.fullmatch(w))
"""Words that a signal's name can only be in quotes."""

SYMBOLS = {"and": "&", "or": "|", "implies": "->", "iff": "<->", "xor": "xor"}
"""Boolean connectives as they are printed: symbols, but for `^`, which is read as a power too."""


class Text(NamedTuple):
    """The text of a formula.

    - `text`: without parentheses around it.
    - `kind`: what it is within another operator: a `name` or constant, another `leaf`, a
      `negation`, another operator in front of its one operand (`prefix`), or one between operands
      (`infix`).
    """

    text: str
    kind: Literal["name", "leaf", "negation", "prefix", "infix"]

    def wrapped(self) -> str:
        """Return the text in parentheses, which a name does without."""
        return self.text if self.kind == "name" else f"({self.text})"


def number_text(value: float) -> str:
    """Return the shortest text that reads back as the same float; `inf` for infinity."""
    return str(int(value)) if abs(value) < 1e16 and value == int(value) else repr(value)


def name_text(name: str) -> str:
    """Return a signal's name, quoted where the grammar would not take it bare."""
    taken = name in RESERVED or name in FUNCTIONS or name in NUMBERS
    bare = NAME.fullmatch(name) and not taken
    return name if bare else f'"{name}"'


def operator_text(word: str, interval: str, operands: Sequence[Text]) -> Text:
    """Return the text of an operator over operands.

    **Arguments:**

    - `word`: operator, a key of `WORDS`.
    - `interval`: text of its interval; empty where it has none.
    - `operands`: text of its operands.
    """
    if word in SYMBOLS:
        plain = ("name", "leaf", "negation")
        texts = [part.text if part.kind in plain else f"({part.text})" for part in operands]
        if word == "implies" and operands[1].kind == "prefix":
            texts[1] = operands[1].text
        return Text(f" {SYMBOLS[word]} ".join(texts), "infix")
    if word == "not":
        return Text(f"!{operands[0].wrapped()}", "negation")
    if len(operands) == 1:
        (operand,) = operands
        chain = operand.kind in ("negation", "prefix")
        text = operand.text if chain else operand.wrapped()
        return Text(f"{word}{interval} {text}", "prefix")
    left, right = (operand.wrapped() for operand in operands)
    return Text(f"{left} {word}{interval} {right}", "infix")
