"""The certification of a sweep's policies: one safety result for each policy.

report = certify_policies(problem_of, policies, p=0.01, ...)
report.policies[3].verdict
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from verifai_jax.certification._certify import certify
from verifai_jax.certification.result import Certificate, Certificates
from verifai_jax.core.cache import Arrays
from verifai_jax.core.executors import Executor
from verifai_jax.problem.problem import Problem
from verifai_jax.rl.policy import Policy
from verifai_jax.search import Search

SCREENING = 64
"""Samples of a policy, and simulations of the attack on it, by which a search or halving chooses.

Certificates take fresh samples."""


@dataclass(frozen=True)
class PolicySafety:
    """The safety of one policy.

    - `failures`: samples of the prior that fail or have no verdict.
    - `simulations`: number of samples.
    - `rate`: failure rate, between `low` and `high`.
    - `low`, `high`: ends of its interval.
    - `worst`: the least robustness of all simulations.
    - `features`: the features at which it was met; None where nothing had a verdict.
    - `verdict`: `safe@p`, `unsafe` or `undecided`; empty for a policy that was not sampled.
    """

    failures: int
    simulations: int
    rate: float
    low: float
    high: float
    worst: float
    features: Mapping[str, object] | None
    verdict: str


class SafetyReport(NamedTuple):
    """The safety of all policies.

    - `certificates`: the result of the certification itself.
    - `policies`: the safety of each policy, in their order.
    """

    certificates: Certificates | None
    policies: list[PolicySafety]


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
    remember: Callable[[str, Callable[[], Arrays]], Arrays],
    progress: Callable[[int, int, str], None] | None,
    executor: Executor | None = None,
) -> SafetyReport:
    """Attack and certify policies; arguments are those of `certify`."""
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
        executor=executor,
    )
    return SafetyReport(certificates, [_safety(certificates[i]) for i in range(len(policies))])


def _safety(certificate: Certificate) -> PolicySafety:
    rate = certificate.rate
    nan = float("nan")
    return PolicySafety(
        failures=certificate.failures + certificate.not_finite,
        simulations=certificate.simulations,
        rate=nan if rate is None else rate.estimate,
        low=nan if rate is None else rate.low,
        high=nan if rate is None else rate.high,
        worst=certificate.worst_robustness,
        features=certificate.worst_features,
        # An interruption leaves policies without a sample, and so without a verdict.
        verdict="" if rate is None else certificate.verdict,
    )
