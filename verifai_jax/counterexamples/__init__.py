"""Studies of a counterexample: confirmation, minimisation and explanation."""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.counterexamples._confirm import confirm as confirm
    from verifai_jax.counterexamples._explain import Explained as Explained
    from verifai_jax.counterexamples._explain import Influence as Influence
    from verifai_jax.counterexamples._explain import explain as explain
    from verifai_jax.counterexamples._shrink import shrink as shrink
    from verifai_jax.counterexamples.shrunk import Shrunk as Shrunk
    from verifai_jax.evaluation.confirmations import Confirmation as Confirmation
    from verifai_jax.evaluation.confirmations import Confirmations as Confirmations
__getattr__, __dir__, __all__ = attach(__name__)
