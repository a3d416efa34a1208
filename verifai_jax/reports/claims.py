"""Claims of a report: what is claimed, on what evidence, under which assumptions.

claim = Claim("C1", "604 of 20000 simulations violate the property", ("table.parquet",), (...))
claims_json("balance", claims)                      # plain data that a safety case can cite
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

FORMAT = 1
"""Number of the format of claims as JSON."""


@dataclass(frozen=True)
class Claim:
    """A sentence that the evidence supports.

    - `identifier`: by which a safety case cites it, such as `C2`.
    - `claim`: the sentence.
    - `evidence`: what it rests on.
    - `assumptions`: what must hold besides, for the claim to hold.
    - `requirements`: identifiers of those that it is about; empty for all of the report's.
    """

    identifier: str
    claim: str
    evidence: tuple[str, ...]
    assumptions: tuple[str, ...] = ()
    requirements: tuple[str, ...] = ()


def claims_json(
    subject: str, claims: Sequence[Claim], chain: str, about: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Describe claims as plain data.

    **Arguments:**
    - `chain`: last hash of the chain over all inputs of the report.
    - `about`: what `vj.trace_matrix` compares with what there is later, see `about_json`.
    """
    return {
        "format": FORMAT,
        "subject": subject,
        "inputs_sha256_chain": chain,
        "about": dict(about or {}),
        "claims": [asdict(claim) for claim in claims],
    }


def about_json(
    result: str,
    formulas: Mapping[str, str],
    requirements: Mapping[str, Mapping[str, str]],
    model: str = "",
    backend: str | None = None,
) -> dict[str, Any]:
    """Describe what claims are about as plain data.

    **Arguments:**
    - `result`: `"run"` or `"estimate"`.
    - `formulas`: their texts by name.
    - `requirements`: what they stand for, by name.
    - `model`: a hash of what was simulated; empty where that is not known.
    - `backend`: that simulated it.
    """
    return {
        "result": result,
        "formulas": dict(formulas),
        "requirements": {name: dict(each) for name, each in requirements.items()},
        "model": model,
        "backend": backend,
    }
