"""Analyses of error tables: components, neighbours, patterns, clusters, rules, coverage."""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.addons.analysis._boundary import Boundary as Boundary
    from verifai_jax.addons.analysis._boundary import boundary as boundary
    from verifai_jax.addons.analysis._coverage import Coverage as Coverage
    from verifai_jax.addons.analysis._coverage import coverage as coverage
    from verifai_jax.addons.analysis._diverse import Diverse as Diverse
    from verifai_jax.addons.analysis._diverse import diverse as diverse
    from verifai_jax.addons.analysis._frequent_patterns import FrequentPatterns as FrequentPatterns
    from verifai_jax.addons.analysis._frequent_patterns import (
        frequent_patterns as frequent_patterns,
    )
    from verifai_jax.addons.analysis._importance import Importance as Importance
    from verifai_jax.addons.analysis._importance import importance as importance
    from verifai_jax.addons.analysis._pca import Components as Components
    from verifai_jax.addons.analysis._pca import pca as pca
    from verifai_jax.addons.analysis._rules import Rule as Rule
    from verifai_jax.addons.analysis._rules import Rules as Rules
    from verifai_jax.addons.analysis._rules import rules as rules
    from verifai_jax.addons.analysis.clustering.clusters import Clusters as Clusters
    from verifai_jax.addons.analysis.clustering.clusters import clusters as clusters
    from verifai_jax.addons.analysis.data.columns import Column as Column
    from verifai_jax.addons.analysis.data.samples import Samples as Samples
    from verifai_jax.addons.analysis.neighbours import Neighbours as Neighbours
    from verifai_jax.addons.analysis.neighbours import k_closest as k_closest
    from verifai_jax.addons.analysis.neighbours import nearest as nearest
    from verifai_jax.addons.analysis.neighbours import random_rows as random_rows
    from verifai_jax.addons.analysis.overview import Analysis as Analysis
    from verifai_jax.addons.analysis.overview import analyze as analyze
    from verifai_jax.addons.analysis.sensitivity.gradients import (
        gradient_sensitivity as gradient_sensitivity,
    )
    from verifai_jax.addons.analysis.sensitivity.morris import morris as morris
    from verifai_jax.addons.analysis.sensitivity.sensitivity import Sensitivity as Sensitivity
    from verifai_jax.addons.analysis.sensitivity.sobol import sobol_indices as sobol_indices
# Imported when first used: a folder inside needs few of these names.
__getattr__, __dir__, __all__ = attach(__name__)
