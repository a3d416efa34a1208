"""Weights of a file that PyTorch has written, without PyTorch and without unpickling.

    weights = read_state(archive_bytes)          # {"mlp.0.weight": [out, in], ...}

A file of `torch.save` is an archive with one pickle, `data.pkl`, that refers to one file a storage.
Source: `torch/serialization.py` of PyTorch 2.
"""

import math
from collections.abc import Mapping
from typing import Any

import ml_dtypes
import numpy as np

from verifai_jax.addons.rl.policies.errors import MAX_BYTES, PolicyError, refused
from verifai_jax.addons.rl.policies.pickled import Name, Persistent, Record, array_of, read_pickle
from verifai_jax.core.store.foreign_archives import open_archive, read_member

_STORAGES: dict[str, Any] = {
    "FloatStorage": np.float32, "DoubleStorage": np.float64, "HalfStorage": np.float16,
    "BFloat16Storage": ml_dtypes.bfloat16, "LongStorage": np.int64, "IntStorage": np.int32,
    "ShortStorage": np.int16, "CharStorage": np.int8, "ByteStorage": np.uint8,
    "BoolStorage": np.bool_,
}  # fmt: skip


def read_state(data: bytes, what: str) -> dict[str, np.ndarray]:
    """Return the tensors in a file of `torch.save`; dots join names of nested dictionaries."""
    archive = open_archive(data, what, MAX_BYTES)
    pickles = [n for n in archive.namelist() if n.rpartition("/")[2] == "data.pkl"]
    if len(pickles) != 1:
        raise PolicyError(f"{what} is not a file of torch.save: it has no data.pkl")
    folder = pickles[0].rpartition("/")[0]
    content = read_pickle(read_member(archive, pickles[0], what), what)
    found: dict[str, np.ndarray] = {}
    _collect(content, "", found, lambda key: read_member(archive, f"{folder}/data/{key}", what), 0)
    if not found:
        raise PolicyError(f"{what} holds no tensors by name: save module.state_dict()")
    return found


def _collect(value: Any, name: str, found: dict[str, np.ndarray], read: Any, depth: int) -> None:
    items = dict(enumerate(value)) if isinstance(value, list | tuple) else value
    if isinstance(value, Record):
        items = value.items or value.state  # An object, such as one of running means.
    array = array_of(value)
    if array is not None and array.dtype.kind in "fiub":
        found[name] = array
    elif isinstance(items, Mapping) and depth < 8:
        for key, inner in items.items():
            joined = f"{name}.{key}" if name else str(key)
            _collect(inner, joined, found, read, depth + 1)
    elif (tensor := _tensor(value, read, name)) is not None:
        found[name] = tensor


def _tensor(value: Any, read: Any, name: str) -> np.ndarray | None:
    """Return the tensor pickled as `_rebuild_tensor_v2(storage, offset, size, stride, ...)`."""
    function = value.function if isinstance(value, Record) else None
    made_by = function.name if isinstance(function, Name) else ""
    if made_by == "_rebuild_parameter":
        return _tensor(value.arguments[0], read, name)
    if made_by != "_rebuild_tensor_v2":
        return None
    with refused(f"the tensor {name!r} is damaged"):
        storage, offset, shape, stride = value.arguments[:4]
        assert isinstance(storage, Persistent)
        _, kind, key, _, _ = storage.reference
        assert isinstance(key, str)
        flat = np.frombuffer(read(key), _STORAGES[kind.name])
        last = offset + sum((n - 1) * s for n, s in zip(shape, stride, strict=True))
        if min((offset, *shape, *stride)) < 0 or (math.prod(shape) and last >= len(flat)):
            raise ValueError("it reaches beyond its storage")
        if math.prod(shape) > len(flat):
            raise ValueError("it has more numbers than its storage")
        strides = tuple(s * flat.itemsize for s in stride)
        view = np.lib.stride_tricks.as_strided(flat[offset:], shape, strides, writeable=False)
        return widened(np.array(view))


def widened(array: np.ndarray) -> np.ndarray:
    """Return numbers of fewer than 32 bits, which are not integers, as float32."""
    real = array.dtype.kind not in "iub" and array.dtype.itemsize < 4
    return array.astype(np.float32) if real else array
