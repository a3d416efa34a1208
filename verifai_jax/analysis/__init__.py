"""Analyses of error tables: components, neighbours, patterns, clusters, rules, coverage."""

from verifai_jax.analysis._boundary import Boundary, boundary
from verifai_jax.analysis._coverage import Coverage, coverage
from verifai_jax.analysis._diverse import Diverse, diverse
from verifai_jax.analysis._frequent_patterns import FrequentPatterns, frequent_patterns
from verifai_jax.analysis._importance import Importance, importance
from verifai_jax.analysis._pca import Components, pca
from verifai_jax.analysis._rules import Rule, Rules, rules
from verifai_jax.analysis.clustering.clusters import Clusters, clusters
from verifai_jax.analysis.data.columns import Column
from verifai_jax.analysis.data.samples import Samples
from verifai_jax.analysis.neighbours import Neighbours, k_closest, nearest, random_rows
from verifai_jax.analysis.odd_coverage import OddCoverage
from verifai_jax.analysis.odd_files import odd_of, read_odd
from verifai_jax.analysis.operational_domain import OperationalDomain
from verifai_jax.analysis.overview import Analysis, analyze
from verifai_jax.analysis.sensitivity.gradients import gradient_sensitivity
from verifai_jax.analysis.sensitivity.morris import morris
from verifai_jax.analysis.sensitivity.sensitivity import Sensitivity
from verifai_jax.analysis.sensitivity.sobol import sobol_indices

__all__ = [
    "Analysis", "Boundary", "Clusters", "Column", "Components", "Coverage", "Diverse",
    "FrequentPatterns", "Importance", "Neighbours", "OddCoverage", "OperationalDomain", "Rule",
    "Rules", "Samples", "Sensitivity",
    "analyze", "boundary", "clusters", "coverage", "diverse", "frequent_patterns",
    "gradient_sensitivity", "importance", "k_closest", "morris", "nearest", "odd_of", "pca",
    "random_rows", "read_odd", "rules", "sobol_indices",
]  # fmt: skip


def __dir__() -> list[str]:
    return list(__all__)
