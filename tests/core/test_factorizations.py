"""Batched factorizations: as LAPACK's of one matrix after the other, and no program that hangs."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np
import pytest

from verifai_jax.core.compute import factorizations
from verifai_jax.core.compute.factorizations import avoid_deadlock

GENERAL = np.random.default_rng(0).normal(size=(7, 70, 70))
SYMMETRIC = GENERAL @ np.swapaxes(GENERAL, 1, 2) + 70 * np.eye(70)
SMALL = SYMMETRIC[:, :20, :20].repeat(40, axis=0)  # 280 of them: whole blocks, and a part of one
AFFECTED = (0, 10, 0) <= jaxlib.version.__version_info__[:3] < (0, 11, 2)

HANGS = """
import jax.numpy as jnp
import verifai_jax as vj

def motion(time, state, control, features):
    stiff = features["a"] * jnp.eye(20) + 1.0 + jnp.diag(jnp.full(20, state["x"] ** 2))
    return {"x": 0.1 - state["x"] * jnp.linalg.solve(stiff, jnp.ones(20))[0]}

system = vj.ode(motion, lambda features, key: {"x": features["x0"]}, dt=0.1, duration=5.0)
space = {"a": vj.Box(1.0, 2.0), "x0": vj.Box(-1.0, 1.0)}
problem = vj.Problem("solve", space, system, "always x < 0.9")
run = vj.falsify(problem, "uniform", budget=512, batch=256, confirm=False, progress=False)
print(run.table.counts.violating > 0)
"""


@pytest.mark.parametrize(
    ("jax_function", "numpy_function", "matrices"),
    [
        (jnp.linalg.cholesky, np.linalg.cholesky, SMALL),
        (jnp.linalg.inv, np.linalg.inv, SMALL),
        (jnp.linalg.eigvalsh, np.linalg.eigvalsh, SYMMETRIC),
        (lambda a: jnp.linalg.svd(a)[1], lambda a: np.linalg.svd(a)[1], GENERAL),
        (lambda a: jnp.abs(jnp.linalg.qr(a)[1]), lambda a: np.abs(np.linalg.qr(a)[1]), GENERAL),
    ],
)
def test_batches_are_those_of_numpy(jax_function, numpy_function, matrices):
    avoid_deadlock()
    with jax.enable_x64():
        result = jax.jit(jax_function)(jnp.asarray(matrices))
        np.testing.assert_allclose(result, numpy_function(matrices), rtol=1e-8, atol=1e-8)


def test_solves_with_a_matrix_and_their_derivatives_are_those_of_one_after_the_other():
    avoid_deadlock()

    def energy(matrix):
        factor = jnp.linalg.cholesky(matrix)
        return jnp.sum(jax.scipy.linalg.solve_triangular(factor, jnp.ones(20), lower=True) ** 2)

    with jax.enable_x64():
        together = jax.jit(jax.vmap(jax.grad(energy)))(jnp.asarray(SMALL))
        inverse = np.linalg.inv(SMALL).sum(axis=2)
        # The derivative of 1' A^-1 1.
        exact = -inverse[:, :, None] * inverse[:, None, :]
        lower = np.tril(together + np.swapaxes(together, 1, 2))
        np.testing.assert_allclose(lower, np.tril(2 * exact), rtol=1e-6, atol=1e-9)


@pytest.mark.skipif(not AFFECTED, reason="this version of jaxlib does not cut batches")
@pytest.mark.parametrize("batch", [(280,), (28, 10)])
def test_no_batch_is_large_enough_to_be_cut(batch):
    avoid_deadlock()
    avoid_deadlock()
    form = jax.ShapeDtypeStruct((*batch, 20, 20), jnp.float32)
    text = jax.jit(jnp.linalg.cholesky).lower(form).as_text()
    calls = [line for line in text.splitlines() if "lapack_spotrf" in line]
    # 200 000 operations, 20 ** 3 / 3 a matrix.
    assert len(calls) == 1
    assert "tensor<75x20x20xf32>" in calls[0]
    assert "while" in text
    small = jax.ShapeDtypeStruct((75, 20, 20), jnp.float32)
    assert "while" not in jax.jit(jnp.linalg.cholesky).lower(small).as_text()


def test_other_versions_are_left_alone(monkeypatch):
    registered = []
    monkeypatch.setattr(factorizations.mlir, "register_lowering", registered.append)
    for version in ((0, 9, 2), (0, 11, 2), (0, 12, 0)):
        monkeypatch.setattr(jaxlib.version, "__version_info__", version)
        avoid_deadlock()
    assert not registered


@pytest.mark.slow
def test_a_system_that_solves_equations_runs_in_batches():
    command = [sys.executable, "-c", HANGS]
    # It hung for ever, in another process so that this one can go on.
    done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=True)
    assert done.stdout == "True\n"
