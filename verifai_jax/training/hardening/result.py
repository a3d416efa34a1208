"""The result of a hardening: failure probability and return before and after, round by round.

result.table                            a row for each round and arm
print(result)                           before, after, what it cost
result.plot("hardening.png"); result.policy
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import Tabular
from verifai_jax.core.messages.text import format_percent
from verifai_jax.core.store.files import replacing_all
from verifai_jax.core.store.locks import write_lock
from verifai_jax.estimation.certification import Certificate, Certificates
from verifai_jax.estimation.comparison import Comparison
from verifai_jax.rl.policy import Policy, save_policy
from verifai_jax.statistics.confidence_sequences import safe_at
from verifai_jax.statistics.paired import PairedDifference, paired_difference

HARDENED, BASELINE = "hardened", "randomised"
"""Names of the arms: with counterexamples, and with the prior alone (domain randomisation)."""
FILES = ("added.parquet", "summary.txt", "start.npz", "policy.npz", "table.parquet")
"""Files of a result in a folder."""


@dataclass(frozen=True, eq=False)
class Hardening(Drawn, Tabular):
    """The result of `harden`.

    - `problem`: name of the problem.
    - `table`: a row for each round and arm: `steps` of training so far, `failures` among
      `simulations` with the interval of that round's certificate by itself, its `verdict`,
      `attack_failures`, the mean `return`, points `added` afterwards, `cost` in simulations, and
      `seconds`.
    - `added`: features of all points that were trained around, with `round` and `source`.
    - `start`, `policy`: before and after.
    - `policies`: the policies of each arm and round; `chosen`: the round of each arm.
    - `certificates`: the certificates of the policies before, after, and of the baseline's, if
      there is one, from samples that nothing was trained on or chosen by. Their intervals hold
      together.
    - `comparison`: the comparison of before and after in pairs; None if the first policy is
      returned.
    - `returns`: of `"start"` and the arms' chosen policies, episode by episode in pairs.
    - `stopped`: `"certified"`, `"budget"` or `"max_seconds"`.
    - `options`: numbers that it was called with; `notes` for people; `seconds`; `version`.
    """

    _picture = "hardening", "plot_hardening"
    """Failure probability and return of each round."""
    problem: str
    table: pd.DataFrame
    added: pd.DataFrame
    start: Any
    policy: Any
    policies: Mapping[tuple[str, int], Any] = field(repr=False)
    chosen: Mapping[str, int]
    certificates: Certificates
    comparison: Comparison | None
    returns: Mapping[str, Float[np.ndarray, " episodes"]]
    stopped: str
    seconds: float
    options: Mapping[str, Any]
    notes: tuple[str, ...]
    version: str

    @property
    def before(self) -> Certificate:
        """The certificate of the first policy."""
        return self.certificates[0]

    @property
    def after(self) -> Certificate:
        """The certificate of the returned policy."""
        return self.certificates[1]

    @property
    def baseline(self) -> Certificate | None:
        """The certificate of domain randomisation at equal environment steps."""
        return self.certificates[2] if len(self.certificates) > 2 else None

    @property
    def safe(self) -> bool:
        """True where the returned policy's failure probability is below p."""
        return self.after.verdict == safe_at(self.options["p"])

    @property
    def times_safer(self) -> float:
        """The failure probability before as a multiple of that after; infinite where none fails."""
        before, after = self.before.rate, self.after.rate
        if before is None or after is None or not before.estimate:
            return float("nan")
        return before.estimate / after.estimate if after.estimate else float("inf")

    def lost(self, arm: str = HARDENED) -> PairedDifference:
        """Compare the returns before and after on the same episodes: before minus after."""
        before, after = self.returns["start"], self.returns[arm]
        return paired_difference(before, after, self.options["confidence"])

    def summary(self) -> str:
        """Write what was gained, what was lost and what it cost."""
        rounds, sure = max(self.table["round"]), format_percent(self.options["confidence"])
        lines = [
            f"{self.problem}: hardened in {rounds} round{'s' * (rounds != 1)} "
            f"({self.stopped}); the policy of round {self.chosen[HARDENED]} is returned"
        ]
        named = ("before", "after", f"randomised (round {self.chosen.get(BASELINE)})")
        arms = zip(named, self.certificates.rows, self.returns.values(), strict=False)
        for name, one, returns in arms:
            known = f"{returns.mean():z.4g}" if np.isfinite(returns).all() else "unknown"
            lines.append(f"  {name + ':':<9} {_chance(one)}; return {known}")
        lines.append(
            f"  the intervals hold together with {sure}, on samples that nothing was trained on"
        )
        before, after = self.before.rate, self.after.rate
        if before is not None and after is not None and self.chosen[HARDENED]:
            by_bounds = before.low / after.high if after.high else float("inf")
            lines.append(
                f"  the failure probability before is {self.times_safer:z.3g} times that after, "
                f"{by_bounds:z.3g} times at least by the intervals"
            )
        if self.comparison is not None:
            compared = self.comparison.candidates[0]
            lines.append(f"  in pairs: {compared.verdict} ({compared.rates})")
        if np.isfinite(self.returns["start"]).all():
            lines.append(f"  return lost: {self.lost()}")
        own = self.table.loc[self.table["arm"] == HARDENED]
        sources = self.added["source"].value_counts() if len(self.added) else {}
        added = [f"{count} of kind {source}" for source, count in sources.items()]
        lines.append(
            f"  added {', '.join(added) or 'nothing'}; {max(own['steps']):,} environment "
            f"steps, {sum(own['cost']):,} simulations, {self.seconds:z.0f} s"
        )
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])

    def save(self, folder: str | Path) -> Path:
        """Write table, added features, summary and policies to a folder, which is returned.

        **Raises:** `FolderInUse`; `OSError` for what the file system refuses: what was there stays.
        """
        path = Path(folder)
        with write_lock(path), replacing_all(path, FILES) as made:
            for name, frame in (("table", self.table), ("added", self.added)):
                frame.to_parquet(made / f"{name}.parquet")
            (made / "summary.txt").write_text(f"{self.summary()}\n", encoding="utf-8")
            for name, policy in (("start", self.start), ("policy", self.policy)):
                if isinstance(policy, Policy):
                    save_policy(policy, made / f"{name}.npz", problem=self.problem)
                else:
                    policy.save(made / f"{name}.npz")
        return path

    def __str__(self) -> str:
        return self.summary()

    __repr__ = __str__


def _chance(one: Certificate) -> str:
    if one.rate is None:
        return "not simulated"
    chance, low, high = map(format_percent, (one.rate.estimate, one.rate.low, one.rate.high))
    counted = f"{one.failures + one.not_finite:,} of {one.simulations:,}"
    return f"fails with {chance} ({low} to {high}; {counted}), {one.verdict}"
