"""Sweeps over hyper-parameters of training, ranked by the safety of what was trained."""

from verifai_jax.sweeps._sweep import sweep as sweep
from verifai_jax.sweeps.cache import StoreError as StoreError
from verifai_jax.sweeps.curves import judge_curve as judge_curve
from verifai_jax.sweeps.halving import Halving as Halving
from verifai_jax.sweeps.optuna import OptunaSampler as OptunaSampler
from verifai_jax.sweeps.record import SweepRecord as SweepRecord
from verifai_jax.sweeps.result import Sweep as Sweep
from verifai_jax.sweeps.storage import load_sweep as load_sweep
from verifai_jax.sweeps.study import Study as Study
from verifai_jax.sweeps.trainer import StudyError as StudyError
from verifai_jax.sweeps.trainer import Trainer as Trainer
