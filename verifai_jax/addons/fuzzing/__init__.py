"""Fuzzing: simulations that show new behaviour, with or without a formula."""

from verifai_jax.addons.fuzzing._fuzz import fuzz as fuzz
from verifai_jax.addons.fuzzing.coverage import FuzzCoverage as FuzzCoverage
from verifai_jax.addons.fuzzing.run import FuzzRun as FuzzRun
