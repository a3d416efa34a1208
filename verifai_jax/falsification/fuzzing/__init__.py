"""Fuzzing: simulations that do what none has done yet, with or without a formula."""

from verifai_jax.falsification.fuzzing._fuzz import fuzz as fuzz
from verifai_jax.falsification.fuzzing.coverage import FuzzCoverage as FuzzCoverage
from verifai_jax.falsification.fuzzing.run import FuzzRun as FuzzRun
