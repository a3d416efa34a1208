"""Compositional falsification of a loop with a network in it; used as `vj.perception.abstract`."""

from verifai_jax.addons.perception.compositional._abstract import abstract as abstract
from verifai_jax.addons.perception.compositional.result import Compositional as Compositional

__all__ = ["Compositional", "abstract"]


def __dir__() -> list[str]:
    return list(__all__)
