"""The certification as a sweep calls it: policies in, one judgement a policy out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from verifai_jax.problem import Problem
from verifai_jax.rl.policy import Policy

QUICK = 128
"""Simulations of a policy by which a search or halving chooses; verdicts take fresh ones."""


@dataclass(frozen=True)
class Judged:
    """What the certification says of one policy.

    - `failures` of `simulations` samples of the prior; `rate` between `low` and `high`.
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
    attack: Any,
    remember: Callable[[str, Callable[[], Any]], Any],
    progress: Any,
) -> Judgement:
    """Falsify and certify policies; what `certification.certify` does."""
    from verifai_jax.certification import certify

    options: dict[str, Any] = {} if attack is None else {"search": attack}
    certificates = certify(
        problem_of,
        policies,
        p=p,
        confidence=confidence,
        samples=samples,
        seed=seed,
        budget=budget,
        remember=remember,
        progress=None,
        **options,
    )
    return Judgement(certificates, [judged(certificates, i) for i in range(len(policies))])


def judged(certificates: Any, i: int) -> Judged:
    """One policy's part of the certificates."""
    raise NotImplementedError
