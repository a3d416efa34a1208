"""Counts over the rows of a table that stand out, from which a summary is written."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.evaluation.confirmations import Repetitions, Standing
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.falsification.columns import Columns


@dataclass
class Counts:
    """Counts over a table, computed without its ordinary safe rows.

    - `violating`: rows that violate the property as simulated.
    - `claimed`, `refused`, `not_replayed`: the standing of these, which they add up to; see
      `confirmations.Standing`.
    - `failing_alone`: violating rows that violate only this formula, if there are several.
    - `failed`: number of rows without a verdict by status, the most frequent first.
    - `verdicts`: number of violating rows by verdict of closer replays, the most frequent first.
    - `repetitions`: number of violating rows of a host system whose repetition gave the same
      result.
    - `worst`: number of the claimed row with the least robustness; None without one.
    - `nearest`: number of the row with the least robustness among all rows with a verdict.
    - `lowest`: the least robustness of all rows; NaN if no row has a verdict.
    - `first_message`: number and text of the first row without a verdict that has a message.
    - `not_differentiated`: rows whose gradient is not finite.
    """

    violating: int = 0
    claimed: int = 0
    refused: int = 0
    not_replayed: int = 0
    failing_alone: Counter[str] = field(default_factory=Counter)
    failed: dict[str, int] = field(default_factory=dict)
    verdicts: dict[str, int] = field(default_factory=dict)
    repetitions: Repetitions = field(default_factory=Repetitions)
    worst: int | None = None
    nearest: int | None = None
    lowest: float = float("nan")
    first_message: tuple[int, str] | None = None
    not_differentiated: int = 0

    @property
    def may_fail(self) -> bool:
        """True unless closer replays refused each violation: what a gate or a test fails on."""
        return self.claimed + self.not_replayed > 0

    @property
    def without_verdict(self) -> int:
        """Number of rows without a verdict."""
        return sum(self.failed.values())

    @property
    def best(self) -> int | None:
        """Number of the worst row, or of the nearest if none is claimed."""
        return self.nearest if self.worst is None else self.worst


@dataclass
class Tally:
    """Counts over the rows of a running run.

    - `claimed`: counterexamples that closer replays confirmed; without these, all of them.
    - `violating`: simulations that violate the property.
    - `without_verdict`: simulations without a verdict.
    - `lowest`: the least robustness.
    """

    claimed: int = 0
    violating: int = 0
    without_verdict: int = 0
    lowest: float = float("nan")

    def add(self, verdicts: Verdicts, claimed: Bool[np.ndarray, " n"]) -> None:
        """Count the rows of a round."""
        self.claimed += int(np.sum(claimed))
        self.violating += int(np.sum(verdicts.violated))
        self.without_verdict += int(np.sum(~verdicts.proper))
        self.lowest = float(np.fmin(self.lowest, np.fmin.reduce(verdicts.lowest)))

    def numbers(self, simulations: int) -> dict[str, float]:
        """Return plain numbers of the run after this many simulations, for callbacks."""
        return {
            "simulations": simulations,
            "violating": self.violating,
            "counterexamples": self.claimed,
            "without_verdict": self.without_verdict,
            "least_robustness": self.lowest,
        }


def standing(columns: Columns) -> Standing:
    """Return which rows are claimed as counterexamples, refused by replays, or not replayed."""
    return Standing.of(violating_rows(columns), columns.get("verdict"))


def violating_rows(columns: Columns) -> Bool[np.ndarray, " n"]:
    """Mark rows that ended properly and violate the property as simulated."""
    return (columns["status"] == "ok") & columns["violated"].astype(bool)


def count(parts: Iterable[tuple[Int[np.ndarray, " n"], Columns]]) -> Counts:
    """Count over consecutive parts of a table, each given as row numbers and columns."""
    counts, statuses, verdicts = Counts(), Counter[str](), Counter[str]()
    lowest = {"worst": np.inf, "nearest": np.inf}
    for numbers, columns in parts:
        if not len(numbers):
            continue
        proper = columns["status"] == "ok"
        violating, (claimed, refused, not_replayed) = violating_rows(columns), standing(columns)
        counts.violating += int(np.sum(violating))
        counts.claimed += int(np.sum(claimed))
        counts.refused += int(np.sum(refused))
        counts.not_replayed += int(np.sum(not_replayed))
        statuses.update(map(str, columns["status"][~proper]))
        if "verdict" in columns:
            verdicts.update(map(str, columns["verdict"][violating]))
            if "rho_again" in columns:
                own = (columns[name][violating] for name in ("rho", "rho_again", "verdict"))
                counts.repetitions = counts.repetitions.joined(Repetitions.count(*own))
        rho = np.asarray(columns["rho"], np.float64)
        counts.lowest = float(np.fmin(counts.lowest, np.fmin.reduce(rho)))
        rho = np.nan_to_num(rho, nan=np.inf)
        for name, among in (("worst", claimed), ("nearest", proper)):
            indices = np.flatnonzero(among)
            if len(indices):
                index = indices[np.argmin(rho[indices])]
                if getattr(counts, name) is None or rho[index] < lowest[name]:
                    setattr(counts, name, int(numbers[index]))
                    lowest[name] = float(rho[index])
        if counts.first_message is None and "message" in columns:
            said = (i for i in np.flatnonzero(~proper) if columns["message"][i])
            if (first := next(said, None)) is not None:
                counts.first_message = int(numbers[first]), str(columns["message"][first])
        if "gradient_finite" in columns:
            counts.not_differentiated += int(np.sum(~columns["gradient_finite"].astype(bool)))
        if each := [name for name in columns if name.startswith("rho.")]:
            of_each = np.stack([columns[name][violating] for name in each], axis=1)
            failing = _failing_alone(of_each.astype(np.float64)).tolist()
            names = [name.removeprefix("rho.") for name in each]
            counts.failing_alone.update(dict(zip(names, failing, strict=True)))
    counts.failed, counts.verdicts = dict(statuses.most_common()), dict(verdicts.most_common())
    return counts


def _failing_alone(rho: Float[np.ndarray, "n formulas"]) -> Int[np.ndarray, " formulas"]:
    # At exactly zero the row does not say which formula is strict, unless there is only one.
    only = np.sum(rho <= 0, axis=1, keepdims=True) == 1
    return np.sum((rho < 0) | ((rho == 0) & only), axis=0)
