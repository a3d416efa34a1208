"""Executors of clusters: `connect` by an address, and an adapter for Ray."""

from verifai_jax.addons.clusters.connection import RayExecutor as RayExecutor
from verifai_jax.addons.clusters.connection import connect as connect

__all__ = ["RayExecutor", "connect"]


def __dir__() -> list[str]:
    return sorted(__all__)
