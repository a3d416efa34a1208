"""Requirements: sentences with identifiers, and the formulas that formalise them."""

from dataclasses import dataclass, field

from verifai_jax.mtl.formula import Formula

FIELDS = ("id", "formula", "text", "unit", "source", "rationale", "severity", "links")
"""What an entry may say; each has an `id`, and a `formula` where recordings are judged by it."""


@dataclass(frozen=True)
class Requirement:
    """A requirement with its identifier, and the `file` from which it was read.

    - `formula`: the required property; None if a problem has the formula, or it is not written yet.
    - `text`: the sentence that it formalises; `unit`: the unit of its robustness.
    - `source`: a standard or a document, with its number; `rationale`: the reason for it.
    - `severity`: the severity of a violation, in the project's terms.
    - `links`: other requirements or documents from which it is derived.
    """

    id: str
    formula: Formula | None = None
    text: str = ""
    unit: str = ""
    source: str = ""
    rationale: str = ""
    severity: str = ""
    links: tuple[str, ...] = ()
    file: str = field(default="", compare=False)

    @property
    def formalized(self) -> Formula:
        """The formula; `ValueError` for a requirement without one."""
        if self.formula is None:
            raise ValueError(f"requirement {self.id!r} has no formula: give it one in its file")
        return self.formula

    def entry(self) -> dict[str, str]:
        """Return its fields as texts; empty ones are left out."""
        formula = "" if self.formula is None else str(self.formula)
        said = {name: getattr(self, name) for name in FIELDS}
        spaced = any(" " in link or "," in link for link in self.links)
        links = "".join(f"{link}; " for link in self.links).strip() if spaced else ""
        said |= {"formula": formula, "links": links or " ".join(self.links)}
        return {name: value for name, value in said.items() if value}
