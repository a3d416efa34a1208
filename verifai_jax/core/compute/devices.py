"""The machine: work spread over devices, and a compile cache that outlives the process.

XLA runs the small loop bodies of a rollout on one thread, so the batch is split over one host
device per core (`core.compute.cores`) to use all cores.

Environment variables: `VERIFAI_JAX_CORES` (number of cores to use), `VERIFAI_JAX_CACHE` (a folder
for compiled programs, or `off`), `VERIFAI_JAX_CACHE_MIB` (its size limit, 2048 by default).
"""

import itertools
import os
import platform
import shutil
import threading
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from verifai_jax.core.store.eviction import evict

Device: TypeAlias = jax.Device  # pyright: ignore[reportInvalidTypeForm]
"""A device of JAX; its own name of the class is a variable to type checkers."""


def spread_over_devices(
    function: Callable[..., Any], split: Sequence[bool], devices: Sequence[Any] | None = None
) -> Callable[..., Any]:
    """Split the leading axis of some arguments, and of all results, over devices.

    **Arguments:**
    - `function`: a function of arrays whose leading axes are one device's share.
    - `split`: for each argument, whether its leading axis is split; the others are passed whole.
    - `devices`: JAX devices; by default all of this process. Leading axes must be multiples of
      their number.
    **Returns:** a function of the whole arrays, to be traced by `jax.jit`; `function` itself if
    there is only one device.
    """
    devices = jax.local_devices() if devices is None else devices
    if len(devices) == 1:
        return function
    part, whole = PartitionSpec("row"), PartitionSpec()
    return jax.shard_map(
        function,
        mesh=_mesh(devices),
        in_specs=tuple(part if each else whole for each in split),
        out_specs=part,
        # A user's scan need not say that its carry differs between devices.
        check_vma=False,
    )


@cache
def describe_processor() -> str:
    """Describe what determines the last digits of results: processor, device and JAX version."""
    device = jax.local_devices()[0]
    kind = device.device_kind
    if device.platform == "cpu":
        kind = platform.processor() or platform.machine()
        try:
            lines = Path("/proc/cpuinfo").read_text().splitlines()
        except OSError:
            lines = []
        names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
        kind = next(names, kind)
    return f"{kind} with JAX {jax.__version__}"


def split_sharding(devices: Sequence[Device]) -> NamedSharding:
    """Return the sharding of arrays whose leading axis is split by `spread_over_devices`.

    Arrays with another sharding would make JAX compile a program again.
    """
    return NamedSharding(_mesh(devices), PartitionSpec("row"))


def _mesh(devices: Sequence[Device]) -> Mesh:
    return Mesh(np.array(devices), ("row",))


def cache_folder() -> Path | None:
    """Folder of the persistent compile cache; None if it is switched off."""
    setting = os.environ.get("VERIFAI_JAX_CACHE", "").strip()
    if setting.lower() in ("off", "0", "no", "false"):
        return None
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    folder = Path(setting) if setting else Path(base) / "verifai_jax" / "compiled"
    # Compilers run in other folders.
    return folder.expanduser().absolute()


CACHE_ROOM = 64 * 2**20
"""Bytes that must be free to keep compiled programs. On a full disk JAX leaves halves of programs,
which it warns of in each later process and never replaces; a run's programs are a few MiB."""
EVICTED_EVERY = 256
"""Programs of a process after which it looks at the size of the cache again, after the first."""
_compiled = itertools.count()


def cache_limit() -> int:
    """Return how many bytes the persistent compile cache may hold.

    **Raises:** `ValueError` for a `VERIFAI_JAX_CACHE_MIB` that is not a positive integer.
    """
    wanted = os.environ.get("VERIFAI_JAX_CACHE_MIB", "").strip() or "2048"
    if not wanted.isdecimal() or int(wanted) < 1:
        raise ValueError(f"VERIFAI_JAX_CACHE_MIB must be a positive integer; got {wanted!r}")
    return int(wanted) * 2**20


def enable_compile_cache() -> None:
    """Store compiled programs on disk, unless the user has configured JAX's cache.

    The oldest programs are removed in the background, as this is called for each program.
    """
    folder = cache_folder()
    if folder is None:
        return
    limit = cache_limit()
    if next(_compiled) % EVICTED_EVERY == 0:
        threading.Thread(target=evict, args=(folder, limit), daemon=True).start()
    if jax.config.jax_compilation_cache_dir is not None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if shutil.disk_usage(folder).free < CACHE_ROOM:
            return
    except OSError:
        return  # A read-only home costs compile time, not results; `doctor` reports it.
    from jax.experimental.compilation_cache import compilation_cache

    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # JAX decides once whether it has a cache; anything compiled before now said no.
    compilation_cache.reset_cache()
