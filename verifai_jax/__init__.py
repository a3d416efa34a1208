"""verifai_jax: find inputs that make a closed-loop system break a temporal-logic property."""

__version__ = "0.1.0"

from verifai_jax import analysis as analysis
from verifai_jax import mtl as mtl
from verifai_jax import search as search
from verifai_jax.devices import claim_cores as _claim_cores
from verifai_jax.falsify import RunError as RunError
from verifai_jax.falsify import falsify as falsify
from verifai_jax.falsify import resume as resume
from verifai_jax.falsify import simulate as simulate
from verifai_jax.features import Array as Array
from verifai_jax.features import Box as Box
from verifai_jax.features import Categorical as Categorical
from verifai_jax.features import Constant as Constant
from verifai_jax.features import DiscreteBox as DiscreteBox
from verifai_jax.features import Distribution as Distribution
from verifai_jax.features import FeatureSpace as FeatureSpace
from verifai_jax.features import LogUniform as LogUniform
from verifai_jax.features import Normal as Normal
from verifai_jax.features import Signal as Signal
from verifai_jax.features import Struct as Struct
from verifai_jax.features import TruncatedNormal as TruncatedNormal
from verifai_jax.mtl import FALSE as FALSE
from verifai_jax.mtl import TRUE as TRUE
from verifai_jax.mtl import Formula as Formula
from verifai_jax.mtl import FormulaSyntaxError as FormulaSyntaxError
from verifai_jax.mtl import always as always
from verifai_jax.mtl import boolean as boolean
from verifai_jax.mtl import eventually as eventually
from verifai_jax.mtl import hard as hard
from verifai_jax.mtl import historically as historically
from verifai_jax.mtl import next_ as next_
from verifai_jax.mtl import once as once
from verifai_jax.mtl import online as online
from verifai_jax.mtl import parse as parse
from verifai_jax.mtl import prev as prev
from verifai_jax.mtl import robustness as robustness
from verifai_jax.mtl import robustness_signal as robustness_signal
from verifai_jax.mtl import satisfied as satisfied
from verifai_jax.mtl import signal as signal
from verifai_jax.mtl import since as since
from verifai_jax.mtl import smooth as smooth
from verifai_jax.mtl import until as until
from verifai_jax.problem import Problem as Problem
from verifai_jax.problem import ProblemError as ProblemError
from verifai_jax.rates import Decided as Decided
from verifai_jax.rates import Rate as Rate
from verifai_jax.rates import Within as Within
from verifai_jax.rates import at_any_time as at_any_time
from verifai_jax.rates import clopper_pearson as clopper_pearson
from verifai_jax.rates import simulations_without_failure as simulations_without_failure
from verifai_jax.rulebook import Rulebook as Rulebook
from verifai_jax.run import Replay as Replay
from verifai_jax.run import Run as Run
from verifai_jax.run import load as load
from verifai_jax.systems import blackbox as blackbox
from verifai_jax.systems import ode as ode
from verifai_jax.systems import sin_cos as sin_cos
from verifai_jax.table import ErrorTable as ErrorTable
from verifai_jax.trace import Status as Status
from verifai_jax.trace import Trace as Trace
from verifai_jax.trials import Trials as Trials
from verifai_jax.trials import repeat as repeat
from verifai_jax.waveform import Waveform as Waveform

_claim_cores()
