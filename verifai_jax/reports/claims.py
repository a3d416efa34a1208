"""Claims of a report: what is claimed, on what evidence, under which assumptions.

claim = Claim("C1", "604 of 20000 simulations violate the property", ("table.parquet",), (...))
claims_json("balance", claims)                      # plain data that a safety case can cite
"""

from collections.abc import Sequence
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
    """

    identifier: str
    claim: str
    evidence: tuple[str, ...]
    assumptions: tuple[str, ...] = ()


def claims_json(subject: str, claims: Sequence[Claim], chain: str) -> dict[str, Any]:
    """Describe claims as plain data.

    **Arguments:**

    - `subject`: what the claims are about.
    - `claims`: the claims.
    - `chain`: last hash of the chain over all inputs of the report.
    """
    return {
        "format": FORMAT,
        "subject": subject,
        "inputs_sha256_chain": chain,
        "claims": [asdict(claim) for claim in claims],
    }
