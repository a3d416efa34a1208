"""The attack: an active search for failures of every policy, before the certificate.

    records = [PolicyRecord() for _ in policies]
    attack_policies(blocks, records, CrossEntropy(), rounds=4, report=report)
    records[3].least                                    # the least robustness that it met

Each policy has a search of its own; their simulations go through one program. What a search finds
says that a policy can fail, never how likely it is: points that it chose are no samples.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from verifai_jax import search as searches
from verifai_jax.certification.blocks import Blocks
from verifai_jax.certification.simulators import Outcome
from verifai_jax.falsification.validation import check_search
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.search.proposals import Proposals


@dataclass(eq=False)
class PolicyRecord:
    """The simulations of one policy: points, outcomes and counts.

    `failures` ended properly and break a formula; `not_finite` have no verdict.
    """

    points: list[Float[np.ndarray, "n d"]] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    simulations: int = 0
    failures: int = 0
    not_finite: int = 0

    def add(self, points: Float[np.ndarray, "n d"], outcome: Outcome) -> None:
        """Add one block."""
        self.points.append(points)
        self.outcomes.append(outcome)
        self.simulations += len(points)
        self.failures += int(np.sum(outcome.failing))
        self.not_finite += int(np.sum(~outcome.proper))

    @property
    def least(self) -> float:
        """The least robustness; NaN where nothing had a verdict."""
        values = [outcome.rho[outcome.proper] for outcome in self.outcomes]
        return float(min((np.min(rho) for rho in values if len(rho)), default=np.nan))


def check_attack(problem: Problem, search: str | Search) -> Search:
    """Return the search, if it can attack many policies.

    **Raises:** `ValueError` for an unknown name, one that the space does not suit, or one that
    follows gradients; `TypeError` for what is no search.
    """
    found = searches.named(search) if isinstance(search, str) else search
    if isinstance(found, Search) and (found.wants_gradient or found.wants_clauses):
        known = (name for name in searches.names() if not _needs_gradients(name))
        raise ValueError(
            f"attack {search!r} follows gradients, which are not computed for many policies at "
            f"once; use one of {', '.join(known)}"
        )
    return check_search(problem, found)


def _needs_gradients(name: str) -> bool:
    found = searches.named(name)
    return found.wants_gradient or found.wants_clauses


def attack_policies(
    pieces: Blocks,
    records: list[PolicyRecord],
    search: Search,
    rounds: int,
    report: Callable[[int], None],
) -> None:
    """Attack every policy in rounds of one block each, and add the simulations to `records`.

    - `report(simulations)`: called after each block, for the progress.
    """
    attackers = [
        Proposals(
            search, pieces.space.cube, pieces.lanes, pieces.attack_key, pieces.space.constraint
        )
        for _ in records
    ]
    for round_ in range(rounds):
        asked = []
        for number, attacker in enumerate(attackers):
            if attacker.exhausted:
                continue
            points = np.asarray(attacker.next(pieces.lanes), np.float32)
            if len(points):
                asked.append((number, points))
            else:
                attacker.tell_refused()
        for place, outcome in pieces.attack(asked, round_, repr(search)):
            number, points = asked[place]
            records[number].add(points, outcome)
            attackers[number].tell(outcome.rho, outcome.proper, None)
            report(len(points))
