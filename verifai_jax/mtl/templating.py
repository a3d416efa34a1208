"""A library of requirements that people write again and again, each with its source.

    for template in templates("glucose"):
        print(template)
    (gap,) = templates("time-gap")
    gap.requirement(time_gap=1.2)                # a Requirement with another constant

The library is the file `templates.toml` next to this one.
"""

import functools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

from verifai_jax.core.errors import check_names
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.requirements import Requirement


@dataclass(frozen=True)
class Template:
    """A requirement to start from.

    - `id`: by which it is found.
    - `domain`: such as `"driving"`, `"flight"`, `"medical"`.
    - `text`: the sentence that the formula stands for.
    - `expression`: the formula as text, in which names stand for `constants`.
    - `source`: a standard or a paper, with its number.
    - `signals`: units of the signals by name; `"1"` for flags and ratios.
    - `unit`: the unit of the robustness, where it has one.
    - `example`: whether the source gives the form alone, and the numbers are examples.
    """

    id: str
    domain: str
    text: str
    expression: str
    source: str
    signals: Mapping[str, str]
    unit: str = ""
    constants: Mapping[str, float] = field(default_factory=dict)
    example: bool = False

    @property
    def formula(self) -> Formula:
        """The formula with the constants as they stand in the library."""
        return parse(self.expression, self.constants)

    def requirement(self, **constants: float) -> Requirement:
        """Return it as a requirement, with other values of some constants.

        **Raises:** `UnknownNameError` for a constant that it does not have.
        """
        check_names(f"constant of {self.id}", constants, self.constants)
        formula = parse(self.expression, {**self.constants, **constants})
        return Requirement(self.id, formula, self.text, self.unit, self.source)

    def __str__(self) -> str:
        units = ", ".join(f"{n} [{u}]" if u else n for n, u in self.signals.items())
        numbers = ", ".join(f"{name} = {value:zg}" for name, value in self.constants.items())
        lines = [f"{self.id} ({self.domain}): {self.text}", f"  {self.expression}"]
        lines += [f"  with {numbers}"] if numbers else []
        example = "; its numbers are examples" if self.example else ""
        return "\n".join([*lines, f"  signals {units}", f"  source  {self.source}{example}"])


def templates(words: str = "", domain: str | None = None) -> tuple[Template, ...]:
    """Return the templates that have all of some words, in the order of the library.

    **Arguments:**

    - `words`: looked for in all that a template says, whatever their case; all templates when left
      out.
    - `domain`: the domain of the templates; every one when left out.

    **Raises:** `UnknownNameError` for a domain without templates.
    """
    library = _library()
    if domain is not None:
        check_names("domain", [domain], dict.fromkeys(each.domain for each in library))
    return tuple(
        each
        for each in library
        if domain in (None, each.domain)
        and all(word in f"{each} {each.unit}".lower() for word in words.lower().split())
    )


@functools.cache
def _library() -> tuple[Template, ...]:
    file = resources.files("verifai_jax.mtl").joinpath("templates.toml")
    entries: list[dict[str, Any]] = tomllib.loads(file.read_text(encoding="utf-8"))["template"]
    return tuple(Template(expression=entry.pop("formula"), **entry) for entry in entries)
