"""No proof of a loop with tables, sorts and whole numbers is broken by ten thousand samples."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.evaluation.evaluator import Evaluator

sys.path.append(str(Path(__file__).parent / "sets"))
from random_controllers import controller

POINTS = 10_000


def loop(seed):
    """Return a problem of a random controller in a loop, without a threshold."""
    random = np.random.default_rng(seed)
    name, control = controller(random, 1 + seed % 3)

    def system(f, key):
        def step(state, _):
            x, count = state
            pushed = jnp.clip(0.6 * x + 0.3 * jnp.clip(control(x), -2, 2), -3, 3)
            count = count + (pushed[0] > x[1]).astype(jnp.int32)
            return (pushed, count), jnp.stack([*pushed, 0.25 * count])

        start = jnp.stack([f["a"], f["b"], 0.5 * f["a"] - f["b"]]), jnp.int32(0)
        return vj.Trace({"x": jax.lax.scan(step, start, None, length=4)[1]}, dt=1.0)

    def problem(threshold):
        spec = f"always (x[0] + x[3] <= {threshold!r})"
        return vj.Problem(name, {"a": vj.Box(-1, 1), "b": vj.Box(-1, 1)}, system, spec)

    return problem, random


@pytest.mark.slow
@pytest.mark.parametrize("block", range(3))
def test_what_is_proved_no_sample_breaks(block):
    """Thirty systems; a threshold is one that some points exceed, or none."""
    proved = 0.0
    for seed in range(10 * block, 10 * block + 10):
        problem, random = loop(seed)
        points = random.random((POINTS, 2)).astype(np.float32)
        margins = Evaluator(problem(0.0), 4096)(points).lowest
        share = float(random.choice([0.5, 0.9, 1.0]))
        threshold = float(np.quantile(-margins, share)) + 0.05 * (share == 1.0)
        found = vj.verify(problem(threshold), boxes=60, samples=0, progress=False)
        low, high, state = found.boxes.low, found.boxes.high, found.boxes.state
        verdicts = Evaluator(problem(threshold), 4096)(points)
        for wanted, wrong in ((1, verdicts.violated), (2, ~verdicts.violated)):
            own = state == wanted
            inside = (points[:, None] >= low[own]) & (points[:, None] <= high[own])
            assert not np.any(wrong & inside.all(-1).any(1)), problem(0.0).name
        assert not any("mistake" in note for note in found.notes)
        proved += found.proved.mass
    assert proved > 1.0
