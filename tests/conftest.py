import os

# Tests measure what the code compiles, not what an earlier session left behind.
os.environ.setdefault("VERIFAI_JAX_CACHE", "off")

import matplotlib

matplotlib.use("Agg")

import verifai_jax  # noqa: F401 - before any test starts JAX's backend, as users should
