"""Results that a command wrote to a file: `estimate --json`, `compare --json`, `verify --into`.

result = read_result(Path("estimate.json"))     # an Estimate, a Comparison or a Verification
"""

from collections.abc import Collection, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from verifai_jax.core.display.extensions import extension, extensions
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.files import is_of
from verifai_jax.core.store.foreign_files import ForeignFileError, read_json
from verifai_jax.core.user_code.sources import Sources
from verifai_jax.features import FeatureSpace

READERS = "verifai_jax.reports"
"""Entry points that read results, by the command or the kind in their JSON."""


def read_result(file: Path, space: FeatureSpace | None = None) -> Any:
    """Read an estimate, a comparison without its pairs, or a verification, written by a command.

    `space` is that of the compared problems, which the JSON does not contain.
    **Raises:** `FileNotFoundError` if there is no such file; `ValueError` for other content.
    """
    try:
        data = read_json(file)
    except ForeignFileError:
        raise
    except ValueError:
        data = None
    kind = data.get("kind", data.get("command")) if isinstance(data, dict) else None
    if not isinstance(kind, str) or kind not in extensions(READERS):
        raise ValueError(
            f"{file} is not a result of verifai-jax estimate --json or verifai-jax compare --json"
        )
    try:
        return extension(READERS, kind)(file, data, space)
    except (LookupError, TypeError, AttributeError, ArithmeticError) as error:
        raise ValueError(
            f"{file} is damaged: {one_line(str(error))} is missing, or of another form"
        ) from None


def sources_of(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of what a result was made of, checked; empty if it has none."""
    return Sources.from_json(data).to_json() if data else {}


def values_of(kind: type, data: Mapping[str, Any], null: Collection[str] = ()) -> dict[str, Any]:
    """Return the entries that are fields of a class, as annotated; those of `null` may be it."""
    values = {}
    for field in fields(kind):
        if field.name not in data:
            if field.default is MISSING and field.default_factory is MISSING:
                raise KeyError(field.name)
            continue
        value = data[field.name]
        if value is None and field.name not in null:
            raise KeyError(field.name)
        if value is not None and not is_of(value, field.type):
            raise TypeError(field.name)
        values[field.name] = value
    return values
