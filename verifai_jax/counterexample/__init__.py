"""What there is to know of a counterexample: whether it is real, how little it takes, and why."""

from verifai_jax.counterexample.confirm import Confirmation as Confirmation
from verifai_jax.counterexample.confirm import Confirmations as Confirmations
from verifai_jax.counterexample.confirm import confirm as confirm
from verifai_jax.counterexample.explain import Explained as Explained
from verifai_jax.counterexample.explain import Influence as Influence
from verifai_jax.counterexample.explain import explain as explain
from verifai_jax.counterexample.shrink import Shrunk as Shrunk
from verifai_jax.counterexample.shrink import shrink as shrink
