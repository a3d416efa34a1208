"""What there is to know of a counterexample: whether it is real, how little it takes, and why."""

from verifai_jax.counterexample.confirm import Confirmation as Confirmation
from verifai_jax.counterexample.confirm import Confirmations as Confirmations
from verifai_jax.counterexample.confirm import confirm as confirm
