"""A file of requirements: formulas with what people say of them.

read_requirements("requirements.toml")              # tables [[requirement]]
read_requirements("requirements.csv")               # a row a requirement
"""

import csv
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from verifai_jax.core.errors import check_names
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.setting import as_formula

ENDINGS = (".toml", ".csv")
"""Endings of files of requirements."""
FIELDS = ("id", "formula", "text", "unit", "source")
"""What an entry may say; it must have the first two."""


@dataclass(frozen=True)
class Requirement:
    """A formula with an identifier, and what people say of it.

    - `id`: by which tables and reports name it.
    - `formula`: what is required.
    - `text`: the sentence that the formula stands for.
    - `unit`: of its robustness.
    - `source`: a standard or a document, with its number.
    """

    id: str
    formula: Formula
    text: str = ""
    unit: str = ""
    source: str = ""


Requirements = Formula | str | Mapping[str, Formula | str] | Iterable[Formula | str | Requirement]
"""Formulas, by identifier or in a sequence, or one alone."""


def requirements_of(formulas: Requirements) -> tuple[Requirement, ...]:
    """Return formulas as requirements; those without an identifier are `R1`, `R2`, ...

    **Raises:** `ValueError` for none, for an identifier that stands twice, and for a text that is
    no formula.
    """
    if isinstance(formulas, Formula | str):
        formulas = [formulas]
    if isinstance(formulas, Mapping):
        formulas = [Requirement(str(name), as_formula(f)) for name, f in formulas.items()]
    found = [
        each if isinstance(each, Requirement) else Requirement(f"R{index}", as_formula(each))
        for index, each in enumerate(formulas, 1)
    ]
    return _checked("the requirements", found)


def read_requirements(
    path: str | Path,
    constants: Mapping[str, float] | None = None,
    definitions: Mapping[str, str] | None = None,
) -> tuple[Requirement, ...]:
    """Read requirements from a TOML or a CSV file.

    A TOML file has a table `[[requirement]]` for each, and may have tables `[constants]` and
    `[definitions]` of names that the formulas use. A CSV file has a row for each, below the names
    of its columns. Either way a requirement has `id` and `formula`, and may have `text`, `unit` and
    `source`.

    **Arguments:**

    - `constants`, `definitions`: further names; they come before those of the file.

    **Raises:** `FileNotFoundError`; `ValueError` that names the entry for one that is not as it
    should be.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file of requirements {path}")
    if path.suffix.lower() not in ENDINGS:
        raise ValueError(
            f"a file of requirements is a .toml or a .csv file; got {path.name}: write each as a "
            'table of TOML, [[requirement]] with id = "..." and formula = "..."'
        )
    numbers, parts = dict(constants or {}), dict(definitions or {})
    if path.suffix.lower() == ".csv":
        with open(path, encoding="utf-8-sig", newline="") as file:
            entries: Sequence[Mapping[str, object]] = list(csv.DictReader(file))
    else:
        entries, numbers, parts = _toml_entries(path, numbers, parts)
    found = []
    for index, entry in enumerate(entries, 1):
        where = f"requirement {index} of {path}"
        fields = _fields(where, entry)
        try:
            formula = parse(fields.pop("formula"), numbers, parts)
        except ValueError as error:
            raise ValueError(f"{where}, {fields['id']!r}: {error}") from None
        found.append(Requirement(formula=formula, **fields))
    return _checked(str(path), found)


def _toml_entries(
    path: Path, numbers: dict[str, float], parts: dict[str, str]
) -> tuple[Sequence[Mapping[str, object]], dict[str, float], dict[str, str]]:
    """Return the entries of a TOML file, and all names that their formulas may use."""
    try:
        whole = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no TOML: {error}") from None
    check_names(f"table of {path}", whole, ("requirement", "constants", "definitions"))
    entries, own, named = (
        whole.get("requirement", []), whole.get("constants", {}), whole.get("definitions", {}),
    )  # fmt: skip
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"{path}: each requirement begins with a line [[requirement]]")
    for name, value in own.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{path}: constant {name!r} must be a number; got {value!r}")
    for name, value in named.items():
        if not isinstance(value, str):
            raise ValueError(f"{path}: definition {name!r} must be a text; got {value!r}")
    return entries, {**own, **numbers}, {**named, **parts}


def _fields(where: str, entry: Mapping[str, object]) -> dict[str, str]:
    check_names(f"field of {where}", [str(name) for name in entry], FIELDS)
    fields = {str(name): value for name, value in entry.items() if value not in (None, "")}
    for name, value in fields.items():
        if not isinstance(value, str):
            raise ValueError(f"{where}: {name} must be a text; got {value!r}")
    for name in FIELDS[:2]:
        if name not in fields:
            raise ValueError(f"{where} has no {name}: it needs an id and a formula")
    return {name: str(value).strip() for name, value in fields.items()}


def _checked(source: str, found: Sequence[Requirement]) -> tuple[Requirement, ...]:
    if not found:
        raise ValueError(f"{source} has no requirement")
    names = [each.id for each in found]
    if repeated := next((name for name in names if names.count(name) > 1), None):
        raise ValueError(f"{source} has more than one requirement {repeated!r}")
    return tuple(found)
