"""Policies that were trained elsewhere: files and models of other frameworks, in JAX."""

from verifai_jax.policies.errors import PolicyError as PolicyError
from verifai_jax.policies.loading import policy as policy
from verifai_jax.policies.policy import Actions as Actions
from verifai_jax.policies.policy import Normaliser as Normaliser
from verifai_jax.policies.policy import Policy as Policy

__all__ = ["Actions", "Normaliser", "Policy", "PolicyError", "policy"]
