"""Answers about requirements from simulations and searches, for the questions that `mtl` asks.

`vj.mtl.mine` takes a problem instead of recordings.
"""

from verifai_jax.requirements.by_search import distinguish_by_search, mine_by_search, simulated

__all__ = ["distinguish_by_search", "mine_by_search", "simulated"]


def __dir__() -> list[str]:
    return list(__all__)
