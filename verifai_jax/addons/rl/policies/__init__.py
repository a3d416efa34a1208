"""Policies that were trained elsewhere: files and models of other frameworks, in JAX."""

from verifai_jax.addons.rl.policies.base import Actions, Normaliser, Policy
from verifai_jax.addons.rl.policies.errors import PolicyError
from verifai_jax.addons.rl.policies.loading import policy

__all__ = ["Actions", "Normaliser", "Policy", "PolicyError", "policy"]


def __dir__() -> list[str]:
    return __all__
