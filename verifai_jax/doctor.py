"""What this machine offers: versions, devices, cores, compile cache.

>>> print(report())
verifai_jax 0.1.0
...
"""

import importlib.metadata
import os
import platform

from verifai_jax.devices import available_cores, cache_folder

PACKAGES = ("jax", "jaxlib", "numpy", "optax", "lark", "pandas", "pyarrow", "matplotlib", "rich")


def report() -> str:
    """Versions, devices and settings, one a line, with advice where something costs speed."""
    import jax

    import verifai_jax

    lines = [
        f"verifai_jax {verifai_jax.__version__}",
        f"Python      {platform.python_version()} on {platform.system()} {platform.machine()}",
    ]
    for package in PACKAGES:
        try:
            version = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            version = "missing: pip install verifai_jax installs it"
        lines.append(f"{package:<12}{version}")
    devices = jax.devices()
    lines.append(f"devices     {len(devices)} x {devices[0].platform}")
    cores = available_cores()
    lines.append(f"cores       {cores} usable")
    if devices[0].platform == "cpu" and len(devices) < cores:
        lines.append(
            f"  advice: only {len(devices)} of {cores} cores are used. JAX started before "
            "verifai_jax was imported, or VERIFAI_JAX_CORES says so; import verifai_jax first"
        )
    lines.append(f"cache       {_cache_state()}")
    return "\n".join(lines)


def _cache_state() -> str:
    folder = cache_folder()
    if folder is None:
        return "off (VERIFAI_JAX_CACHE); every process compiles anew"
    existing = next((p for p in (folder, *folder.parents) if p.exists()), folder)
    if not os.access(existing, os.W_OK):
        return (
            f"{folder} cannot be written, so every process compiles anew; "
            "set VERIFAI_JAX_CACHE to a folder that can"
        )
    files = [path for path in folder.glob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files) / 1e6
    return f"{folder} ({len(files)} files, {size:.1f} MB); VERIFAI_JAX_CACHE=off switches it off"
