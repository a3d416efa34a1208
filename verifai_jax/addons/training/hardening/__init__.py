"""Hardening of a policy: train, attack, train further on the failures, certify.

result = vj.harden(study)
print(result)                           # failure probability before and after, return lost, cost
result.table, result.policy, result.plot("hardening.png")
"""

from verifai_jax.addons.training.hardening._harden import harden as harden
from verifai_jax.addons.training.hardening.mixture import FurtherTraining as FurtherTraining
from verifai_jax.addons.training.hardening.mixture import HardeningError as HardeningError
from verifai_jax.addons.training.hardening.result import Hardening as Hardening
