"""The inputs of a report with a chain of their hashes, and the versions of the software.

    inputs = folder_inputs(folder, FILES) + Model.of(run.sources).inputs
    chained(inputs)[-1].chain                       # one hash that all inputs decide

A link of the chain is the SHA-256 of the previous link, the name of the input and its content's
hash, so the last link identifies all inputs in their order.
"""

import hashlib
import platform
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from verifai_jax._version import __version__
from verifai_jax.core.user_code.sources import Change, Sources, file_hash, list_changes
from verifai_jax.core.user_code.sources import Source as Input

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "pandas", "scikit-learn", "matplotlib", "mujoco")
"""Packages whose versions decide numbers and pictures."""


class Link(NamedTuple):
    """An input with the hash of the chain up to and including it."""

    input: Input
    chain: str


def chained(inputs: Iterable[Input]) -> list[Link]:
    """Chain the hashes of inputs in order."""
    chain, links = "", []
    for each in inputs:
        chain = hashlib.sha256(f"{chain}\n{each.name}\n{each.sha256}".encode()).hexdigest()
        links.append(Link(each, chain))
    return links


def folder_inputs(folder: Path, roles: Sequence[tuple[str, str]]) -> list[Input]:
    """Hash files of a folder, by patterns of names with their role, in the order of the chain."""
    return [
        Input(file.relative_to(folder).as_posix(), role, file_hash(file))
        for pattern, role in roles
        for file in sorted(folder.glob(pattern))
        if file.is_file()
    ]


class Model(NamedTuple):
    """The files from which a result was made, and those that have changed since.

    - `parts`: the recorded files, for each part of a run with its own model; none if not recorded.
    - `changes`: the changes since then.
    """

    parts: tuple[Sources, ...]
    changes: tuple[Change, ...]

    @classmethod
    def of(cls, recorded: Iterable[Mapping[str, Any]], now: Sources | None = None) -> "Model":
        """Compare the recorded files with the present ones, on disk if `now` is None."""
        parts = tuple(Sources.from_json(each) for each in recorded if each)
        changes = [change for part in parts for change in part.changes(now)]
        return cls(parts, tuple(dict.fromkeys(changes)))

    @property
    def inputs(self) -> list[Input]:
        """The files of the model with their recorded hashes."""
        found = {}
        for part in self.parts:
            for file in part.files:
                name = f"{file.name} at {part.revision}" if part.revision else file.name
                found[name, file.sha256] = Input(name, file.role, file.sha256)
        return list(found.values())

    @property
    def answer(self) -> str:
        """A sentence on whether the model has changed."""
        if not self.parts:
            return "Not recorded: nobody can say whether the model is still the one that ran."
        if self.changes:
            return f"No: {list_changes(self.changes)}."
        files = len(self.inputs)
        without = "; ".join(text for part in self.parts for text in part.without_file)
        return f"Yes: {files} file{'s' * (files != 1)}, by hash." + f" {without}." * bool(without)


def versions() -> list[tuple[str, str]]:
    """Return names and versions of the software for a report: Python, this package, and others."""
    found = [("verifai_jax", __version__), ("Python", platform.python_version())]
    for package in PACKAGES:
        try:
            found.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            continue
    return [*found, ("machine", f"{platform.system()} {platform.machine()}")]
