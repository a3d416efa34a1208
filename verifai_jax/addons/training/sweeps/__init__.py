"""Sweeps over hyper-parameters of training, ranked by the safety of the trained policies.

sweep = vj.sweep(study, configurations=64, folder="sweeps/mine")
sweep.best, sweep.safe, sweep.importance()
"""

from verifai_jax.addons.training.sweeps._sweep import sweep as sweep
from verifai_jax.addons.training.sweeps.curves import curve_robustness as curve_robustness
from verifai_jax.addons.training.sweeps.exported import TrainedConfiguration as TrainedConfiguration
from verifai_jax.addons.training.sweeps.exported import load_configuration as load_configuration
from verifai_jax.addons.training.sweeps.halving import Halving as Halving
from verifai_jax.addons.training.sweeps.optuna import OptunaSampler as OptunaSampler
from verifai_jax.addons.training.sweeps.population import Population as Population
from verifai_jax.addons.training.sweeps.record import SweepRecord as SweepRecord
from verifai_jax.addons.training.sweeps.result import Sweep as Sweep
from verifai_jax.addons.training.sweeps.result import load_sweep as load_sweep
from verifai_jax.addons.training.sweeps.storage import SweepFileError as SweepFileError
from verifai_jax.addons.training.sweeps.study import Study as Study
from verifai_jax.addons.training.sweeps.trainer import StudyError as StudyError
from verifai_jax.addons.training.sweeps.trainer import Trainer as Trainer
from verifai_jax.core.store.cache import CacheError as CacheError
