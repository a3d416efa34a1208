"""The machine: one JAX device per CPU core, and a compile cache that outlives the process.

XLA runs the small loop bodies of a rollout on one thread. Splitting the batch over one host
device per core is what keeps all cores busy; JAX fixes their number when its backend starts, so
`claim_cores` runs when `verifai_jax` is imported.

Environment variables: `VERIFAI_JAX_CORES` (how many cores to use), `VERIFAI_JAX_CACHE` (a folder
for compiled programs, or `off`).
"""

import os
from pathlib import Path
from typing import Any

import jax


def available_cores() -> int:
    """Number of CPU cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _setting(name: str) -> Any:
    return getattr(jax.config, name)


def claim_cores() -> None:
    """Give JAX one host device per core, unless its backend runs or the user chose a number."""
    wanted = os.environ.get("VERIFAI_JAX_CORES", "").strip()
    if wanted and (not wanted.isdigit() or int(wanted) < 1):
        raise ValueError(f"VERIFAI_JAX_CORES must be a positive integer; got {wanted!r}")
    chosen_elsewhere = _setting(
        "jax_num_cpu_devices"
    ) > 0 or "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if chosen_elsewhere:
        return
    try:
        jax.config.update("jax_num_cpu_devices", int(wanted) if wanted else available_cores())
    except RuntimeError:
        # The backend already runs with the devices it has; the engine uses those.
        return


def cache_folder() -> Path | None:
    """Folder of the persistent compile cache; None when it is switched off."""
    setting = os.environ.get("VERIFAI_JAX_CACHE", "").strip()
    if setting.lower() in ("off", "0", "no", "false"):
        return None
    if setting:
        return Path(setting).expanduser()
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "verifai_jax" / "compiled"


def enable_compile_cache() -> None:
    """Keep compiled programs on disk, unless the user has configured JAX's cache already."""
    folder = cache_folder()
    if folder is None or _setting("jax_compilation_cache_dir") is not None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return  # A read-only home costs compile time, not results; `doctor` reports it.
    from jax.experimental.compilation_cache import compilation_cache

    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # JAX decides once whether it has a cache; anything compiled before now said no.
    compilation_cache.reset_cache()
