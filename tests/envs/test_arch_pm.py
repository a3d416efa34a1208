import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from envs.arch.pacemaker import pacemaker
from specs.arch import pacemaker as specs
from verifai_jax.core.values.waveform import Waveform


@pytest.fixture(scope="module")
def simulate():
    """Simulates limits that are constant for 2 s."""
    system = pacemaker()
    return jax.jit(jax.vmap(lambda knots: system({"LRL": Waveform(knots, "constant")})))


def counts(knots):
    """The paces at each ms, by the rules of the chart."""
    mode, since, count, counted = "CHARGE", 0, 0, [0]
    for ms in range(1, 10_001):
        period = 60_000 / knots[min(ms // 2000, 4)]
        since += 1
        if mode == "CHARGE" and since >= period - 2:
            mode, since, count = "PACE", 0, count + 1
        elif mode == "PACE" and since >= 2:
            mode, since = "CHARGE", 0
        counted.append(count)
    return np.array(counted)


def test_paces_are_counted_by_the_chart(simulate):
    rng = np.random.default_rng(0)
    knots = np.vstack([np.full(5, 50.0), np.full(5, 90.0), rng.uniform(50, 90, (8, 5))])
    knots = knots.astype(np.float32)
    traces = simulate(jnp.asarray(knots))
    for row, found in zip(knots, np.asarray(traces["paces"]), strict=True):
        np.testing.assert_array_equal(found, counts(row)[::10])
    # 1198 + 1200 j and 665 + 667 j ms.
    np.testing.assert_array_equal(traces["paces"][:2, -1], [8, 14])


def test_the_requirement_holds_at_the_extremes_and_between(simulate):
    knots = np.random.default_rng(1).choice([50.0, 60.0, 75.0, 90.0], (10, 5)).astype(np.float32)
    traces = simulate(jnp.asarray(knots))
    for i in range(10):
        trace = jax.tree.map(lambda leaf, i=i: leaf[i], traces)
        assert float(vj.mtl.robustness(specs.pm.formulas["spec"], trace)) >= 0
