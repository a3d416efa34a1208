"""Tables and weights of an augmentation as arrays of numbers and texts, which a cache keeps.

arrays = encode_frame(rows); decode_frame(arrays)
encode_weights({"dense": [w, b]})       # None for weights that are no plain containers
"""

import json
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import pandas as pd

from verifai_jax.augmentation.task import Weights
from verifai_jax.store.files import plain
from verifai_jax.store.log import Arrays

_ORDER = "columns"
"""Array with the names of a table's columns, in their order."""
_STRUCTURE = "structure"
"""Array with the structure of weights, as JSON."""


def encode_frame(frame: pd.DataFrame) -> Arrays:
    """Encode a table; choices of several types become JSON."""
    arrays: Arrays = {_ORDER: np.array([str(name) for name in frame.columns], np.str_)}
    for name in frame.columns:
        values = frame[name].to_numpy()
        if values.dtype.kind in "biuf":
            arrays[f"plain/{name}"] = values
        else:
            arrays[f"json/{name}"] = np.array([json.dumps(plain(v)) for v in values], np.str_)
    return arrays


def decode_frame(arrays: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """Decode a table."""
    columns: dict[str, Any] = {}
    for name in arrays[_ORDER].tolist():
        if f"plain/{name}" in arrays:
            columns[name] = arrays[f"plain/{name}"]
        else:
            entries = [json.loads(text) for text in arrays[f"json/{name}"].tolist()]
            columns[name] = pd.Series(entries, dtype=object)
    return pd.DataFrame(columns)


def encode_weights(weights: Weights) -> Arrays | None:
    """Encode weights; None unless they are arrays in dictionaries, lists and tuples."""
    leaves: list[np.ndarray] = []
    try:
        structure = json.dumps(_structure(weights, leaves))
    except TypeError:
        return None
    return {_STRUCTURE: np.array(structure), **{str(i): leaf for i, leaf in enumerate(leaves)}}


def decode_weights(arrays: Mapping[str, np.ndarray]) -> Weights:
    """Decode weights; arrays become arrays of JAX."""
    return _restored(json.loads(str(arrays[_STRUCTURE])), arrays)


def _structure(tree: Any, leaves: list[np.ndarray]) -> Any:
    if type(tree) is dict:
        if not all(isinstance(name, str) for name in tree):
            raise TypeError("names of weights must be texts")
        return {"dict": {name: _structure(tree[name], leaves) for name in tree}}
    if type(tree) in (list, tuple):
        return {type(tree).__name__: [_structure(part, leaves) for part in tree]}
    if tree is None:
        return {"none": None}
    if isinstance(tree, jax.Array | np.ndarray | np.generic):
        leaf = np.asarray(tree)
        if leaf.dtype.kind not in "biuf":
            raise TypeError(f"weights of type {leaf.dtype}")
        leaves.append(leaf)
        return {"leaf": len(leaves) - 1}
    raise TypeError(f"weights in a {type(tree).__name__}")


def _restored(structure: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    ((kind, value),) = structure.items()
    if kind == "dict":
        return {name: _restored(part, arrays) for name, part in value.items()}
    if kind in ("list", "tuple"):
        parts = [_restored(part, arrays) for part in value]
        return parts if kind == "list" else tuple(parts)
    return None if kind == "none" else jax.numpy.asarray(arrays[str(value)])
