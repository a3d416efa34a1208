"""Domains and values in English, for readers who do not know their notation.

domain_words(Box(-1, 1))                            # 'uniform between -1 and 1'
"""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.core.text import format_percent, one_line
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

MOST_CHOICES = 12
"""Choices that are listed one by one."""


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
