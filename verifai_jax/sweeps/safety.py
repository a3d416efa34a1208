"""The certification as a sweep calls it: policies in, one judgement a policy out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from verifai_jax.problem.problem import Problem
from verifai_jax.rl.policy import Policy
from verifai_jax.search import Search

QUICK = 64
"""Samples of a policy, and simulations of the attack on it, by which a search or halving chooses;
verdicts take fresh ones."""


@dataclass(frozen=True)
class Judged:
    """What the certification says of one policy.

    - `failures` of `simulations` samples of the prior, those without a verdict among them; `rate`
      between `low` and `high`.
    - `worst`: the least robustness met, `features` those it was met with.
    """

    failures: int
    simulations: int
    rate: float
    low: float
    high: float
    worst: float
    features: Mapping[str, Any] | None
    verdict: str


class Judgement(NamedTuple):
    """The certification's own result, and what it says policy by policy."""

    certificates: Any
    policies: list[Judged]


def certify_policies(
    problem_of: Callable[[Policy], Problem],
    policies: Sequence[Policy],
    *,
    p: float,
    confidence: float,
    samples: int,
    seed: int,
    budget: int | None,
    attack: str | Search,
    attack_simulations: int,
    remember: Callable[[str, Callable[[], Any]], Any],
    progress: Callable[[int, int, str], None] | None,
) -> Judgement:
    """Falsify and certify policies; what `certification.certify` does."""
    from verifai_jax.certification._certify import certify

    certificates = certify(
        problem_of,
        policies,
        p=p,
        confidence=confidence,
        samples=samples,
        seed=seed,
        budget=budget,
        attack=attack,
        attack_simulations=attack_simulations,
        remember=remember,
        progress=progress,
    )
    return Judgement(certificates, [_judged(certificates[i]) for i in range(len(policies))])


def _judged(certificate: Any) -> Judged:
    rate = certificate.rate
    nan = float("nan")
    return Judged(
        failures=certificate.failures + certificate.not_finite,
        simulations=certificate.simulations,
        rate=nan if rate is None else rate.estimate,
        low=nan if rate is None else rate.low,
        high=nan if rate is None else rate.high,
        worst=certificate.worst_robustness,
        features=certificate.worst_features,
        # Nothing is known of a policy that was not sampled before an interruption.
        verdict="" if rate is None else certificate.verdict,
    )
