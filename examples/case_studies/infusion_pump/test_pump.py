"""The pump as a test: overdoses are at most so rare."""

import verifai_jax as vj


@vj.test(
    "examples/case_studies/infusion_pump/pump.py:pump", budget=2000, max_failure_probability=0.03
)
def test_overdoses_are_rare(): ...
