"""Feature spaces: the inputs that vary between simulations, and their distributions."""

from verifai_jax.features.arrays import Array as Array
from verifai_jax.features.arrays import Items as Items
from verifai_jax.features.arrays import VariableArray as VariableArray
from verifai_jax.features.box import Box as Box
from verifai_jax.features.box import DiscreteBox as DiscreteBox
from verifai_jax.features.choice import Categorical as Categorical
from verifai_jax.features.choice import Constant as Constant
from verifai_jax.features.compound import Struct as Struct
from verifai_jax.features.custom import Distribution as Distribution
from verifai_jax.features.distributions import LogUniform as LogUniform
from verifai_jax.features.distributions import Normal as Normal
from verifai_jax.features.distributions import TruncatedNormal as TruncatedNormal
from verifai_jax.features.domain import Domain as Domain
from verifai_jax.features.families import Exponential as Exponential
from verifai_jax.features.families import LogNormal as LogNormal
from verifai_jax.features.families import Triangular as Triangular
from verifai_jax.features.families import Weibull as Weibull
from verifai_jax.features.signal import Signal as Signal
from verifai_jax.features.space import FeatureSpace as FeatureSpace
from verifai_jax.features.tabulated import Beta as Beta
from verifai_jax.features.tabulated import Empirical as Empirical
from verifai_jax.features.tabulated import Gamma as Gamma
