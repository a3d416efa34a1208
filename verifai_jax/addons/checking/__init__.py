"""Problems as tests: replay the corpus of counterexamples, then search with a budget."""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.addons.checking._replay_counterexamples import (
        replay_counterexamples as replay_counterexamples,
    )
    from verifai_jax.addons.checking._test import Session as Session
    from verifai_jax.addons.checking._test import session as session
    from verifai_jax.addons.checking._test import test as test
    from verifai_jax.addons.checking.check import Check as Check
    from verifai_jax.addons.checking.check import CheckOutcome as CheckOutcome
    from verifai_jax.addons.checking.check import CounterexampleFound as CounterexampleFound
    from verifai_jax.addons.checking.corpus import SavedCounterexample as SavedCounterexample
    from verifai_jax.addons.checking.corpus import save_counterexamples as save_counterexamples
__getattr__, __dir__, __all__ = attach(__name__)
