"""Fuzzing: simulations that do what none has done yet, with or without a formula."""

from verifai_jax.fuzzing._fuzz import fuzz as fuzz
from verifai_jax.fuzzing.coverage import FuzzCoverage as FuzzCoverage
from verifai_jax.fuzzing.run import FuzzRun as FuzzRun
