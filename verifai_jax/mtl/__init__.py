"""Metric temporal logic: formulas, their text, their robustness on traces."""

from verifai_jax.mtl._explain import Explanation, explain
from verifai_jax.mtl._latex import latex
from verifai_jax.mtl._online import Online, online
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl._robustness import robustness, robustness_signal, satisfied
from verifai_jax.mtl._smoothing_error import SmoothingError, smoothing_error
from verifai_jax.mtl.evaluate import End, IntervalError
from verifai_jax.mtl.expression import Expression, signal
from verifai_jax.mtl.formula import FALSE, TRUE, Formula
from verifai_jax.mtl.grammar import FormulaSyntaxError
from verifai_jax.mtl.judgement import Judgement
from verifai_jax.mtl.judging import judge
from verifai_jax.mtl.mining import Mined, mine
from verifai_jax.mtl.normalization import anneal, normalize
from verifai_jax.mtl.operators import (
    always,
    eventually,
    historically,
    next_,
    once,
    prev,
    since,
    until,
)
from verifai_jax.mtl.plot import draw
from verifai_jax.mtl.recording import TimeColumnError, read
from verifai_jax.mtl.requirements import Requirement, read_requirements
from verifai_jax.mtl.resampling import resample
from verifai_jax.mtl.rewriting import nnf, simplify
from verifai_jax.mtl.semantics import Semantics, boolean, hard, smooth
from verifai_jax.mtl.setting import HorizonError, SamplingError

__all__ = [
    "FALSE", "TRUE", "End", "Explanation", "Expression", "Formula", "FormulaSyntaxError",
    "HorizonError", "IntervalError", "Judgement", "Mined", "Online", "Requirement",
    "SamplingError", "Semantics", "SmoothingError", "TimeColumnError", "always", "anneal",
    "boolean", "draw", "eventually", "explain", "hard", "historically", "judge", "latex", "mine",
    "next_", "nnf", "normalize", "once", "online", "parse", "prev", "read", "read_requirements",
    "resample", "robustness", "robustness_signal", "satisfied", "signal", "simplify", "since",
    "smooth", "smoothing_error", "until",
]  # fmt: skip


def __dir__() -> list[str]:
    return list(__all__)
