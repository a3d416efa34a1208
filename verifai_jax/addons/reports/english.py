"""Formulas in English, for readers who do not know their notation.

formula_words(parse("always[0, 4] abs(x) <= 2.4"))
# 'at all times from 0 s to 4 s, abs(x) is at most 2.4'
"""

import functools
import math

from verifai_jax.core.messages.text import format_seconds
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.formula import Formula, Interval, Term, surface
from verifai_jax.mtl.sampled import Sampled, window_text
from verifai_jax.mtl.tree import postorder
from verifai_jax.mtl.words import COMPARISONS, OPERATORS


def formula_words(formula: Formula) -> str:
    """Write a formula in English."""
    return _words(formula, inner=False)


def _words(formula: Formula, inner: bool) -> str:
    match formula:
        case ast.Constant(value):
            return "anything is allowed" if value else "nothing is allowed"
        case ast.Predicate(comparison, left, right):
            return f"{_term(left)} {COMPARISONS[comparison].english} {_term(right)}"
        case ast.Atom(expression):
            return f"{expression} is positive"
    word, operands, interval = surface(formula)
    operator = OPERATORS[word]
    first, *others = (_words(part, inner=True) for part in operands)
    when = "" if interval is None or interval.everything else _when(interval, operator.side)

    def joined(one: str, *other: str) -> str:
        return operator.english.format(one, *other, when=when)

    text = functools.reduce(joined, others, first) if others else joined(first)
    return f"({text})" if inner else text


def _term(e: Term) -> str:
    if not isinstance(e, Sampled):
        text = str(e)
        for part in postorder(e):
            text = (
                text.replace(str(part), f"({_term(part)})") if isinstance(part, Sampled) else text
            )
        return text
    parts = (
        _words(part, inner=True) if isinstance(part, Formula) else _term(part)
        for part in e.operands
    )
    window = e.window
    if window is not None and window_text(window)[0].isdigit():
        span = f"the last {format_seconds(window.end)}"
    else:
        span = "" if window is None else f"the time{_when(window, 'back').removeprefix(',')}"
    return e.english.format(*parts, window=span)


def _when(interval: Interval, side: str) -> str:
    start, endless = format_seconds(interval.start), interval.end == math.inf
    end = "" if endless else f"to {format_seconds(interval.end)}"
    ends = ((start, interval.open_start), (format_seconds(interval.end), interval.open_end))
    without = " and ".join(text for text, is_open in ends if is_open)
    without = f" (without {without})" if without else ""
    if side == "back":
        return f", {start} {'ago or earlier' if endless else f'{end} ago'}{without}"
    return f" from {start} {'on' if endless else end}{without}"
