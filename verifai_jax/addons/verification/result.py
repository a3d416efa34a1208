"""The result of a verification: proved, broken and undecided parts of a feature space.

result.proved, result.broken, result.undecided      # Part(mass, volume), which sum to one
result.table                                        # a row for each box
result.save("verified.json"); load_verification("verified.json")
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from verifai_jax.addons.verification.boxes import BROKEN, OPEN, OUTSIDE, PROVED, Boxes
from verifai_jax.addons.verification.rest import Rest, RestSpace
from verifai_jax.core.display.figure import Drawn, Reported
from verifai_jax.core.display.notebook import InNotebook, frame_html, picture_html
from verifai_jax.core.messages.text import counted, format_percent
from verifai_jax.core.store.files import DamagedError, read_record, write_record
from verifai_jax.problem.model_digest import digest_of_model
from verifai_jax.problem.problem import Problem
from verifai_jax.statistics.confidence_sequences import anytime_interval

KIND = "verification"
TINY = 1e-300
"""A denominator in place of zero."""
LOOSE = 8
"""Share of a search's budget, as its inverse, for the boxes that a proof leaves, at most."""
DISCRETE = (
    "the system in discrete time as it is simulated, in real arithmetic and with the rounding of "
    "{precision}; no differential equation"
)
CONTINUOUS = (
    "the differential equation at all times, in real arithmetic, with the controller's output held "
    "between its samples; no simulation in steps"
)


