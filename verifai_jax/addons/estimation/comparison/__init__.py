"""Paired comparison of problems, to find which of two controllers fails more often."""

from verifai_jax.addons.estimation.comparison._compare import compare as compare
from verifai_jax.addons.estimation.comparison._compare_scores import (
    ScoreComparison as ScoreComparison,
)
from verifai_jax.addons.estimation.comparison._transfer import transfer as transfer
from verifai_jax.addons.estimation.comparison.result import Compared as Compared
from verifai_jax.addons.estimation.comparison.result import Comparison as Comparison
from verifai_jax.addons.estimation.comparison.result import Transfer as Transfer
