"""Bounds of robustness over boxes of traces contain the robustness of each trace in them."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mtl_oracle import formulas

import verifai_jax as vj
from verifai_jax.addons.verification.enclosure import Enclosure
from verifai_jax.evaluation.evaluator import Evaluator


def recorded(f, key):
    return vj.Trace({"x": f["x"], "y": f["y"], "p": f["p"].reshape(5, 2)}, dt=0.5)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(formula=formulas(2), seed=st.integers(0, 1000))
def test_bounds_contain_the_robustness_of_random_formulas(formula, seed):
    """All operators, on traces whose samples are features."""
    problem = vj.Problem(
        "any", {"x": vj.Box([-2.0] * 5, [2.0] * 5), "y": vj.Box([-2.0] * 5, [2.0] * 5),
                "p": vj.Box([-2.0] * 10, [2.0] * 10)}, recorded, formula,
    )  # fmt: skip
    random = np.random.default_rng(seed)
    low = random.random((6, 20)) * 0.8
    high = low + 0.2 * random.random((6, 1))
    bounds = Enclosure(problem, "float32")(low, high)
    drawn = low + random.random((40, 6, 20)) * (high - low)
    verdicts = Evaluator(problem, 240)(drawn.reshape(-1, 20).astype(np.float32))
    rho = verdicts.lowest.reshape(40, 6)
    assert np.all(rho >= bounds.low - 1e-6)
    assert np.all(rho <= bounds.high + 1e-6)
    assert not np.any(verdicts.violated.reshape(40, 6) & bounds.holds)
