"""What an error table says: components, neighbours, recurrent values, clusters, rules, coverage."""

from verifai_jax.analysis.columns import Column as Column
from verifai_jax.analysis.samples import Samples as Samples
