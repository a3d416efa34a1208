"""A falsification imports what it uses, and no search or engine besides."""

import subprocess
import sys

import pytest

PROGRAM = """
import sys
import jax.numpy as jnp
import verifai_jax as vj

space = {"a": vj.Box(-0.3, 0.3)}
problem = vj.Problem(
    "p", space, lambda f, key: vj.Trace({"x": f["a"] * jnp.ones(3)}, dt=1.0), "always x < 0.2"
)
vj.falsify(problem, "uniform", 2000, batch=500, progress=False)
print(*sys.modules)
"""


@pytest.mark.thorough
def test_uniform_sampling_imports_no_other_search_and_no_other_engine():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    imported = set(done.stdout.split())
    searches = ("portfolio", "gradient", "descent", "mutation", "cross_entropy", "halton")
    engines = ("host_engine", "journal")
    unwanted = {f"verifai_jax.search.{name}" for name in searches}
    assert not any(".addons.searches." in name for name in imported)
    unwanted |= {f"verifai_jax.evaluation.{name}" for name in engines}
    assert not imported & unwanted
    assert not [name for name in imported if name.startswith("verifai_jax.addons.clusters")]
    assert "verifai_jax.search.uniform" in imported
