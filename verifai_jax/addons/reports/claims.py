"""Claims of a report, with their evidence and assumptions.

claim = Claim("C1", "604 of 20000 simulations violate the property", ("table.parquet",), (...))
claims_json("balance", claims)                      # plain data that a safety case can cite
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

FORMAT = 1
"""Number of the format of claims as JSON."""
PAGE, SEAL = "report_sha256", "claims_sha256"
"""Entries of a file of claims: the hashes of its report, and of all its other entries."""


def sealed(claims: Mapping[str, Any]) -> dict[str, Any]:
    """Return claims with the hash of their other entries, which tells whether they were edited."""
    said = {name: value for name, value in claims.items() if name != SEAL}
    text = json.dumps(said, sort_keys=True)
    return {**said, SEAL: hashlib.sha256(text.encode()).hexdigest()}


@dataclass(frozen=True)
class Claim:
    """A sentence that the evidence supports.

    - `identifier`: the identifier for safety cases to cite, such as `C2`; `claim`: the sentence.
    - `evidence`, `assumptions`: on what it rests, and under what it holds.
    - `requirements`: identifiers of its requirements; empty for all requirements of the report.
    """

    identifier: str
    claim: str
    evidence: tuple[str, ...]
    assumptions: tuple[str, ...] = ()
    requirements: tuple[str, ...] = ()


def claims_json(
    subject: str, claims: Sequence[Claim], chain: str, about: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Describe claims as plain data, with the last hash of the chain over a report's inputs.

    `about` is what they are about, for comparison in `vj.trace_matrix`; see `about_json`.
    """
    return {
        "format": FORMAT, "subject": subject, "inputs_sha256_chain": chain,
        "about": dict(about or {}), "claims": [asdict(claim) for claim in claims],
    }  # fmt: skip


def about_json(
    result: str, formulas: Mapping[str, str], requirements: Mapping[str, Mapping[str, str]],
    model: str = "", backend: str | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Describe the subject of claims as plain data: a run, say, with its formulas by name.

    `model` is a hash of what was simulated, empty if unknown, on `backend`.
    """
    said = {name: dict(each) for name, each in requirements.items()}
    return {
        "result": result, "formulas": dict(formulas), "requirements": said, "model": model,
        "backend": backend,
    }  # fmt: skip
