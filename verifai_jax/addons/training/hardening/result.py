"""The result of a hardening: failure probability and return before, after, and by round."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from verifai_jax.addons.estimation.certification import Certificate, Certificates
from verifai_jax.addons.estimation.comparison import Comparison
from verifai_jax.addons.estimation.simultaneous_interval import safe_at
from verifai_jax.addons.training.paired import PairedDifference, paired_difference
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import Tabular
from verifai_jax.core.messages.text import counted, format_percent
from verifai_jax.core.store.locks import write_lock
from verifai_jax.core.store.replacements import replacing_all

HARDENED, BASELINE = "hardened", "randomised"
"""Names of the arms: with counterexamples, and with the prior alone (domain randomisation)."""
FILES = ("added.parquet", "summary.txt", "start.npz", "policy.npz", "table.parquet")
"""Files of a result in a folder."""


@dataclass(frozen=True, eq=False)
class Hardening(Drawn, Tabular):
    """The result of `harden`.

    - `problem`: the name of the problem.
    - `table`: a row for each round and arm: `steps` of training so far, `failures` among
      `simulations` with the separate interval of that round's certificate, its `verdict`,
      `attack_failures`, the mean `return`, the number of points `added` afterwards, `cost` in
      simulations, and `seconds`.
    - `added`: features of all points that were trained around, with `round` and `source`.
    - `start`, `policy`: the policies before and after.
    - `policies`: the policies of each arm and round; `chosen`: the chosen round of each arm.
    - `certificates`: certificates of the policies before and after, and of the baseline if there is
      one. Their samples were used for no training and no choice; their intervals hold jointly.
    - `comparison`: the paired comparison of before and after; None if the first policy is returned.
    - `returns`: returns of `"start"` and of each arm's chosen policy, on the same episodes.
    - `stopped`: `"certified"`, `"budget"` or `"max_seconds"`.
    - `options`: the options of the call; `notes`: remarks for the reader; `seconds`: wall-clock
      time; `version`: the version of verifai_jax.
    """

    _picture = "verifai_jax.addons.training.pictures.hardening", "plot_hardening"
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
        """The ratio of the failure probabilities before and after; infinite if none fails after."""
        before, after = self.before.rate, self.after.rate
        if before is None or after is None or not before.estimate:
            return float("nan")
        return before.estimate / after.estimate if after.estimate else float("inf")

    def lost(self, arm: str = HARDENED) -> PairedDifference:
        """Compare the returns before and after on the same episodes: before minus after."""
        before, after = self.returns["start"], self.returns[arm]
        return paired_difference(before, after, self.options["confidence"])

    def summary(self) -> str:
        """Write the gain in safety, the loss of return, and the cost."""
        rounds, sure = max(self.table["round"]), format_percent(self.options["confidence"])
        lines = [
            f"{self.problem}: hardened in {counted(rounds, 'round')} ({self.stopped}); the policy "
            f"of round {self.chosen[HARDENED]} is returned"
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
        if before is not None and after is not None and before.failures and self.chosen[HARDENED]:
            by_bounds = before.low / after.high if after.high else float("inf")
            sampled = f"{self.times_safer:z.3g} times by the samples"
            lines.append(
                f"  the failure probability before is at least {by_bounds:z.3g} times that after, "
                f"by the intervals ({sampled if after.failures else 'no sample fails after'})"
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

    __str__ = __repr__ = summary

    def save(self, folder: str | Path) -> Path:
        """Write table, added features, summary and policies to a folder, which is returned.

        **Raises:** `FolderInUse` if another process writes there; `OSError` if the file system
        refuses, in which case the old content stays.
        """
        path = Path(folder)
        with write_lock(path), replacing_all(path, FILES) as made:
            self.table.to_parquet(made / "table.parquet")
            self.added.to_parquet(made / "added.parquet")
            (made / "summary.txt").write_text(f"{self.summary()}\n", encoding="utf-8")
            self.start.save(made / "start.npz")
            self.policy.save(made / "policy.npz")
        return path


def _chance(one: Certificate) -> str:
    if one.rate is None:
        return "not simulated"
    chance, low, high = map(format_percent, (one.rate.estimate, one.rate.low, one.rate.high))
    failing = f"{one.failures + one.not_finite:,} of {one.simulations:,}"
    return f"fails with {chance} ({low} to {high}; {failing}), {one.verdict}"
