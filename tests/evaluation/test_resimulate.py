"""Rows simulated again in programs of several sizes."""

import os
import subprocess
import sys

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.evaluation.resimulate import CALLS, LANES, REPLAYS, Replays


def test_a_larger_program_is_compiled_for_much_work_or_in_a_long_run(monkeypatch):
    made = []
    for work, first in ((10**12, 0), (10**5, 0), (10**12, 10**6)):
        monkeypatch.setattr("verifai_jax.evaluation.resimulate.WORK", work)
        system = vj.ode(
            lambda t, s, control, f: {"x": -s["x"]}, lambda f, key: {"x": f["a"]}, dt=0.1,
            duration=1.0,
        )  # fmt: skip
        problem = vj.Problem("decay", {"a": vj.Box(0.5, 2.0)}, system, "always x <= 1.5")
        replays = Replays(problem, "float32", run_keys(0)[1])
        values = np.linspace(0.6, 1.9, CALLS * LANES[0] + 1).astype(np.float32)
        [found] = replays(4, [{"a": values}], first + np.arange(len(values)))
        np.testing.assert_allclose(found.rho[:, 0], 1.5 - values, rtol=1e-6)
        made.append(problem.programs.peek(REPLAYS, ("float32", 0, LANES[0])) is not None)
    assert made == [True, False, False]


@pytest.mark.thorough
def test_python_is_called_in_double_precision_on_several_cores():
    code = (
        "import jax, jax.numpy as jnp, numpy as np\n"
        "import verifai_jax as vj\n"
        "from verifai_jax.core.values.trace import Trace\n"
        "def called(features, key):\n"
        "    x = features['x']\n"
        "    form = jax.ShapeDtypeStruct(x.shape, x.dtype)\n"
        "    x = jax.pure_callback(np.sqrt, form, x, vmap_method='sequential')\n"
        "    return Trace({'x': jnp.broadcast_to(x, (3,))}, dt=0.1)\n"
        "problem = vj.Problem('called', {'x': vj.Box(0.5, 1.0)}, called, 'always x <= 0.8')\n"
        "for budget in (8, 64):\n"
        "    run = vj.falsify(problem, 'uniform', budget, precision='float64', progress=False)\n"
        "    assert run.verdict_counts == {'confirmed': len(run.table.violating)}, run\n"
    )
    environment = {**os.environ, "VERIFAI_JAX_CORES": "3"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
