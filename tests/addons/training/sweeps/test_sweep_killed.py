"""A sweep whose process is killed at random moments ends as if it had not been."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[4]
SCRIPT = """
import os
import sys
import numpy as np
import verifai_jax as vj
from drifting import Drift, drifting
from verifai_jax.addons.training.sweeps import training_runs as runs
from verifai_jax.addons.training.sweeps._sweep import sweep
from verifai_jax.addons.training.sweeps.halving import Halving

study = drifting({"rate": vj.LogUniform(0.01, 0.3), "width": vj.Categorical(3, 4)}, seeds=2)
how = {"halving": {"halving": Halving(2)}, "learning": {"search": "cross_entropy"}, "plain": {}}
print("begins", flush=True)
few = vj.Certification(samples=64)
found = sweep(
    study, configurations=12, certification=few, folder=sys.argv[1], **how[sys.argv[2]]
)
assert found.record.complete
columns = {n: c for n, c in found.record.columns.items() if n != "training_seconds"}
policies = [leaf for policy in found.record.policies for leaf in sum(policy.layers, ())]
arrays = {f"policy{i}": leaf for i, leaf in enumerate(policies)}
np.savez("written.npz", **{n: c.astype(str) for n, c in columns.items()}, **arrays)
os.replace("written.npz", sys.argv[3])  # A kill may come while it is written.
"""


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Compiled programs: all kinds train the same way."""
    return tmp_path_factory.mktemp("cache")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "learning", "halving"])
def test_killed_at_any_moment(kind, tmp_path, cache):
    (tmp_path / "run.py").write_text(SCRIPT)
    environment = {
        **os.environ,
        "PYTHONPATH": f"{ROOT}:{Path(__file__).parent}",
        "VERIFAI_JAX_CACHE": str(cache),
    }

    def start(name):
        arguments = ["run.py", name, kind, f"{name}.npz"]
        return subprocess.Popen(
            [sys.executable, *arguments], cwd=tmp_path, env=environment, stdout=subprocess.PIPE
        )

    def begun(process):
        with process.stdout as said:
            assert said.readline() == b"begins\n"
        return time.monotonic()

    took = 0.0
    # The second finds compiled programs, as do those below.
    for name in ("through",) if any(cache.iterdir()) else ("cold", "through"):
        process = start(name)
        began = begun(process)
        assert process.wait(600) == 0
        took = time.monotonic() - began
    moments = np.random.default_rng().uniform(0.02, 0.9, 2) * took
    killed = 0
    while killed < len(moments) and not (tmp_path / "killed.npz").exists():
        process = start("killed")
        begun(process)
        try:
            process.wait(moments[killed])
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            killed += 1
        process.wait(60)
        if not killed and (tmp_path / "killed.npz").exists():
            # The machine has become quicker: a kill has to come sooner.
            moments = moments / 2
            (tmp_path / "killed.npz").unlink()
            shutil.rmtree(tmp_path / "killed")
    assert killed
    if not (tmp_path / "killed.npz").exists():
        process = start("killed")
        begun(process)
        assert process.wait(600) == 0
    with np.load(tmp_path / "through.npz") as one, np.load(tmp_path / "killed.npz") as other:
        assert one.files == other.files, (kind, moments)
        for name in one.files:
            np.testing.assert_array_equal(one[name], other[name], err_msg=f"{name} {moments}")
