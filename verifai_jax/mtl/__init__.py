"""Metric temporal logic: formulas, their text, their robustness on traces."""

from verifai_jax.addons.monitoring.c_monitor import export_c
from verifai_jax.addons.monitoring.calibrated import (
    DomainMonitor,
    PredictiveMonitor,
    domain_monitor,
    predictive_monitor,
)
from verifai_jax.addons.monitoring.dense import dense_gradient, dense_robustness, dense_signal
from verifai_jax.addons.monitoring.distinguishing import Distinction, distinguish
from verifai_jax.addons.monitoring.exemplary import Examples, examples
from verifai_jax.addons.monitoring.findings import Finding, Findings
from verifai_jax.addons.monitoring.fmu_monitor import export_fmu
from verifai_jax.addons.monitoring.judgement import Judgement
from verifai_jax.addons.monitoring.judging import judge
from verifai_jax.addons.monitoring.linting import lint
from verifai_jax.addons.monitoring.mining import Mined, mine
from verifai_jax.addons.monitoring.mutation import Mutant, Mutants, mutants
from verifai_jax.addons.monitoring.parametric import Template, templates
from verifai_jax.addons.monitoring.recording import TimeColumnError, read
from verifai_jax.addons.monitoring.resampling import resample
from verifai_jax.addons.monitoring.watching import Watch, watch
from verifai_jax.mtl._explain import Explanation, explain
from verifai_jax.mtl._latex import latex
from verifai_jax.mtl._online import Online, online
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl._robustness import robustness, robustness_signal, satisfied
from verifai_jax.mtl._smoothing_error import SmoothingError, smoothing_error
from verifai_jax.mtl.evaluate import End, IntervalError
from verifai_jax.mtl.expression import Expression, duration, signal
from verifai_jax.mtl.formula import FALSE, TRUE, Formula
from verifai_jax.mtl.grammar import FormulaSyntaxError
from verifai_jax.mtl.normalization import anneal, normalize
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
from verifai_jax.mtl.plot import draw
from verifai_jax.mtl.requirements import Requirement, read_requirements, write_requirements
from verifai_jax.mtl.rewriting import nnf, simplify
from verifai_jax.mtl.semantics import Semantics, boolean, hard, smooth
from verifai_jax.mtl.setting import HorizonError, SamplingError

__all__ = [
    "FALSE", "TRUE", "Distinction", "DomainMonitor", "End", "Examples", "Explanation",
    "Expression", "Finding", "Findings", "Formula", "FormulaSyntaxError", "HorizonError",
    "IntervalError", "Judgement", "Mined", "Mutant", "Mutants", "Online", "PredictiveMonitor",
    "Requirement", "SamplingError", "Semantics", "SmoothingError", "Template",
    "TimeColumnError", "Watch", "always", "anneal", "boolean", "dense_gradient",
    "dense_robustness", "dense_signal", "distinguish", "domain_monitor", "draw", "duration",
    "during", "eventually", "examples", "explain", "export_c", "export_fmu", "fall", "hard",
    "historically", "judge", "latex", "lint", "mine", "mutants", "next_", "nnf", "normalize",
    "once", "online", "parse", "phase", "predictive_monitor", "prev", "read",
    "read_requirements", "resample", "rise", "robustness", "robustness_signal", "satisfied",
    "signal", "simplify", "since", "smooth", "smoothing_error", "sometime_during",
    "templates", "until", "watch", "write_requirements",
]  # fmt: skip


def __dir__() -> list[str]:
    return list(__all__)
