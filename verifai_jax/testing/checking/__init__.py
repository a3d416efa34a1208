"""Problems as tests: replay the corpus of counterexamples, then search with a budget."""

from verifai_jax.testing.checking._test import Session as Session
from verifai_jax.testing.checking._test import session as session
from verifai_jax.testing.checking._test import test as test
from verifai_jax.testing.checking.check import Check as Check
from verifai_jax.testing.checking.check import CheckOutcome as CheckOutcome
from verifai_jax.testing.checking.check import CounterexampleFound as CounterexampleFound
