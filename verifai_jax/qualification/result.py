"""The record of a qualification: what was run, what fell, with which versions and files.

found = qualify()
found.passed; print(found); found.save("qualification")
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from verifai_jax.core.atomic_files import replacing
from verifai_jax.core.notebook import InNotebook
from verifai_jax.core.text import counted, format_seconds
from verifai_jax.qualification.hazards import HAZARDS
from verifai_jax.reports.markup import Markup, element, paragraph, table
from verifai_jax.reports.page import Page, Section, write_page
from verifai_jax.reports.signing import signing_section


@dataclass(frozen=True)
class Outcome:
    """The outcome of one oracle.

    - `what`: it checks, as a sentence.
    - `message`: what was wrong; empty where it passed.
    """

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
    - `date`: in UTC.
    - `complete`: whether all oracles were run.
    """

    outcomes: tuple[Outcome, ...]
    versions: Mapping[str, str]
    package_sha256: str
    date: str
    complete: bool = True

    @property
    def passed(self) -> bool:
        """True if every oracle that was run passed."""
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
        lines.append(f"  package SHA-256 {self.package_sha256}")
        return "\n".join(lines)

    def save(self, folder: str | Path) -> Path:
        """Write `qualification.html`, to be signed, and `qualification.json`; return the former."""
        known = {each.name: each for each in self.outcomes}
        errors = {
            number: {**hazard._asdict(), "caught": hazard.oracle in known}
            for number, hazard in HAZARDS.items()
        }
        plain = {**asdict(self), "passed": self.passed, "errors": errors}
        path = Path(folder) / "qualification.html"
        with replacing(path.with_suffix(".json")) as partial:
            partial.write_text(json.dumps(plain, indent=2) + "\n", encoding="utf-8")
        page = Page(
            title="Qualification of verifai_jax on this machine",
            headline=self.verdict,
            tone="holds" if self.passed and self.complete else "fails",
            sections=(
                Section("oracles", "What was run", (self._oracles(),)),
                Section(
                    "errors",
                    "Possible errors of the tool, and what catches them",
                    (
                        paragraph(
                            "Each of these errors was planted in a copy of the package, and the "
                            "oracle next to it fell (tests/qualification of the sources)."
                        ),
                        table(
                            ["error", "what it is", "oracle", "here"],
                            [
                                (n, h.error, h.oracle, _state(known.get(h.oracle)))
                                for n, h in HAZARDS.items()
                            ],
                        ),
                    ),
                ),
                Section(
                    "versions",
                    "Versions and files",
                    (
                        table(["what", "version"], sorted(self.versions.items())),
                        paragraph("SHA-256 of the package: ", element("code", self.package_sha256)),
                        paragraph(f"Run on {self.date}."),
                    ),
                ),
                signing_section("the tool is fit for the use that is described above"),
            ),
            claims={"package_sha256": self.package_sha256, "passed": self.passed},
        )
        write_page(page, path)
        return path

    def _oracles(self) -> Markup:
        return table(
            ["oracle", "what it checks", "outcome", "seconds"],
            [
                (
                    e.name,
                    e.what,
                    "passed" if e.passed else f"fell: {e.message}",
                    f"{e.seconds:z.1f}",
                )
                for e in self.outcomes
            ],
        )


def _state(outcome: Outcome | None) -> str:
    if outcome is None:
        return "not run"
    return "passed" if outcome.passed else "fell"
