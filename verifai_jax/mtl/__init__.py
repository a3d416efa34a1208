"""Metric temporal logic: formulas, their text, their robustness on traces."""

from typing import Any

from verifai_jax.core.display.extensions import member, members
from verifai_jax.mtl._explain import Explanation, explain
from verifai_jax.mtl._latex import latex
from verifai_jax.mtl._online import Online, online
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl._robustness import robustness, robustness_signal, satisfied
from verifai_jax.mtl._smoothing_error import SmoothingError, smoothing_error
from verifai_jax.mtl.evaluate import End, IntervalError
from verifai_jax.mtl.expression import Expression, signal
from verifai_jax.mtl.formula import FALSE, TRUE, Formula, Interval
from verifai_jax.mtl.grammar import FormulaSyntaxError
from verifai_jax.mtl.operators import (
    always,
    during,
    eventually,
    fall,
    historically,
    next_,
    once,
    phase,
    prev,
    rise,
    since,
    sometime_during,
    until,
)
from verifai_jax.mtl.requirements import Requirement
from verifai_jax.mtl.rewriting import nnf, simplify
from verifai_jax.mtl.sampled import duration
from verifai_jax.mtl.semantics import Semantics, boolean, hard, smooth
from verifai_jax.mtl.setting import HorizonError, SamplingError

__all__ = [
    "FALSE", "TRUE", "End", "Explanation", "Expression", "Formula", "FormulaSyntaxError",
    "HorizonError", "Interval", "IntervalError", "Online", "Requirement", "SamplingError",
    "Semantics", "SmoothingError", "always", "boolean", "duration", "during",
    "eventually", "explain", "fall", "hard", "historically", "latex", "next_", "nnf",
    "once", "online", "parse", "phase", "prev", "rise",
    "robustness", "robustness_signal", "satisfied", "signal", "simplify", "since", "smooth",
    "smoothing_error", "sometime_during", "until",
]  # fmt: skip
GROUP = "verifai_jax.formulas"
"""Entry points of modules whose names belong here, too: what add-ons do with formulas."""


def __getattr__(name: str) -> Any:
    value = globals()[name] = member(__name__, GROUP, name, __all__)
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *members(GROUP)})