class Part(NamedTuple):
    """A part of a feature space.

    - `mass`: its share of the prior, given the constraint.
    - `volume`: its share of the volume; boxes that a constraint cuts count as a whole.
    - `low`, `high`: bounds of `mass` at the confidence of the result; equal to it unless the
      constraint cuts boxes.
    """

    mass: float
    volume: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Verification(Drawn, Reported, InNotebook):
    """The result of `verify`.

    - `name`: the name of the problem; `columns`: its unit coordinates.
    - `boxes`: the partition of the unit cube; `shares`, `upper_shares`: the corners of the boxes as
      shares of the features' ranges; `scales`: the values along each coordinate.
    - `constraint`: whether the space has one. The accepted prior is then what it accepts.
    - `tails`: for each feature whose distribution has tails the probability of their outermost
      part, at most, which no coordinate reaches: nothing is known of it.
    - `features`, `formulas`, `model`, `precision`: the subject of the verification; the system is
      given by a hash.
    - `confidence`: the confidence of bounds from samples.
    - `continuous`: whether it is about the differential equation.
    - `looked_at`: number of examined boxes; `simulations`: number of simulations; `seconds`:
      wall-clock time; `stopped`: the reason for ending.
    - `notes`: notes for the user; `version`; `sources`: the model's files, as a run records them.
    """

    _report = "verifai_jax.addons.verification.report", "verification_page"
    _picture = "verifai_jax.addons.verification.picture", "plot_verification"
    _internal = frozenset((
        "check_same", "constraint", "cut", "cut_off", "ends", "left", "loosest", "note", "of_prior",
        "scales",
    ))  # fmt: skip
    name: str
    columns: tuple[str, ...]
    boxes: Boxes = field(repr=False)
    shares: Float[np.ndarray, "n dim"] = field(repr=False)
    upper_shares: Float[np.ndarray, "n dim"] = field(repr=False)
    scales: tuple[Mapping[str, Any], ...] = field(repr=False)
    features: Mapping[str, str]
    constraint: bool
    tails: Mapping[str, float]
    formulas: Mapping[str, str]
    model: str
    precision: str
    confidence: float
    looked_at: int
    simulations: int
    seconds: float
    stopped: str
    notes: tuple[str, ...]
    version: str
    sources: Mapping[str, Any] = field(repr=False)
    continuous: bool = False

    @cached_property
    def verdicts(self) -> np.ndarray:
        """For each box `"proved"`, `"broken"`, `"undecided"` or `"outside"` (the constraint)."""
        words = np.array(["undecided", "proved", "broken", "outside"])[self.boxes.state]
        return np.where(self.boxes.confirmed, "broken", words)

    @property
    def subject(self) -> str:
        """The subject of all proofs: the steps of simulations, or the differential equation."""
        return CONTINUOUS if self.continuous else DISCRETE.format(precision=self.precision)

    @property
    def cut(self) -> Bool[np.ndarray, " n"]:
        """Boxes of which the constraint may refuse points, so that samples bound their mass."""
        return (self.boxes.state == OPEN) & ~self.boxes.inside

    def _accepted(
        self, rows: Bool[np.ndarray, " n"], confidence: float = 1.0
    ) -> tuple[float, float]:
        """Return bounds of the mass of boxes that the constraint accepts, certain at 1."""
        cut = rows & self.cut
        known = float(self.boxes.mass[rows & ~cut & (self.boxes.state != OUTSIDE)].sum())
        whole, drawn = float(self.boxes.mass[cut].sum()), int(self.boxes.drawn[cut].sum())
        if not (whole and drawn) or confidence == 1:
            return known, known + whole
        rate = anytime_interval(int(self.boxes.accepted[cut].sum()), drawn, confidence)
        return known + whole * rate.low, known + whole * rate.high

    @cached_property
    def _masses(self) -> Float[np.ndarray, "3 n"]:
        """The accepted mass of each box, estimated if it is cut, and bounds for this box alone."""
        boxes, confidence = self.boxes, 1 - (1 - self.confidence) / 2
        masses = np.tile(np.where(boxes.state == OUTSIDE, 0.0, boxes.mass), (3, 1))
        for cut in (self.cut & boxes.confirmed, self.cut & ~boxes.confirmed):
            drawn, accepted = boxes.drawn[cut], boxes.accepted[cut]
            # One more draw of each is accepted as those of all are: none counts as nothing.
            usual = (accepted.sum() + 1) / (drawn.sum() + 1)
            shares = [(accepted + usual) / (drawn + 1), np.zeros(len(drawn)), np.ones(len(drawn))]
            for i in np.flatnonzero(drawn):
                rate = anytime_interval(int(accepted[i]), int(drawn[i]), confidence)
                shares[1][i], shares[2][i] = rate.low, rate.high
            masses[:, cut] *= shares
        return masses

    def _part(self, rows: Bool[np.ndarray, " n"]) -> Part:
        inside = self.boxes.state != OUTSIDE
        shares = []
        for weights in (self._masses[0], np.prod(self.upper_shares - self.shares, axis=1)):
            whole = weights[inside].sum()
            shares.append(float(weights[rows & inside].sum() / whole) if whole > 0 else 0.0)
        if not self.cut.any():
            return Part(shares[0], shares[1], shares[0], shares[0])
        half = 1 - (1 - self.confidence) / 2
        (low, high), (lower, upper) = (self._accepted(each, half) for each in (rows, ~rows))
        lowest, highest = low / max(low + upper, TINY), high / max(high + lower, TINY)
        return Part(shares[0], shares[1], lowest, highest)

    @property
    def proved(self) -> Part:
        """The part in which no point fails."""
        return self._part(self.boxes.state == PROVED)

    @property
    def broken(self) -> Part:
        """The boxes that contain a certainly failing point."""
        return self._part(self.verdicts == "broken")

    @property
    def throughout(self) -> Part:
        """The part of `broken` in which every point fails."""
        return self._part(self.boxes.state == BROKEN)

    @property
    def undecided(self) -> Part:
        """The part that is neither proved nor broken."""
        return self._part(self.verdicts == "undecided")

    @property
    def failure_bound(self) -> float:
        """An upper bound of the failure probability within the undecided part, from samples."""
        return self._failing(self.confidence)

    def _failing(self, confidence: float) -> float:
        rows = self.verdicts == "undecided"
        count, failures = (int(n[rows].sum()) for n in (self.boxes.samples, self.boxes.failures))
        if not rows.any():
            return 0.0
        return anytime_interval(failures, count, confidence).high if count else 1.0

    @property
    def probability(self) -> tuple[float, float]:
        """Bounds of the failure probability, given the constraint.

        Let P, B and U be the accepted masses of the proved, broken and undecided boxes, and q the
        share of U that fails. The probability is at most `(B + q U) / (P + B + U)`. That rises with
        B and q, and is monotone in U, so its maximum is at the upper bounds of B and q, and at one
        end of U. P is known; B, U and q have intervals with a third of the allowed error each,
        unless the constraint cuts no box and B and U are known, too. The samples of q are accepted
        points, so that they are independent samples of U. At least those boxes fail in which every
        point does, which is certain: there boxes that are cut count as a whole.
        """
        confidence = 1 - (1 - self.confidence) / (3 if self.cut.any() else 1)
        broken, undecided = (self.verdicts == name for name in ("broken", "undecided"))
        (proved, _), (_, failing) = (
            self._accepted(rows, confidence) for rows in (self.boxes.state == PROVED, broken)
        )
        share, every = self._failing(confidence), self._accepted(self.boxes.state >= OPEN)[1]
        highest = max(
            (failing + share * rest) / max(proved + failing + rest, TINY)
            for rest in (max(end, TINY) for end in self._accepted(undecided, confidence))
        )
        return self._accepted(self.boxes.state == BROKEN)[0] / max(every, TINY), min(1.0, highest)

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row for each box, the largest first.

        Columns are `verdict`, `throughout` (every point fails), `mass` (of accepted points),
        `volume`, bounds of the robustness, `failure_bound` (an upper bound of the failure
        probability of its accepted points, from its own samples, at the confidence for each single
        box), bounds of `mass` at that confidence, and for each coordinate the values of its feature
        between which the box lies: of a discrete one the first and the last value. A coordinate
        that is no feature's alone has shares of its range, from 0 to 1.
        """
        boxes, half = self.boxes, 1 - (1 - self.confidence) / 2
        bound = np.where((boxes.state == PROVED) | (boxes.state == OUTSIDE), 0.0, 1.0)
        for i in np.flatnonzero((boxes.samples > 0) & (self.verdicts == "undecided")):
            counts = int(boxes.failures[i]), int(boxes.samples[i])
            bound[i] = anytime_interval(*counts, self.confidence).high
        lower, upper = self._accepted(np.ones(len(boxes), bool), half)
        wholes = self._masses[0].sum(), upper, lower
        mass, low, high = (m / max(w, TINY) for m, w in zip(self._masses, wholes, strict=True))
        rows: dict[str, Any] = {
            "verdict": self.verdicts, "throughout": boxes.state == BROKEN, "mass": mass,
            "volume": np.prod(self.upper_shares - self.shares, axis=1), "lowest": boxes.lowest,
            "highest": boxes.highest, "failure_bound": bound,
            "mass_low": low, "mass_high": np.minimum(high, 1.0),
        }  # fmt: skip
        for j, column in enumerate(self.columns):
            rows[f"{column} from"], rows[f"{column} to"] = self.ends(j)
        return pd.DataFrame(rows).sort_values("mass", ascending=False, kind="stable")

    def ends(self, coordinate: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the values between which the boxes lie along a coordinate, as in the table."""
        scale, shares = self.scales[coordinate], (self.shares, self.upper_shares)
        values = np.array(scale.get("values", [0.0, 1.0]))
        if "edges" in scale:
            low, high = self.boxes.low[:, coordinate], self.boxes.high[:, coordinate]
            first = np.searchsorted(scale["edges"], low, "right") - 1
            return values[first], values[np.searchsorted(scale["edges"], high, "left") - 1]
        low, high = values.tolist()
        return tuple(low + each[:, coordinate] * (high - low) for each in shares)

    @property
    def of_prior(self) -> str:
        """The words for the whole of which shares are taken."""
        return "of the accepted prior" if self.constraint else "of the prior"

    @property
    def cut_off(self) -> str:
        """A sentence on the tails that are cut off; empty without any."""
        if not self.tails:
            return ""
        whole = max(self._accepted(np.ones(len(self.boxes), bool), self.confidence)[0], TINY)
        share = format_percent(min(1.0, sum(self.tails.values()) / whole))
        return (
            f"nothing is known of the outermost tails of {', '.join(self.tails)}, which no "
            f"simulation reaches: at most {share} {self.of_prior}, in no bound above"
        )

    def __str__(self) -> str:
        of, sure = self.of_prior, format_percent(self.confidence)

        def line(name: str, part: Part, text: str) -> str:
            if not part.mass:
                return f"  {name:<12} nothing"
            mass, volume, low, high = map(format_percent, part)
            if self.cut.any():
                return f"  {name:<12} {mass} {of} ({low} to {high} at {sure}): {text}"
            return f"  {name:<12} {mass} {of}, {volume} of the volume: {text}"

        low, high = self.probability
        proved, broken, undecided = self.proved, self.broken, self.undecided
        shares = [format_percent(part.mass) for part in (proved, broken, undecided)]
        count = counted(int(self.boxes.samples.sum()), "sample")
        inside, bound = map(format_percent, (self.throughout.low, self.failure_bound))
        certain = f"boxes with a point that fails for certain; in {inside}"
        lines = [
            f"{self.name}: {shares[0]} {of} is proved, {shares[1]} broken, {shares[2]} undecided",
            line("proved", proved, "no point of it fails"),
            line("broken", broken, f"{certain} of the prior every point does"),
            line("undecided", undecided, f"at most {bound} of it fails, at {sure} by {count}"),
            f"  failing      {format_percent(low)} {of} at least, "
            f"{format_percent(high)} at most{f' at {sure}' if undecided.high > 0 else ''}",
            f"  boxes        {len(self.boxes):,} of {self.looked_at:,} that were looked at, "
            f"{self.simulations:,} simulations in {self.seconds:z.1f} s, stopped: {self.stopped}",
            f"  verified     {self.subject}",
            *([f"  tails        {self.cut_off}"] if self.tails else []),
        ]  # fmt: skip
        return "\n".join([*lines, *(f"  note         {note}" for note in self.notes)])

    __repr__ = __str__

    def _notebook_parts(self) -> list[str]:
        return [picture_html(self.plot()), frame_html(self.table)]

    def check_same(self, problem: Problem, precision: str, continuous: bool = False) -> None:
        """Refuse a problem other than the verified one by a `ValueError` on the difference."""
        if continuous != self.continuous:
            raise ValueError(
                f"this verification is about {self.subject}; verify with continuous={continuous}"
            )
        for what, now in {**described(problem), "precision": precision}.items():
            then = getattr(self, what)
            if then != now:
                raise ValueError(
                    f"this verification is of another problem: its {what} was {then!r}, and is "
                    f"{now!r} now; verify this problem"
                )

    def left(self, problem: Problem, precision: str) -> Rest:
        """Return the part of the feature space where neither all points fail nor none does."""
        self.check_same(problem, precision)
        return Rest(self.boxes, (PROVED, BROKEN))

    @property
    def note(self) -> str:
        """A sentence on simulations of the remaining part."""
        share = format_percent(self.proved.mass)
        return f"{share} {self.of_prior} is proved and not simulated; all rates are of the rest"

    def loosest(self, problem: Problem, budget: int) -> pd.DataFrame | None:
        """Return rows from the unproved part with the loosest bounds, for a search to start with.

        First come points that fail when simulated, then middles of boxes by increasing lower bound
        of the robustness.

        They take at most an eighth of the search's budget; None if everything is proved. The
        problem is the one that `rest` returned.
        """
        boxes = self.boxes[~np.isin(self.boxes.state, (PROVED, OUTSIDE))]
        boxes = boxes[np.lexsort((-boxes.mass, boxes.lowest, ~boxes.has_witness))]
        known, middle = boxes.has_witness[:, None], boxes.low / 2 + boxes.high / 2
        points = np.where(known, boxes.witness, middle).astype(np.float32)
        points = points[problem.space.accepts_points(points)][: max(1, budget // LOOSE)]
        rows = pd.DataFrame(problem.space.rows(problem.space.features_at(points)))
        return rows if len(rows) else None

    def rest(self, problem: Problem, precision: str = "float32") -> Problem:
        """Return the problem without its proved part, so that searches spend nothing there.

        Its constraint refuses the proved boxes, so rates refer to the remaining part.

        **Arguments:**
        - `problem`: the problem that was verified.
        - `precision`: the precision of later simulations, which must be the verified one.
        **Raises:** `ValueError` for another problem or precision, and if nothing is left.
        """
        self.check_same(problem, precision)
        left = Rest(self.boxes, (PROVED,))
        if not left.mass:
            raise ValueError(f"all of {problem.name!r} is proved: nothing is left to search")
        return replace(problem, space=RestSpace(problem.space, left))

    def save(self, path: str | Path) -> Path:
        """Write the result as JSON, for `load_verification`.

        **Arguments:**
        - `path`: the path of the file; its folder is made if needed.
        **Returns:** the path.
        **Raises:** `OSError` that names the file, if the file system refuses.
        """
        plain = {name: value for name, value in vars(self).items()
                 if name in self.__dataclass_fields__}  # fmt: skip
        for name in ("shares", "upper_shares"):
            plain[name] = plain[name].tolist()
        arrays = {name: array.tolist() for name, array in asdict(self.boxes).items()}
        write_record(Path(path), {"kind": KIND, **plain, "boxes": arrays}, locked=False)
        return Path(path)


def as_verification(result: "Verification | str | Path") -> Verification:
    """Return a result; a path is read by `load_verification`."""
    return load_verification(result) if isinstance(result, str | Path) else result


def described(problem: Problem) -> dict[str, Any]:
    """Return the record of a problem in a result."""
    return {
        "name": problem.name,
        "features": {name: repr(domain) for name, domain in problem.space.domains.items()},
        "formulas": {name: str(formula) for name, formula in problem.formulas.items()},
        "model": digest_of_model(problem),
    }


def read_verification(file: Path, data: object, space: object) -> Verification:
    """Return the result in a file, for `verifai-jax report`."""
    return load_verification(file)


def load_verification(path: str | Path) -> Verification:
    """Read a result written by `Verification.save`.

    **Raises:** `FileNotFoundError`; `DamagedError` for a changed file, or one that is not a result.
    """
    record = read_record(Path(path))
    if record.pop("kind", None) != KIND:
        raise DamagedError(f"{path} is not a result of verify")
    dim = len(record["columns"])
    types = dict.fromkeys(("state", "drawn", "accepted", "failures", "samples"), int)
    types |= {"confirmed": bool, "inside": bool}
    arrays = {
        name: np.array(values, types.get(name, float)) for name, values in record["boxes"].items()
    }
    for name in ("low", "high", "witness"):
        arrays[name] = arrays[name].reshape(-1, dim)
    record["boxes"] = Boxes(**arrays)
    for name in ("shares", "upper_shares"):
        record[name] = np.array(record[name], float).reshape(-1, dim)
    for name in ("columns", "notes", "scales"):
        record[name] = tuple(record[name])
    return Verification(**record)
