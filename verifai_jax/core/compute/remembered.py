"""Programs derived from a traced one, such as its gradient, kept on disk between processes.

    key = remembered_as("gradients", fingerprint(traced.jaxpr), (lanes, "reverse"))
    lowered = lower_or_recall(key, function, arguments)           # to be compiled

Tracing the derivative of a simulation takes ten times as long as tracing the simulation, and the
result depends on the simulation alone. So each process traces the simulation, and if an earlier
process traced the same one, reads its derivative from a file that JAX has exported, which can
compute nothing but arrays. A missing or damaged file, or one of another version of JAX or of this
package, is ignored.
"""

import contextlib
import hashlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.export
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from verifai_jax.core.compute.devices import cache_folder
from verifai_jax.core.compute.fingerprint import identity
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_files import read_bytes
from verifai_jax.core.user_code.user_files import PACKAGE

MAX_BYTES = 64 * 2**20
"""Size of a program that is kept at most."""
SEAL = 32
"""Bytes of the checksum in front of a program."""
_SETTINGS = (
    "jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_dtype_promotion",
    "jax_threefry_partitionable", "jax_debug_nans", "jax_debug_infs", "jax_disable_jit",
)  # fmt: skip
"""Settings of JAX that change what it makes of a function."""


def remembered_as(kind: str, *values: object) -> str | None:
    """Return the name under which a program is stored, a hash of all that it depends on.

    **Arguments:**
    - `kind`: the kind of program, readable in the folder.
    - `values`: all values that determine the program, except this package and JAX; see `identity`.
    **Returns:** the name; None if a value has no identity, or if nothing is stored on disk.
    """
    if cache_folder() is None or None in values:
        return None
    settings = tuple(str(getattr(jax.config, name, None)) for name in _SETTINGS)
    devices = tuple(device.device_kind for device in jax.local_devices())
    name = identity(_package(), settings, jax.default_backend(), devices, values)
    return None if name is None else f"{kind}-{name}"


def lower_or_recall(
    name: str | None, function: Callable[..., Any], arguments: tuple[Any, ...], form: Any = None
) -> jax.stages.Lowered:
    """Return a function as a lowered program, read from its file if there is one.

    The program is identical whether it was traced here or by an earlier process.

    **Arguments:**
    - `name`: the name from `remembered_as`; None for a program that is not stored.
    - `function`: a function of pytrees; it is traced if there is no file.
    - `arguments`: the shapes and types of its arguments.
    - `form`: the structure of its result; left out for tuples, lists and dictionaries of arrays.
    **Raises:** the errors of tracing.
    """
    if name is None:
        return jax.jit(function).trace(*arguments).lower()
    flat, structure = jax.tree.flatten(arguments)

    def of_leaves(*leaves: Any) -> Any:
        results = function(*jax.tree.unflatten(structure, leaves))
        return results if form is None else tuple(jax.tree.leaves(results))

    path = _folder() / name
    exported = _read(path)
    if exported is None:
        program = jax.jit(of_leaves)
        # JAX remembers it by the function, so that it is traced once.
        program.trace(*flat)
        try:
            data = bytes(jax.export.export(program)(*flat).serialize())
        except (ValueError, NotImplementedError, ImportError):
            # Such as calls of libraries that JAX does not promise to keep.
            return jax.jit(function).trace(*arguments).lower()
        if len(data) <= MAX_BYTES:
            _write(path, data)
        # What export returned holds the function and all that it was traced into, and JAX holds it.
        exported = jax.export.deserialize(bytearray(data))
    if b"lapack" not in exported.mlir_module_serialized:
        # For one of a processor JAX imports scipy.linalg, as it may need LAPACK.
        anywhere = (jax.export.DisabledSafetyCheck.platform(),)
        exported = replace(exported, platforms=("any",), disabled_safety_checks=anywhere)

    def recalled(*arguments: Any) -> Any:
        results = exported.call(*jax.tree.leaves(arguments))
        return results if form is None else jax.tree.unflatten(form, results)

    lowered = jax.jit(recalled, in_shardings=_whole(exported)).lower(*arguments)
    # JAX keeps the last thousands of exported programs, but what they compute is in `lowered`.
    object.__setattr__(exported, "mlir_module_serialized", b"")
    return lowered


def _whole(exported: "jax.export.Exported") -> Any:
    """Return where its arguments lie: on all devices that it was exported for."""
    if exported.nr_devices == 1:
        return None
    mesh = Mesh(np.array(jax.local_devices()[: exported.nr_devices]), ("row",))
    return NamedSharding(mesh, PartitionSpec())


def _folder() -> Path:
    folder = cache_folder()
    assert folder is not None
    return folder / "derived"


def _read(path: Path) -> "jax.export.Exported | None":
    try:
        content = read_bytes(path)
        seal, data = content[:SEAL], content[SEAL:]
        if hashlib.sha256(data).digest() != seal:
            return None
        return jax.export.deserialize(bytearray(data))
    except Exception:
        # Whatever is wrong with a file, the program can be made without it.
        return None


def _write(path: Path, data: bytes) -> None:
    with contextlib.suppress(OSError), replacing(path) as partial:
        partial.write_bytes(hashlib.sha256(data).digest() + data)


@cache
def _package() -> tuple[str, ...]:
    """Return what identifies this package and JAX: versions, and when its files were written."""
    files = sorted(PACKAGE.rglob("*.py"))
    written = tuple(
        f"{file.relative_to(PACKAGE)} {stat.st_size} {stat.st_mtime_ns}"
        for file, stat in ((file, file.stat()) for file in files)
    )
    return (jax.__version__, version("jaxlib"), *written)
