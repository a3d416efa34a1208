"""Metric temporal logic: formulas, their text, their robustness on traces."""

from verifai_jax.mtl._explain import Explanation as Explanation
from verifai_jax.mtl._explain import explain as explain
from verifai_jax.mtl._latex import latex as latex
from verifai_jax.mtl._online import Online as Online
from verifai_jax.mtl._online import online as online
from verifai_jax.mtl._parse import parse as parse
from verifai_jax.mtl._robustness import robustness as robustness
from verifai_jax.mtl._robustness import robustness_signal as robustness_signal
from verifai_jax.mtl._robustness import satisfied as satisfied
from verifai_jax.mtl._smoothing_error import SmoothingError as SmoothingError
from verifai_jax.mtl._smoothing_error import smoothing_error as smoothing_error
from verifai_jax.mtl.evaluate import End as End
from verifai_jax.mtl.evaluate import IntervalError as IntervalError
from verifai_jax.mtl.expression import Expression as Expression
from verifai_jax.mtl.expression import signal as signal
from verifai_jax.mtl.formula import FALSE as FALSE
from verifai_jax.mtl.formula import TRUE as TRUE
from verifai_jax.mtl.formula import Formula as Formula
from verifai_jax.mtl.grammar import FormulaSyntaxError as FormulaSyntaxError
from verifai_jax.mtl.normalization import anneal as anneal
from verifai_jax.mtl.normalization import normalize as normalize
from verifai_jax.mtl.operators import always as always
from verifai_jax.mtl.operators import eventually as eventually
from verifai_jax.mtl.operators import historically as historically
from verifai_jax.mtl.operators import next_ as next_
from verifai_jax.mtl.operators import once as once
from verifai_jax.mtl.operators import prev as prev
from verifai_jax.mtl.operators import since as since
from verifai_jax.mtl.operators import until as until
from verifai_jax.mtl.plot import draw as draw
from verifai_jax.mtl.recording import TimeColumnError as TimeColumnError
from verifai_jax.mtl.recording import read as read
from verifai_jax.mtl.resampling import resample as resample
from verifai_jax.mtl.rewriting import nnf as nnf
from verifai_jax.mtl.rewriting import simplify as simplify
from verifai_jax.mtl.semantics import Semantics as Semantics
from verifai_jax.mtl.semantics import boolean as boolean
from verifai_jax.mtl.semantics import hard as hard
from verifai_jax.mtl.semantics import smooth as smooth
from verifai_jax.mtl.setting import HorizonError as HorizonError
from verifai_jax.mtl.setting import SamplingError as SamplingError

__all__ = [
    "FALSE",
    "TRUE",
    "End",
    "Explanation",
    "Expression",
    "Formula",
    "FormulaSyntaxError",
    "HorizonError",
    "IntervalError",
    "Online",
    "SamplingError",
    "Semantics",
    "SmoothingError",
    "TimeColumnError",
    "always",
    "anneal",
    "boolean",
    "draw",
    "eventually",
    "explain",
    "hard",
    "historically",
    "latex",
    "next_",
    "nnf",
    "normalize",
    "once",
    "online",
    "parse",
    "prev",
    "read",
    "resample",
    "robustness",
    "robustness_signal",
    "satisfied",
    "signal",
    "simplify",
    "since",
    "smooth",
    "smoothing_error",
    "until",
]


def __dir__() -> list[str]:
    return list(__all__)
