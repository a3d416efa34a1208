"""verifai_jax: find inputs that make a closed-loop system break a temporal-logic property."""

from typing import TYPE_CHECKING

from verifai_jax._version import __version__ as __version__
from verifai_jax.core.cores import claim_cores as _claim_cores
from verifai_jax.core.lazy import attach as _attach
from verifai_jax.core.reads import watch as _watch

if TYPE_CHECKING:
    from verifai_jax import analysis as analysis
    from verifai_jax import faults as faults
    from verifai_jax import mtl as mtl
    from verifai_jax import perception as perception
    from verifai_jax import rl as rl
    from verifai_jax import search as search
    from verifai_jax.analysis import boundary as boundary
    from verifai_jax.analysis import odd_of as odd_of
    from verifai_jax.analysis import read_odd as read_odd
    from verifai_jax.analysis.counterexamples import Confirmation as Confirmation
    from verifai_jax.analysis.counterexamples import Confirmations as Confirmations
    from verifai_jax.analysis.counterexamples import confirm as confirm
    from verifai_jax.analysis.counterexamples import explain as explain
    from verifai_jax.analysis.counterexamples import (
        replay_counterexamples as replay_counterexamples,
    )
    from verifai_jax.analysis.counterexamples import shrink as shrink
    from verifai_jax.core.loggers import CSVLogger as CSVLogger
    from verifai_jax.core.loggers import TensorBoardLogger as TensorBoardLogger
    from verifai_jax.core.trace import Status as Status
    from verifai_jax.core.trace import Trace as Trace
    from verifai_jax.core.waveform import Waveform as Waveform
    from verifai_jax.estimation import Estimate as Estimate
    from verifai_jax.estimation import SequenceEstimate as SequenceEstimate
    from verifai_jax.estimation import estimate as estimate
    from verifai_jax.estimation import sequence as sequence
    from verifai_jax.estimation.certification import Certificates as Certificates
    from verifai_jax.estimation.certification import certify as certify
    from verifai_jax.estimation.comparison import Comparison as Comparison
    from verifai_jax.estimation.comparison import compare as compare
    from verifai_jax.estimation.comparison import transfer as transfer
    from verifai_jax.estimation.error_budgets import ErrorBudget as ErrorBudget
    from verifai_jax.estimation.error_budgets import error_budget as error_budget
    from verifai_jax.estimation.failure_modes import Mode as Mode
    from verifai_jax.estimation.failure_modes import Modes as Modes
    from verifai_jax.estimation.failure_modes import modes as modes
    from verifai_jax.estimation.trials import RealTrials as RealTrials
    from verifai_jax.estimation.trials import calibrate as calibrate
    from verifai_jax.estimation.trials import compare_trials as compare_trials
    from verifai_jax.estimation.trials import real_trials as real_trials
    from verifai_jax.estimation.trials import trial_protocol as trial_protocol
    from verifai_jax.evaluation import clusters as clusters
    from verifai_jax.falsification import ErrorTable as ErrorTable
    from verifai_jax.falsification import Replay as Replay
    from verifai_jax.falsification import Run as Run
    from verifai_jax.falsification import RunError as RunError
    from verifai_jax.falsification import falsify as falsify
    from verifai_jax.falsification import load as load
    from verifai_jax.falsification import resume as resume
    from verifai_jax.falsification import simulate as simulate
    from verifai_jax.falsification._repeat import Trials as Trials
    from verifai_jax.falsification._repeat import repeat as repeat
    from verifai_jax.falsification.fuzzing import FuzzCoverage as FuzzCoverage
    from verifai_jax.falsification.fuzzing import FuzzRun as FuzzRun
    from verifai_jax.falsification.fuzzing import fuzz as fuzz
    from verifai_jax.faults.failure_table import FailureTable as FailureTable
    from verifai_jax.faults.failure_table import fmea as fmea
    from verifai_jax.features import Array as Array
    from verifai_jax.features import Beta as Beta
    from verifai_jax.features import Box as Box
    from verifai_jax.features import Categorical as Categorical
    from verifai_jax.features import Constant as Constant
    from verifai_jax.features import DiscreteBox as DiscreteBox
    from verifai_jax.features import Distribution as Distribution
    from verifai_jax.features import Empirical as Empirical
    from verifai_jax.features import Exponential as Exponential
    from verifai_jax.features import FeatureSpace as FeatureSpace
    from verifai_jax.features import Gamma as Gamma
    from verifai_jax.features import LogNormal as LogNormal
    from verifai_jax.features import LogUniform as LogUniform
    from verifai_jax.features import Normal as Normal
    from verifai_jax.features import Reactive as Reactive
    from verifai_jax.features import Signal as Signal
    from verifai_jax.features import Struct as Struct
    from verifai_jax.features import Triangular as Triangular
    from verifai_jax.features import TruncatedNormal as TruncatedNormal
    from verifai_jax.features import Weibull as Weibull
    from verifai_jax.features import events as events
    from verifai_jax.mtl import Formula as Formula
    from verifai_jax.mtl import FormulaSyntaxError as FormulaSyntaxError
    from verifai_jax.mtl import always as always
    from verifai_jax.mtl import eventually as eventually
    from verifai_jax.mtl import parse as parse
    from verifai_jax.mtl import robustness as robustness
    from verifai_jax.mtl import signal as signal
    from verifai_jax.mtl import until as until
    from verifai_jax.problem import Behaviour as Behaviour
    from verifai_jax.problem import Guide as Guide
    from verifai_jax.problem import Problem as Problem
    from verifai_jax.problem import ProblemError as ProblemError
    from verifai_jax.problem import Rulebook as Rulebook
    from verifai_jax.rl import policies as policies
    from verifai_jax.rl.policies import policy as policy
    from verifai_jax.statistics.binomial import Rate as Rate
    from verifai_jax.statistics.binomial import clopper_pearson as clopper_pearson
    from verifai_jax.statistics.binomial import (
        simulations_without_failure as simulations_without_failure,
    )
    from verifai_jax.statistics.confidence_sequences import anytime_interval as anytime_interval
    from verifai_jax.statistics.stopping import Decided as Decided
    from verifai_jax.statistics.stopping import Within as Within
    from verifai_jax.synthesis import Repair as Repair
    from verifai_jax.synthesis import Synthesis as Synthesis
    from verifai_jax.synthesis import repair as repair
    from verifai_jax.synthesis import synthesize as synthesize
    from verifai_jax.systems.base import System as System
    from verifai_jax.systems.blackbox import blackbox as blackbox
    from verifai_jax.systems.blackbox import stack_traces as stack_traces
    from verifai_jax.systems.environments import brax as brax
    from verifai_jax.systems.environments import gymnasium as gymnasium
    from verifai_jax.systems.environments import gymnax as gymnax
    from verifai_jax.systems.environments import playground as playground
    from verifai_jax.systems.fmu import fmu as fmu
    from verifai_jax.systems.fmu import fmu_ranges as fmu_ranges
    from verifai_jax.systems.fmu import fmu_variables as fmu_variables
    from verifai_jax.systems.mujoco import Scaled as Scaled
    from verifai_jax.systems.mujoco import mjx as mjx
    from verifai_jax.systems.mujoco import mujoco as mujoco
    from verifai_jax.systems.mujoco import native as native
    from verifai_jax.systems.ode import blocks as blocks
    from verifai_jax.systems.ode import ode as ode
    from verifai_jax.systems.ode import sin_cos as sin_cos
    from verifai_jax.systems.remote import remote as remote
    from verifai_jax.systems.scenic import ProgramError as ProgramError
    from verifai_jax.systems.scenic import ScenicProgram as ScenicProgram
    from verifai_jax.systems.scenic import scenic as scenic
    from verifai_jax.testing.checking import test as test
    from verifai_jax.testing.qualification import qualify as qualify
    from verifai_jax.testing.traceability import TraceMatrix as TraceMatrix
    from verifai_jax.testing.traceability import trace_matrix as trace_matrix
    from verifai_jax.training import augmentation as augmentation
    from verifai_jax.training.augmentation import Augmentation as Augmentation
    from verifai_jax.training.augmentation import SupervisedTask as SupervisedTask
    from verifai_jax.training.augmentation import augment as augment
    from verifai_jax.training.hardening import Hardening as Hardening
    from verifai_jax.training.hardening import harden as harden
    from verifai_jax.training.sweeps import Halving as Halving
    from verifai_jax.training.sweeps import OptunaSampler as OptunaSampler
    from verifai_jax.training.sweeps import Study as Study
    from verifai_jax.training.sweeps import StudyError as StudyError
    from verifai_jax.training.sweeps import Sweep as Sweep
    from verifai_jax.training.sweeps import Trainer as Trainer
    from verifai_jax.training.sweeps import load_sweep as load_sweep
    from verifai_jax.training.sweeps import sweep as sweep
    from verifai_jax.verification import Verification as Verification
    from verifai_jax.verification import load_verification as load_verification
    from verifai_jax.verification import verify as verify

# Imported when first used (PEP 562), so that importing this package takes milliseconds.
__getattr__, __dir__, __all__ = _attach(__name__, "__version__")

_claim_cores()
_watch()
