"""The attack: an active search for failures of every policy, before the certificate.

    records = [PolicyRecord() for _ in policies]
    attack_policies(blocks, records, CrossEntropy(), rounds=4, report=report)
    records[3].lowest                                  # the least robustness that it met

Each policy has its own search; all simulations use one program. A search only shows that a policy
can fail, not how likely it is, because its points are not samples of the prior.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from verifai_jax import search as searches
from verifai_jax.addons.estimation.certification.blocks import Blocks
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.falsification.validation import check_search
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.search.proposals import Proposals


@dataclass(eq=False)
class PolicyRecord:
    """The simulations of one policy: points, verdicts and counts.

    - `points`, `verdicts`, `first`: points and verdicts of each block, and the number of its first
      simulation.
    - `simulations`: the simulations of all blocks.
    - `failures`: simulations that violate the property.
    - `not_finite`: simulations without a verdict.
    """

    points: list[Float[np.ndarray, "n d"]] = field(default_factory=list)
    verdicts: list[Verdicts] = field(default_factory=list)
    first: list[int] = field(default_factory=list)
    simulations: int = 0
    failures: int = 0
    not_finite: int = 0

    def add(self, points: Float[np.ndarray, "n d"], verdicts: Verdicts, first: int) -> None:
        """Add one block, whose first simulation has this number."""
        self.points.append(points)
        self.first.append(first)
        self.verdicts.append(verdicts)
        self.simulations += len(points)
        self.failures += int(np.sum(verdicts.violated))
        self.not_finite += int(np.sum(~verdicts.proper))

    def take_out(self, block: int, index: int) -> None:
        """Remove a row from the counterexamples and from `lowest`, but not from the counts."""
        verdicts = self.verdicts[block]
        rho, violated = verdicts.rho.copy(), verdicts.violated.copy()
        rho[index], violated[index] = np.nan, False
        self.verdicts[block] = verdicts._replace(rho=rho, violated=violated)

    @property
    def lowest(self) -> float:
        """The least robustness; NaN if no simulation had a verdict."""
        values = [verdicts.lowest[verdicts.proper] for verdicts in self.verdicts]
        return float(min((np.min(rho) for rho in values if len(rho)), default=np.nan))


def check_attack(problem: Problem, search: str | Search) -> Search:
    """Return the search, if it can attack many policies.

    **Raises:** `ValueError` for an unknown name, a search that does not suit the space, or one that
    follows gradients; `TypeError` for anything that is not a search.
    """
    found = searches.named(search) if isinstance(search, str) else search
    if isinstance(found, Search) and found.wants.derivatives:
        known = (name for name in searches.names() if not searches.named(name).wants.derivatives)
        raise ValueError(
            f"attack {search!r} follows gradients, which are not computed for many policies at "
            f"once; use one of {', '.join(known)}"
        )
    return check_search(problem, found)


def attack_policies(
    blocks: Blocks, records: list[PolicyRecord], search: Search, rounds: int,
    report: Callable[[int], None], *, until_failure: bool = False,
) -> None:  # fmt: skip
    """Attack every policy in rounds of one block each, and add the simulations to `records`.

    **Arguments:**
    - `blocks`: the blocks that simulate the policies.
    - `records`: one record for each policy.
    - `search`: the search of each policy.
    - `rounds`: number of blocks for each policy.
    - `report(simulations)`: called after each block, to show progress.
    - `until_failure`: whether the attack on a policy ends with the block that shows a failure.
    """
    attackers = [
        Proposals(
            search, blocks.space.cube, blocks.lanes, blocks.attack_key, blocks.space.constraint
        )
        for _ in records
    ]
    for round_ in range(rounds):
        chosen = []
        for number, attacker in enumerate(attackers):
            if attacker.exhausted or (until_failure and records[number].failures):
                continue
            points = np.asarray(attacker.next(blocks.lanes), np.float32)
            if len(points):
                chosen.append((number, points))
            else:
                attacker.tell_refused()
        for index, verdicts in blocks.attack(chosen, round_, repr(search)):
            number, points = chosen[index]
            records[number].add(points, verdicts, round_ * blocks.lanes)
            attackers[number].tell(verdicts.lowest, verdicts.proper, None)
            report(len(points))
