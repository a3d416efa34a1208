"""The parser of formulas: `parse("always[0, 4] (abs(x) <= 2.4 & F[0,500ms] safe)")`.

One LALR grammar covers Boolean and arithmetic expressions, because two would collide on
parentheses; what may stand where is checked afterwards, on the tree, by `FormulaBuilder`. It reads
more than it accepts, so that an error can say what is meant.
"""

import re
from collections.abc import Mapping

from verifai_jax.mtl.expression_builder import MAX_DEPTH
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.formula_builder import FormulaBuilder
from verifai_jax.mtl.grammar import FormulaSyntaxError, explain_error, parser
from verifai_jax.mtl.words import NAME

MAX_TOKENS = 10_000
"""Words and symbols that a formula's text may have. Far more than a person writes: a file that
is given by mistake is refused before it is parsed."""

MAX_OFFERED = 300
"""Characters of a text that an error offers at most; a longer one would be cut when it is shown."""

_TOKEN = re.compile(r'"[^"\n]*"|[\w.]+|\S')


def parse(
    text: str,
    constants: Mapping[str, float] | None = None,
    definitions: Mapping[str, Formula | str] | None = None,
) -> Formula:
    """Read a formula from its text.

    **Arguments:**

    - `text`: see the grammar in the documentation; times are in seconds unless a unit follows.
    - `constants`: numbers by name, also usable as the ends of intervals.
    - `definitions`: sub-formulas by name, as text or formulas; a text may use the names before it.

    A text has at most 10 000 words and symbols; parentheses stand at most 100 deep within each
    other, and so do operators, of which `<->`, `xor`, weak until and release are made of several;
    temporal operators stand at most 40 deep.

    **Raises:** `FormulaSyntaxError`, with a caret under the error and what is expected there.
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

    _check_size(text)
    try:
        tree = parser().parse(text)
    except lark.UnexpectedInput as error:
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
