"""Formulas, domains and values in words, for readers who know neither notation.

formula_words(parse("always[0, 4] abs(x) <= 2.4"))
# 'at all times from 0 s to 4 s, abs(x) is at most 2.4'
domain_words(Box(-1, 1))                            # 'uniform between -1 and 1'
"""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.core.text import format_percent, format_seconds, one_line
from verifai_jax.features import Domain
from verifai_jax.features.arrays import Array, VariableArray
from verifai_jax.features.box import Box, DiscreteBox
from verifai_jax.features.choice import Categorical, Constant
from verifai_jax.features.compound import Struct
from verifai_jax.features.continuous import Continuous
from verifai_jax.features.custom import Distribution
from verifai_jax.features.distributions import LogUniform, Normal, TruncatedNormal
from verifai_jax.features.families import Exponential, LogNormal, Triangular, Weibull
from verifai_jax.features.fixed import Fixed
from verifai_jax.features.signal import Signal
from verifai_jax.features.tabulated import Beta, Empirical, Gamma
from verifai_jax.mtl import Formula
from verifai_jax.mtl.formula import Atom, Interval, Predicate, surface
from verifai_jax.mtl.formula import Constant as Truth

COMPARISONS = {
    "<=": "is at most",
    "<": "is below",
    ">=": "is at least",
    ">": "is above",
    "==": "equals",
    "!=": "differs from",
}
"""Each comparison of signals as it is read."""
UNARY = {
    "always": "at all times{span}, {0}",
    "eventually": "at some time{span}, {0}",
    "historically": "at all times until now{back}, {0}",
    "once": "at some time until now{back}, {0}",
    "next": "at the next sample, {0}",
    "prev": "at the previous sample, {0}",
    "weak_prev": "at the previous sample, if there is one, {0}",
    "not": "it is not so that {0}",
}
"""Operators of one part as they are read."""
BINARY = {
    "until": "{0} until, at some time{span}, {1}",
    "weak_until": "{0} until {1}{within}, or all the time",
    "release": "{1} until {0} frees it{within}, or all the time",
    "since": "{0} since, at some time{back}, {1}",
    "implies": "whenever {0}, {1}",
    "iff": "{0} exactly when {1}",
    "xor": "either {0} or {1}, and not both",
}
"""Operators of two parts as they are read."""
MOST_CHOICES = 12
"""Choices that are listed one by one."""


def formula_words(formula: Formula) -> str:
    """Write a formula in words."""
    return _words(formula, inner=False)


def _words(formula: Formula, inner: bool) -> str:
    match formula:
        case Truth():
            return "anything is allowed" if formula.value else "nothing is allowed"
        case Predicate():
            comparison = COMPARISONS.get(formula.comparison, formula.comparison)
            return f"{formula.left} {comparison} {formula.right}"
        case Atom():
            return f"{formula.expression} is positive"
    word, operands, interval = surface(formula)
    parts = [_words(part, inner=True) for part in operands]
    spans = {"span": _span(interval), "within": _span(interval), "back": _back(interval)}
    if word in ("and", "or"):
        text = f" {word} ".join(parts)
    elif len(parts) == 1:
        text = UNARY[word].format(*parts, **spans)
    else:
        text = BINARY[word].format(*parts, **spans)
    return f"({text})" if inner else text


def _span(interval: Interval | None) -> str:
    if interval is None or interval.everything:
        return ""
    if interval.end == math.inf:
        return f" from {format_seconds(interval.start)} on"
    return f" from {format_seconds(interval.start)} to {format_seconds(interval.end)}"


def _back(interval: Interval | None) -> str:
    if interval is None or interval.everything:
        return ""
    if interval.end == math.inf:
        return f", {format_seconds(interval.start)} ago or earlier"
    return f", {format_seconds(interval.start)} to {format_seconds(interval.end)} ago"


