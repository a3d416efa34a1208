"""The intersection as a test: failures are at most so frequent."""

import verifai_jax as vj


@vj.test(
    "examples/case_studies/tempe/crossing.py:crossing", budget=2000, max_failure_probability=0.9
)
def test_failures_are_rare_enough(): ...
