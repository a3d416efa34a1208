"""Formulas on recordings and beside running systems; their tests, their requirements, their code.

The names of this add-on are those of `verifai_jax.mtl`, too: `vj.mtl.judge`, `vj.mtl.watch`.
"""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.addons.monitoring.c_monitor import export_c as export_c
    from verifai_jax.addons.monitoring.calibrated import DomainMonitor as DomainMonitor
    from verifai_jax.addons.monitoring.calibrated import PredictiveMonitor as PredictiveMonitor
    from verifai_jax.addons.monitoring.calibrated import domain_monitor as domain_monitor
    from verifai_jax.addons.monitoring.calibrated import predictive_monitor as predictive_monitor
    from verifai_jax.addons.monitoring.dense import dense_gradient as dense_gradient
    from verifai_jax.addons.monitoring.dense import dense_robustness as dense_robustness
    from verifai_jax.addons.monitoring.dense import dense_signal as dense_signal
    from verifai_jax.addons.monitoring.distinguishing import Distinction as Distinction
    from verifai_jax.addons.monitoring.distinguishing import distinguish as distinguish
    from verifai_jax.addons.monitoring.elements import all_of as all_of
    from verifai_jax.addons.monitoring.elements import any_of as any_of
    from verifai_jax.addons.monitoring.exemplary import Examples as Examples
    from verifai_jax.addons.monitoring.exemplary import examples as examples
    from verifai_jax.addons.monitoring.findings import Finding as Finding
    from verifai_jax.addons.monitoring.findings import Findings as Findings
    from verifai_jax.addons.monitoring.fmu_monitor import export_fmu as export_fmu
    from verifai_jax.addons.monitoring.functions import at_last as at_last
    from verifai_jax.addons.monitoring.functions import count as count
    from verifai_jax.addons.monitoring.functions import mean as mean
    from verifai_jax.addons.monitoring.functions import peak_to_peak as peak_to_peak
    from verifai_jax.addons.monitoring.functions import rate as rate
    from verifai_jax.addons.monitoring.judgement import Judgement as Judgement
    from verifai_jax.addons.monitoring.judging import judge as judge
    from verifai_jax.addons.monitoring.linting import lint as lint
    from verifai_jax.addons.monitoring.mining import Mined as Mined
    from verifai_jax.addons.monitoring.mining import mine as mine
    from verifai_jax.addons.monitoring.mutation import Mutant as Mutant
    from verifai_jax.addons.monitoring.mutation import Mutants as Mutants
    from verifai_jax.addons.monitoring.mutation import mutants as mutants
    from verifai_jax.addons.monitoring.normalization import anneal as anneal
    from verifai_jax.addons.monitoring.normalization import normalize as normalize
    from verifai_jax.addons.monitoring.parametric import Template as Template
    from verifai_jax.addons.monitoring.parametric import templates as templates
    from verifai_jax.addons.monitoring.plot import draw as draw
    from verifai_jax.addons.monitoring.quantities import UNITS as UNITS
    from verifai_jax.addons.monitoring.quantities import quantity as quantity
    from verifai_jax.addons.monitoring.recording import TimeColumnError as TimeColumnError
    from verifai_jax.addons.monitoring.recording import read as read
    from verifai_jax.addons.monitoring.requirement_files import (
        read_requirements as read_requirements,
    )
    from verifai_jax.addons.monitoring.requirement_files import (
        write_requirements as write_requirements,
    )
    from verifai_jax.addons.monitoring.resampling import resample as resample
    from verifai_jax.addons.monitoring.watching import Watch as Watch
    from verifai_jax.addons.monitoring.watching import watch as watch
FUNCTIONS = {
    "all": "all_of", "any": "any_of", "at_last": "at_last", "count": "count", "mean": "mean",
    "peak_to_peak": "peak_to_peak", "rate": "rate", "unit": "quantity",
}  # fmt: skip
"""What the texts of formulas may call, with the names here."""
# Imported when first used: a monitor needs few of these names.
__getattr__, __dir__, __all__ = attach(__name__)
