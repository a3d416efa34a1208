"""The preparation of JAX when it is imported, before its backend starts or compiles.

JAX gets one device for each core of the processor, before its backend fixes their number, and
batches of factorizations that do not hang (`factorizations.py`). Importing `verifai_jax` does not
import JAX, so both happen when JAX is first imported.
"""

import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any


def available_cores() -> int:
    """Count the CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def claim_cores() -> None:
    """Give JAX one host device per core, unless its backend is running or the user set a number.

    **Raises:** `ValueError` for a `VERIFAI_JAX_CORES` that is not a positive integer.
    """
    wanted = os.environ.get("VERIFAI_JAX_CORES", "").strip()
    if wanted and (not wanted.isdecimal() or int(wanted) < 1):
        raise ValueError(f"VERIFAI_JAX_CORES must be a positive integer; got {wanted!r}")
    cores = int(wanted) if wanted else available_cores()
    jax = sys.modules.get("jax")
    if jax is not None and hasattr(jax, "config"):
        _prepare(jax, cores)
    else:
        sys.meta_path.insert(0, _AfterImport(cores))


def _prepare(jax: Any, cores: int) -> None:
    # It imports JAX.
    from verifai_jax.core.compute.factorizations import avoid_deadlock

    avoid_deadlock()
    _configure(jax, cores)


def _configure(jax: Any, cores: int) -> None:
    flags = os.environ.get("XLA_FLAGS", "")
    if jax.config.jax_num_cpu_devices > 0 or "xla_force_host_platform_device_count" in flags:
        return
    try:
        jax.config.update("jax_num_cpu_devices", cores)
    except RuntimeError:
        # The backend already runs with the devices it has; the engine uses those.
        return


class _AfterImport(importlib.abc.MetaPathFinder):
    """Prepares JAX as soon as it is imported, by whomever, and then steps aside."""

    def __init__(self, cores: int) -> None:
        self.cores = cores

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != "jax":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        def execute_and_prepare(module: ModuleType) -> None:
            execute(module)
            _prepare(module, self.cores)

        spec.loader.exec_module = execute_and_prepare  # pyright: ignore[reportAttributeAccessIssue]
        return spec
