"""Training that hardens a policy: train, attack, add what fails to the training, certify.

result = vj.harden(study)
print(result)                           # failure probability before and after, return lost, cost
"""

from verifai_jax.training.hardening._harden import harden
from verifai_jax.training.hardening.mixture import HardeningError
from verifai_jax.training.hardening.result import Hardening

__all__ = ["Hardening", "HardeningError", "harden"]


def __dir__() -> list[str]:
    return list(__all__)