def domain_words(domain: Domain) -> str:
    """Write in words what values a feature has, and how probable they are."""
    match domain:
        case Fixed():
            values = ", ".join(number(value) for _, value in domain.row)
            return f"fixed at {values}; otherwise {domain_words(domain.domain)}"
        case Box():
            return f"uniform between {_numbers(domain.low)} and {_numbers(domain.high)}"
        case DiscreteBox():
            ends = f"{_numbers(domain.low)} to {_numbers(domain.high)}"
            return f"the integers from {ends}, all equally probable"
        case TruncatedNormal():
            return (
                f"normal with mean {number(domain.mean)} and standard deviation "
                f"{number(domain.std)}, cut off at {number(domain.low)} and {number(domain.high)}"
            )
        case Normal():
            return (
                f"normal with mean {number(domain.mean)} and standard deviation "
                f"{number(domain.std)}"
            )
        case LogUniform():
            return f"log-uniform between {number(domain.low)} and {number(domain.high)}"
        case LogNormal():
            return (
                f"log-normal with median {number(math.exp(domain.mean))}, its logarithm with mean "
                f"{number(domain.mean)} and standard deviation {number(domain.std)}"
            )
        case Exponential():
            return f"exponential with mean {number(domain.mean)}"
        case Weibull():
            return f"Weibull with shape {number(domain.shape)} and scale {number(domain.scale)}"
        case Gamma():
            return f"gamma with shape {number(domain.shape)} and scale {number(domain.scale)}"
        case Beta():
            return (
                f"beta with a = {number(domain.a)} and b = {number(domain.b)} between "
                f"{number(domain.low)} and {number(domain.high)}"
            )
        case Triangular():
            return (
                f"triangular between {number(domain.low)} and {number(domain.high)}, most likely "
                f"{number(domain.mode)}"
            )
        case Empirical():
            low, high = domain.support
            return (
                f"as {domain.count} measured numbers between {number(low)} and {number(high)}, "
                f"{_quantile_words(domain)}"
            )
        case Distribution():
            return (
                f"the distribution {domain.name!r} of the user's own, {_quantile_words(domain)}; "
                f"its quantiles are computed by {domain.source}"
            )
        case Constant():
            return f"always {number(domain.value)}"
        case Categorical():
            return _choices(domain)
        case Signal():
            each = domain_words(domain.domain)
            return f"a function of time with {domain.knots} control points, each {each}"
        case Array():
            return f"{domain.length} items, each {domain_words(domain.domain)}"
        case Struct():
            return "; ".join(f"{name}: {domain_words(field)}" for name, field in domain.fields)
        case VariableArray():
            return f"{domain.least} to {domain.most} items, each {domain_words(domain.domain)}"
    return one_line(repr(domain))


def _quantile_words(domain: Continuous) -> str:
    """Write a distribution by its quantiles, the outermost that are simulated among them."""
    u = jnp.array([0.0, 0.01, 0.25, 0.5, 0.75, 0.99, 1.0], jnp.float32)
    least, low, first, median, third, high, most = np.asarray(
        jax.vmap(domain.from_unit)(u[:, None])
    )
    return (
        f"with median {number(median)}, half of it from {number(first)} to {number(third)}, 98 % "
        f"from {number(low)} to {number(high)}, and no simulated value beyond {number(least)} and "
        f"{number(most)}"
    )


def _choices(domain: Categorical) -> str:
    chances = domain.probabilities
    choices = [number(choice) for choice in domain.choices]
    if chances is not None:
        choices = [
            f"{choice} ({format_percent(float(chance))})"
            for choice, chance in zip(choices, chances, strict=True)
        ]
    listed = ", ".join(choices[:MOST_CHOICES])
    more = f", and {len(choices) - MOST_CHOICES} more" if len(choices) > MOST_CHOICES else ""
    return f"one of {listed}{more}" + ("" if chances is not None else ", all equally probable")


def _numbers(value: float | Sequence[float] | np.ndarray) -> str:
    if np.ndim(value) == 0:
        return number(value)
    return f"[{', '.join(number(each) for each in np.asarray(value).ravel().tolist())}]"


def number(value: Any) -> str:
    """Write a value of a feature: six digits of a number, anything else in one line."""
    if value is None or value != value:
        return "absent"
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.number):
        return one_line(str(value), 80)
    if isinstance(value, int | np.integer):
        return str(int(value))
    return f"{float(value):z.6g}"
