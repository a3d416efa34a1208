"""Results that a command wrote to a file: `estimate --json`, `compare --json`, `verify --into`.

result = read_result(Path("estimate.json"))     # an Estimate, a Comparison or a Verification
"""

import json
import math
from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from verifai_jax.addons.estimation.comparison.result import Compared, Comparison
from verifai_jax.addons.estimation.result import METHODS, Estimate
from verifai_jax.addons.verification.result import KIND, Verification, load_verification
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.user_code.sources import Sources
from verifai_jax.features import FeatureSpace
from verifai_jax.statistics.paired_rates import PairedRates

NOT_FINITE = ("effective", "relative_error")
"""Numbers of an estimate that JSON has as null where they are not finite."""
OPTIONAL = ("probability", "method", "p0", "backend", "stopped")
"""Entries of an estimate that may be null."""


def read_result(
    file: Path, space: FeatureSpace | None = None
) -> Estimate | Comparison | Verification:
    """Read an estimate, a comparison or a verification from the JSON written by a command.

    **Arguments:**
    - `file`: the output of `verifai-jax estimate --json` or `verifai-jax compare --json`, or the
      file of `verifai-jax verify --into`.
    - `space`: the space of the compared problems, which the JSON does not contain.
    **Returns:** the result; a comparison does not have its single pairs.
    **Raises:** `FileNotFoundError` if there is no such file; `ValueError` for other content.
    """
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        data = None
    if isinstance(data, dict) and data.get("kind") == KIND:
        return load_verification(file)
    commands = {"estimate": _estimate, "compare": lambda each: _comparison(each, space)}
    if not isinstance(data, dict) or data.get("command") not in commands:
        raise ValueError(
            f"{file} is not a result of verifai-jax estimate --json or verifai-jax compare --json"
        )
    try:
        return commands[data["command"]](data)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{file} is damaged: {one_line(str(error))} is missing, or of another form"
        ) from None


def _estimate(data: Mapping[str, Any]) -> Estimate:
    values = _values(Estimate, data)
    for name in NOT_FINITE:
        values[name] = math.nan if values.get(name) is None else float(values[name])
    for name in ("low", "high", "confidence", "upper_bound"):
        values[name] = float(values[name])
    if values["method"] not in (None, *METHODS):
        raise KeyError("method")
    values["notes"] = tuple(map(str, values.get("notes", ())))
    values["sources"] = _sources(values.get("sources", {}))
    return Estimate(**values)


def _comparison(data: Mapping[str, Any], space: FeatureSpace | None) -> Comparison:
    import pandas as pd

    if space is None:
        raise ValueError(
            "a comparison does not say what its features are; give a problem that was compared: "
            "--problem FILE.py:NAME"
        )
    candidates = tuple(
        Compared(
            str(each["name"]),
            PairedRates(**_values(PairedRates, each)),
            int(each["both_fail"]),
            float(each["margin"]),
            pd.DataFrame(),
            pd.DataFrame(),
            space,
        )
        for each in data["candidates"]
    )
    if not candidates:
        raise KeyError("candidates")
    return Comparison(
        str(data["baseline"]),
        candidates,
        int(data["simulations"]),
        str(data["stopped"]),
        float(data["seconds"]),
        int(data["seed"]),
        tuple(map(str, data["notes"])),
        {str(name): _sources(each) for name, each in data.get("sources", {}).items()},
    )


def _sources(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of what a result was made of, empty if it has none.

    **Raises:** `ValueError` for one of another form.
    """
    return Sources.from_json(data).to_json() if data else {}


def _values(kind: type, data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries that are fields of a class, each of the kind of its annotation."""
    values = {}
    for field in fields(kind):
        if field.name not in data:
            if field.default is MISSING and field.default_factory is MISSING:
                raise KeyError(field.name)
            continue
        value = data[field.name]
        if value is None and field.name not in (*OPTIONAL, *NOT_FINITE):
            raise KeyError(field.name)
        wanted = {int: int, float: (int, float), str: str}.get(field.type)
        if wanted is not None and value is not None and not isinstance(value, wanted):
            raise TypeError(field.name)
        values[field.name] = value
    return values
