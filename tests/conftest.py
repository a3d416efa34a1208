import os

# Tests measure what the code compiles, not what an earlier session left behind.
os.environ.setdefault("VERIFAI_JAX_CACHE", "off")

import matplotlib
from jaxtyping import install_import_hook

matplotlib.use("Agg")

CHECKED_ROOMS: list[str] = ["estimation"]
"""Rooms whose annotations, shapes included, are checked at run time in tests."""

install_import_hook([f"verifai_jax.{room}" for room in CHECKED_ROOMS], "checked_types.check")

import verifai_jax  # noqa: E402, F401 - before any test starts JAX's backend, as users should
