"""The options of a certification, for `certify`, `sweep` and `harden`.

Certification(samples=32, attack_simulations=0)
"""

from dataclasses import dataclass

from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.search import Search


@dataclass(frozen=True)
class Certification:
    """The attack on each policy and the samples of its certificate.

    - `samples`: minimum number of samples of each policy, in a sweep of those that fewer do not
      show to be unsafe; in whole blocks of 64, or smaller ones for fewer. 32 name the safest.
    - `confidence`: the probability that all intervals hold at once.
    - `budget`: samples of all policies together; four times the minimum when left out. Samples
      beyond the minimum go to policies whose verdict is open, and to those that may be the safest;
      in a sweep to those that may be safe, to each its part at most.
    - `attack`: the search that looks for failures first; its failures are not part of any rate.
    - `attack_simulations`: simulations of each attack, rounded up to whole blocks, 0 for none.

    **Raises:** `ValueError` for numbers out of range.
    """

    samples: int = 512
    confidence: float = 0.95
    budget: int | None = None
    attack: str | Search = "cross_entropy"
    attack_simulations: int = 256

    def __post_init__(self) -> None:
        check_count("samples", self.samples)
        check_fraction("confidence", self.confidence)
        check_count("attack_simulations", self.attack_simulations, 0)

    def check_budget(self, policies: int) -> None:
        """Refuse a budget that is too small for this number of policies."""
        minimum = policies * self.samples
        if self.budget is not None and self.budget < minimum:
            raise ValueError(
                f"{policies} policies with {self.samples} samples each need a budget of at least "
                f"{minimum}; got {self.budget!r}"
            )
