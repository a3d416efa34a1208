"""The attack: an active search against every policy, which may only refute.

    attacks = refute(pieces, policies=8, search=CrossEntropy(), rounds=4)
    attacks[3].worst                                    # the least robustness that it met

Each policy has a search of its own; their simulations go through one program. What a search finds
says that a policy can fail, never how likely it is: points that it chose are no samples.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from verifai_jax import search as searches
from verifai_jax.certification.blocks import Pieces
from verifai_jax.certification.simulators import Outcome
from verifai_jax.falsification.validation import check_search
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.search.proposals import Proposals


@dataclass(eq=False)
class Seen:
    """What was simulated of one policy: its points, what came of them, and the counts.

    `failures` ended properly and break a formula; `not_finite` have no verdict.
    """

    points: list[Float[np.ndarray, "n d"]] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    simulations: int = 0
    failures: int = 0
    not_finite: int = 0

    def add(self, points: Float[np.ndarray, "n d"], outcome: Outcome) -> None:
        """Take in one block."""
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


def usable_search(problem: Problem, search: str | Search) -> Search:
    """The search, if it can attack many policies.

    **Raises:** `ValueError` for an unknown name, one that the space does not suit, or one that
    follows gradients; `TypeError` for what is no search.
    """
    found = searches.named(search) if isinstance(search, str) else search
    if isinstance(found, Search) and (found.wants_gradient or found.wants_clauses):
        known = (name for name in searches.names() if not _slopes(name))
        raise ValueError(
            f"attack {search!r} follows gradients, which are not computed for many policies at "
            f"once; use one of {', '.join(known)}"
        )
    return check_search(problem, found)


def _slopes(name: str) -> bool:
    found = searches.named(name)
    return found.wants_gradient or found.wants_clauses


def refute(
    pieces: Pieces, seen: list[Seen], search: Search, rounds: int, told: Callable[[int], None]
) -> None:
    """Attack every policy in so many rounds of one block each; what is met goes into `seen`.

    - `told(simulations)`: called after each block, for the progress.
    """
    attackers = [
        Proposals(
            search, pieces.space.cube, pieces.lanes, pieces.attack_key, pieces.space.constraint
        )
        for _ in seen
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
            seen[number].add(points, outcome)
            attackers[number].tell(outcome.rho, outcome.proper, None)
            told(len(points))
