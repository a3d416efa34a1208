"""Texts for the parser: formulas, formulas with faults in them, and no formulas at all.

What must hold: a text is a formula or a `FormulaSyntaxError` with a caret, in less than two seconds
of CPU; a formula is printed, compared, hashed, rewritten and evaluated, and what is printed reads
back as the same formula.
"""

import random
import time

import numpy as np

from benchmarks.faults.cases import Broken, chance
from verifai_jax import Trace, mtl
from verifai_jax.mtl.words import WORDS

MAX_SECONDS = 2.0
"""CPU seconds for each thing that is done with a text."""
EVALUATED = 40
"""Every so many formulas one is evaluated: its program is compiled, and thrown away."""
_NAMES = ("x", "y", "gap", "ego.speed", '"odd name"', "p[0]", "norm(p)", "_a1")
_NUMBERS = ("0", "1", "2.5", "1e3", "-4", ".5", "1e-300", "0.1")
_HOSTILE = (
    "1e999", "9" * 400, "nan", "inf", "\0", "\x1b[2J", "\u202e", "é", "∞", "🚗", "'", '"', "\\",
    "__import__('os')", "lambda: 0", "%s%n", "{x}", "$(id)", "1e-9999", "0x10", "x.y.z", "0/0",
    "[", "]", "[[", "[0,", ",", ";", "#", "\n", "\r\n", "\t", " " * 300, "(" * 90, ")" * 90,
    "!" * 90, "-" * 90, "G " * 30, "x**" * 9, "x^2", "^", "<->", "1 < 2", "[1e9999999,2]",
)  # fmt: skip


def case(number: int) -> str:
    """Try the text with this number.

    **Returns:** `formula`, `evaluated` or `refused`.
    """
    random_ = chance(number, "formulas")
    text = _text(random_)
    formula = _within("reading", _parsed, text)
    if formula is None:
        return "refused"
    _within("everything else", _used, formula)
    if number % EVALUATED or formula.depth > 12 or len(text) > 400:
        return "formula"
    _evaluated(formula, random_)
    return "evaluated"


def _within(what, function, *arguments):
    begun = time.process_time()
    value = function(*arguments)
    spent = time.process_time() - begun
    if spent > MAX_SECONDS:
        raise Broken(f"{what} took {spent:.1f} s: {arguments[0]!s:.200}")
    return value


def _parsed(text: str) -> mtl.Formula | None:
    try:
        return mtl.parse(text)
    except mtl.FormulaSyntaxError as error:
        message = str(error)
        if "^" not in message.splitlines()[-1]:
            raise Broken(f"no caret under {text[:200]!r}: {message[:300]!r}") from None
        if len(message) > 3000:
            raise Broken(f"{len(message)} characters for {text[:200]!r}") from None
        return None


def _used(formula: mtl.Formula) -> None:
    printed = str(formula)
    again = mtl.parse(printed)
    if again != formula or hash(again) != hash(formula):
        raise Broken(f"{printed[:300]!r} reads back as {str(again)[:300]!r}")
    mtl.latex(formula)
    mtl.nnf(mtl.simplify(formula))
    if formula.horizon(0.1) < 0 or not isinstance(formula.signals(), tuple):
        raise Broken(f"no horizon or no signals: {printed[:300]!r}")


def _evaluated(formula: mtl.Formula, random_: random.Random) -> None:
    vectors = {"p"}
    signals = {
        name: np.array([[random_.gauss(0, 3) for _ in range(3)] for _ in range(5)])
        if name in vectors
        else np.array([random_.gauss(0, 3) for _ in range(5)])
        for name in formula.signals()
    }
    trace = Trace(signals or {"x": np.zeros(5)}, dt=0.5)
    try:
        # In single precision a constant of the text may be infinite.
        with np.errstate(over="ignore"):
            value = float(mtl.robustness(formula, trace))
            simpler = float(mtl.robustness(mtl.simplify(formula), trace))
    except (TypeError, mtl.IntervalError):
        return  # A vector where a number is needed, or an interval between two samples.
    same = np.isclose(value, simpler, rtol=1e-4, atol=1e-4, equal_nan=True)
    if not (same or np.isnan(value) or np.isnan(simpler)):
        raise Broken(f"{str(formula)[:300]!r} is {value}, simplified {simpler}")


