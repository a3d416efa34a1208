"""The record of a qualification: oracles, outcomes, versions and a hash of the files.

    found = qualify()
    found.passed; print(found); found.save("qualification")

`HAZARDS` lists possible errors of the tool, each with the oracle that detects it.
`test_planted_errors.py`, in the tests of this add-on, plants each in a copy of the package to show
it.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

from verifai_jax.addons.reports.markup import bullets, element, paragraph, table
from verifai_jax.addons.reports.page import Page, Section, render
from verifai_jax.addons.reports.signing import signing_section
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.text import counted, format_seconds, shorten
from verifai_jax.core.store.atomic_files import replacing


@dataclass(frozen=True)
class Outcome:
    """The outcome of one oracle: `what` it checks, and the `message` of its error, if any."""

    name: str
    what: str
    passed: bool
    seconds: float
    message: str = ""


@dataclass(frozen=True)
class Qualification(InNotebook):
    """The outcomes of the oracles on one machine.

    - `versions`: the versions of packages, Python and the machine.
    - `package_sha256`: one hash of all files of the package, by name and content.
    - `date`: the date in UTC.
    - `complete`: whether all oracles were run.
    - `not_exercised`: the public functions that no oracle of those that were run calls.
    """

    outcomes: tuple[Outcome, ...]
    versions: Mapping[str, str]
    package_sha256: str
    date: str
    complete: bool = True
    not_exercised: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """True if all oracles that were run passed."""
        return all(each.passed for each in self.outcomes)

    @property
    def verdict(self) -> str:
        """The verdict in a sentence."""
        fell = [each.name for each in self.outcomes if not each.passed]
        version = self.versions["verifai_jax"]
        text = f"{counted(len(self.outcomes), 'oracle')} of verifai_jax {version}: "
        text += f"{', '.join(fell)} fell" if fell else "all passed on this machine"
        return f"{text}{'' if self.complete else '; others were not asked for'}."

    def __str__(self) -> str:
        width = max(len(each.name) for each in self.outcomes)
        lines = [self.verdict]
        for each in self.outcomes:
            state = "passed" if each.passed else "FELL"
            lines.append(f"  {each.name:<{width}}  {state}, {format_seconds(each.seconds, 2)}")
            lines += [] if each.passed else [f"    {each.what}", f"    {each.message}"]
        left = counted(len(self.not_exercised), "public function")
        lines.append(f"  {left} not exercised: {shorten(', '.join(self.not_exercised), 60)}")
        lines.append(f"  package SHA-256 {self.package_sha256}")
        return "\n".join(lines)

    def save(self, folder: str | Path) -> Path:
        """Write `qualification.html`, to be signed, and `qualification.json`; return the former."""
        known = {each.name: "passed" if each.passed else "fell" for each in self.outcomes}
        errors, caught = {}, []
        for number, hazard in HAZARDS.items():
            errors[number] = {**hazard._asdict(), "caught": hazard.oracle in known}
            here = known.get(hazard.oracle, "not run")
            caught.append((number, hazard.error, hazard.oracle, here))
        plain = {**asdict(self), "passed": self.passed, "errors": errors}
        path = Path(folder) / "qualification.html"
        outcomes = [
            (e.name, e.what, "passed" if e.passed else f"fell: {e.message}", f"{e.seconds:z.1f}")
            for e in self.outcomes
        ]
        oracles = table(["oracle", "what it checks", "outcome", "seconds"], outcomes)
        planted = (
            "Each of these errors was planted in a copy of the package, and the oracle next to it "
            "fell (the tests of this add-on)."
        )
        unnamed = "No oracle above names these public functions; nothing is said about them:"
        used = (
            table(["what", "version"], sorted(self.versions.items())),
            paragraph("SHA-256 of the package: ", element("code", self.package_sha256)),
            paragraph(f"Run on {self.date}."),
        )
        errors_table = table(["error", "what it is", "oracle", "here"], caught)
        unseen = bullets([element("code", name) for name in self.not_exercised])
        page = Page(
            title="Qualification of verifai_jax on this machine",
            headline=self.verdict,
            tone="holds" if self.passed and self.complete else "fails",
            sections=(
                Section("oracles", "What was run", (oracles,)),
                Section("errors", "Possible errors of the tool, and what catches them",
                        (paragraph(planted), errors_table)),
                Section("scope", "What was not exercised", (paragraph(unnamed), unseen)),
                Section("versions", "Versions and files", used),
                signing_section("the tool is fit for the use that is described above"),
            ),
            claims={"package_sha256": self.package_sha256, "passed": self.passed},
        )  # fmt: skip
        with replacing(path) as made, replacing(path.with_suffix(".json")) as partial:
            made.write_text(render(page), encoding="utf-8", newline="\n")
            partial.write_text(json.dumps(plain, indent=2) + "\n", encoding="utf-8")
        return path


class Hazard(NamedTuple):
    """A possible error of the tool, and the name of the oracle that catches it."""

    oracle: str
    error: str


_BY_ORACLE = {
    "formulas": (
        "the last instant of a window is left out",
        "always takes the greatest value, or eventually the least",
        "until forgets what holds before", "a negation is dropped",
        "an implication is read backwards", "a comparison is read as its opposite",
        "a formula is written as another one",
        "after the end of a trace another value than the last one holds",
    ),
    "zeros": (
        "x > 0 holds at zero", "x >= 0 fails at zero",
        "a robustness of zero is a violation, whatever the comparison",
    ),
    "gradients": (
        "a gradient is not that of the robustness",
        "the smooth robustness does not tend to the robustness",
    ),
    "table": (
        "a violation counts as safe", "a safe simulation counts as a violation",
        "a row is lost", "a row is in the table twice", "a row has the robustness of another one",
        "violations are counted wrongly", "the worst row is not the worst",
        "samples of the prior are biased",
    ),
    "statuses": (
        "a simulation that raised counts as a failure, or as safe",
        "a signal that is not finite has a verdict",
        "simulations without a verdict do not widen the interval of a rate",
    ),
    "intervals": (
        "an interval of a rate is too narrow",
        "an interval that should hold at any time does not",
        "too few simulations without a failure are said to be enough",
    ),
    "probabilities": (
        "the estimate of a rare probability is wrong by its weights",
        "the guaranteed bound is too low",
    ),
    "priors": (
        "an interval is scaled wrongly", "a normal feature has another spread",
        "a logarithmic feature is uniform", "weights of choices are ignored",
    ),
    "steps": ("an integrator is of lower order than it says", "a finer step is not finer"),
    "replays": (
        "the same seed gives another table", "another seed gives the same table",
        "a row is replayed under another random key",
    ),
    "kills": (
        "a run that was killed goes on as another run",
        "rows are lost when a process is killed",
        "a record that was changed is believed",
    ),
    "searches": (
        "a search does not learn, and misses what it should find",
        "a rate is given for samples that a search has chosen",
        "a shrunk counterexample does not fail",
    ),
    "confirmations": ("a failure of a coarse step alone is confirmed", "a real failure is refuted"),
    "comparisons": (
        "the two sides of a pair have other features or random numbers",
        "better and worse are exchanged",
    ),
    "divergences": (
        "the worst prior is not the worst",
        "a claim is said to bear a greater shift of the prior than it does",
    ),
    "proofs": (
        "a proof takes integers for numbers that never wrap around",
        "a proof counts points that the constraint refuses as safe",
    ),
    "readings": (
        "a row of a recording is lost below its units",
        "a truth value of a recording is read as its opposite",
    ),
    "judgements": ("a recording always holds", "a robustness on a recording is wrong"),
    "monitors": (
        "a monitor takes the least value for the greatest",
        "a monitor forgets the beginning of a window",
    ),
    "matrices": (
        "a violation is not shown in the trace matrix",
        "claims that were edited are believed",
    ),
}  # fmt: skip
HAZARDS = {
    f"E{number:02}": hazard
    for number, hazard in enumerate(
        (Hazard(oracle, error) for oracle, errors in _BY_ORACLE.items() for error in errors), 1
    )
}
"""The errors by identifier."""
