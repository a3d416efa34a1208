"""What an error table says: components, neighbours, recurrent values, clusters, rules, coverage."""

from verifai_jax.analysis.columns import Column as Column
from verifai_jax.analysis.coverage import Coverage as Coverage
from verifai_jax.analysis.coverage import coverage as coverage
from verifai_jax.analysis.gradients import gradient_sensitivity as gradient_sensitivity
from verifai_jax.analysis.importance import Importance as Importance
from verifai_jax.analysis.importance import importance as importance
from verifai_jax.analysis.morris import morris as morris
from verifai_jax.analysis.neighbours import Neighbours as Neighbours
from verifai_jax.analysis.neighbours import k_closest as k_closest
from verifai_jax.analysis.neighbours import nearest as nearest
from verifai_jax.analysis.neighbours import random_rows as random_rows
from verifai_jax.analysis.overview import Analysis as Analysis
from verifai_jax.analysis.overview import analyze as analyze
from verifai_jax.analysis.pca import Components as Components
from verifai_jax.analysis.pca import pca as pca
from verifai_jax.analysis.recurrent import Recurrent as Recurrent
from verifai_jax.analysis.recurrent import recurrent as recurrent
from verifai_jax.analysis.rules import Rule as Rule
from verifai_jax.analysis.rules import Rules as Rules
from verifai_jax.analysis.rules import rules as rules
from verifai_jax.analysis.samples import Samples as Samples
from verifai_jax.analysis.sensitivity import Sensitivity as Sensitivity
from verifai_jax.analysis.sobol import sobol_indices as sobol_indices