def _text(random_: random.Random) -> str:
    kind = random_.random()
    if kind < 0.05:
        return "".join(chr(random_.choice((random_.randrange(128), random_.randrange(0x3000))))
                       for _ in range(random_.randrange(80)))  # fmt: skip
    if kind < 0.1:
        return _large(random_)
    text = _formula(random_, random_.randrange(1, 7))
    for _ in range(random_.choice((0, 0, 0, 1, 1, 2, 4))):
        text = _damaged(text, random_)
    return text


def _formula(random_: random.Random, depth: int) -> str:
    def word(name: str) -> str:
        return random_.choice(WORDS[name])

    def below() -> str:
        return f"({_formula(random_, depth - 1)})"

    kind = random_.random()
    if depth <= 0 or kind < 0.15:
        sign = random_.choice(("<", "<=", ">", ">=", "==", "!="))
        return f"{_expression(random_, 2)} {sign} {_expression(random_, 2)}"
    if kind < 0.2:
        return random_.choice(("TRUE", "FALSE", *_NAMES))
    if kind < 0.3:
        return f"{word('not')} {below()}"
    if kind < 0.6:
        name = random_.choice(("always", "eventually", "historically", "once", "next", "prev"))
        span = "" if name in ("next", "prev") else _interval(random_)
        return f"{word(name)}{span} {below()}"
    if kind < 0.75:
        name = random_.choice(("until", "weak_until", "release", "since"))
        return f"{below()} {word(name)}{_interval(random_)} {below()}"
    if kind < 0.9:
        name = random_.choice(("and", "or"))
        return f" {word(name)} ".join(below() for _ in range(random_.randrange(2, 5)))
    return f"{below()} {word(random_.choice(('implies', 'iff', 'xor')))} {below()}"


def _expression(random_: random.Random, depth: int) -> str:
    kind = random_.random()
    if depth <= 0 or kind < 0.5:
        return random_.choice((*_NAMES, *_NUMBERS))
    left, right = (_expression(random_, depth - 1) for _ in range(2))
    if kind < 0.75:
        return f"({left} {random_.choice('+-*/')} {right})"
    if kind < 0.8:
        return f"({left})**{random_.choice(('2', '3', '-1', '0.5', f'({right})'))}"
    name = random_.choice(("abs", "sqrt", "sin", "cos", "min", "max"))
    return f"{name}({left}, {right})" if name in ("min", "max") else f"{name}({left})"


def _interval(random_: random.Random) -> str:
    if random_.random() < 0.4:
        return ""
    start, length = random_.choice((0, 0, 1, 2)), random_.choice((0, 1, 3, 10))
    unit = random_.choice(("", "", "s"))
    end = "inf" if random_.random() < 0.2 else f"{(start + length) / 2:g}{unit}"
    return f"[{start / 2:g}{unit},{end}]"


def _damaged(text: str, random_: random.Random) -> str:
    i, j = sorted(random_.randrange(len(text) + 1) for _ in range(2))
    match random_.randrange(6):
        case 0:
            return text[:i] + text[j:]
        case 1:
            return text[:j] + text[i:j] + text[j:]
        case 2:
            return text[:i] + random_.choice(_HOSTILE) + text[i:]
        case 3:
            return text[:i] + random_.choice("()[],.<>=!&|^*/+-~@ \"'0123456789xyzGFUe") + text[i:]
        case 4:
            return text[:i] + text[j:] + text[i:j]
    words = text.split(" ")
    random_.shuffle(words)
    return " ".join(words)


def _large(random_: random.Random) -> str:
    """Return a text that is wide or deep, around what is allowed and far beyond it."""
    size = random_.choice((30, 90, 101, 250, 3000, 20_000))
    end = random_.choice(("x > 0", "(x > 0)", "x", "1", ""))
    opening = random_.choice(("(", "!", "G ", "F[0,1] ", "-", "abs(", "(x > 0 & ", "(y <-> "))
    closing = ")" * (opening.count("(") * size * (random_.random() < 0.9))
    if random_.random() < 0.5:
        return opening * size + end + closing
    return random_.choice((" & ", " | ", " + ", " <-> ", " U ", ", ", "**")).join([end] * size)
