"""Programs that JAX traced, evaluated with sets of numbers: bounds for whole boxes at once."""

from verifai_jax.addons.verification.sets import control_flow as control_flow
from verifai_jax.addons.verification.sets import indices as indices
from verifai_jax.addons.verification.sets import order as order
from verifai_jax.addons.verification.sets import products as products
from verifai_jax.addons.verification.sets import tables as tables
from verifai_jax.addons.verification.sets.flow import flow as flow
from verifai_jax.addons.verification.sets.form import Form as Form
from verifai_jax.addons.verification.sets.interpreter import Interpreter as Interpreter
from verifai_jax.addons.verification.sets.values import MissingRule as MissingRule
from verifai_jax.addons.verification.sets.whole import Whole as Whole
