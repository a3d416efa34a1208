"""Real trials: failure rates by trials and simulations together, comparisons, protocols.

found = vj.real_trials(problem, "trials.csv")       # the rate in reality, and where to trust
vj.compare_trials("pairs.csv", "old", "new")        # two policies, whenever one stops
vj.trial_protocol(problem, "sheet.html", 40)        # randomised trials to print
vj.calibrate(problem, "trials.csv", ["friction"])   # features that agree with the trials
"""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.addons.estimation.trials._real_trials import real_trials as real_trials
    from verifai_jax.addons.estimation.trials.calibration import Calibration as Calibration
    from verifai_jax.addons.estimation.trials.calibration import calibrate as calibrate
    from verifai_jax.addons.estimation.trials.policies import TrialComparison as TrialComparison
    from verifai_jax.addons.estimation.trials.policies import compare_trials as compare_trials
    from verifai_jax.addons.estimation.trials.protocol import trial_protocol as trial_protocol
    from verifai_jax.addons.estimation.trials.result import RealTrials as RealTrials
__getattr__, __dir__, __all__ = attach(__name__)
