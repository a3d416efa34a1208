"""What problems are made of, and what reads rows, compiles no program for a single operation."""

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.rl.policy import Policy, load_policy, save_policy
from verifai_jax.features.domain import as_real, on_device
from verifai_jax.systems.actions import Discrete

SPACE = {
    "x": vj.Box(-1.25, 1.35),
    "closed": vj.Box(0.1, 61.2, closed="left"),
    "both": vj.Box((0.0, 1.0, 2.0, 3.0, 4.0), (1.0, 2.0, 3.0, 4.0, 5.0)),
    "mass": vj.LogUniform(0.05, 0.53),
    "gust": vj.TruncatedNormal(0.0, 0.41, -1.0, 1.0),
    "kind": vj.Categorical("slow", "fast"),
    "wind": vj.Signal(vj.Box(-2.0, 2.0), knots=7, hold="linear"),
}
NOMINAL = {
    "x": 0.1,
    "closed": 61.1,
    "both": [0.5, 1.5, 2.5, 3.5, 4.5],
    "mass": 0.1,
    "gust": 0,
    "kind": "fast",
    "wind": 0.3,
}


def nothing(features, key):
    """Return a trace of no system."""
    return vj.Trace({"x": jnp.zeros(2)}, dt=0.1)


def test_a_problem_with_a_nominal_point_and_a_constraint_compiles_nothing(compiled):
    space = vj.FeatureSpace(SPACE, where=lambda f: f["x"] > 0)
    made = vj.Problem("made", space, nothing, "x > 0", nominal=NOMINAL)
    assert made.nominal == NOMINAL
    row = dict.fromkeys(space.columns, 0.5) | {"kind": "slow", "closed": 1.0}
    row |= {column: i + 0.5 for i, column in enumerate(c for c in space.columns if "both" in c)}
    features = space.from_row(row)
    assert features["wind"].knots.shape == (7,)
    assert isinstance(features["mass"], jax.Array)
    # The constraint, as its author wrote it.
    assert set(compiled) <= {"jit(greater)"}, compiled


def test_a_policy_is_read_without_compiling(compiled, tmp_path):
    layers = tuple((jnp.full((a, b), 0.1 * a), jnp.zeros(b)) for a, b in ((4, 13), (13, 2)))
    policy = Policy(layers, action=Discrete(2), mean=None, scale=None, log_std=None)
    save_policy(policy, tmp_path / "it.npz")
    compiled.clear()
    found = load_policy(tmp_path / "it.npz")
    assert compiled == []
    for (a, b), (c, d) in zip(layers, found.layers, strict=True):
        np.testing.assert_array_equal(a, c)
        np.testing.assert_array_equal(b, d)


@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize(
    "value",
    [0.1, 3, True, np.float32(0.1), np.float64(0.1), np.int64(7), np.array([1, 2]), [0.1, 0.2],
     np.array([0.1, 1e30]), np.array([0.1, 0.2], np.float32), np.array(True), (1, 0.5)],
)  # fmt: skip
def test_numbers_become_those_that_jax_makes_of_them(value, x64):
    with jax.enable_x64(x64):
        array = jnp.asarray(value)
        real = jnp.issubdtype(array.dtype, jnp.floating) and not array.weak_type
        expected = array if real else array.astype(jnp.result_type(float))
        for found in (as_real(value), jax.jit(lambda: as_real(value))()):
            assert isinstance(found, jax.Array)
            assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
            assert found.weak_type == expected.weak_type
            np.testing.assert_array_equal(found, expected)


def test_what_is_traced_stays_traced():
    assert jax.make_jaxpr(on_device)(1.0).eqns == []
