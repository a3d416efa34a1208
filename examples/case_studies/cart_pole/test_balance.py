"""The cart-pole as a test: failures are at most so rare."""

import verifai_jax as vj


@vj.test(
    "examples/case_studies/cart_pole/balance.py:cart_pole",
    budget=2000,
    max_failure_probability=0.1,
)
def test_failures_are_rare(): ...
