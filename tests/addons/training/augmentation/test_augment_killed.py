"""An augmentation whose process is killed goes on, and ends with the same table."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parents[4]
SCRIPT = """
import os, signal, sys
import verifai_jax as vj
from rings import SMALL, rings, train

calls = []
def mortal(inputs, labels, weights, steps, key):
    calls.append(steps)
    if len(calls) == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)
    return train(inputs, labels, weights, steps, key)

arms = ("none", "counterexamples")
vj.augment(rings(train=mortal), arms, seeds=2, folder=sys.argv[1], **SMALL)
print(len(calls))
"""


@pytest.mark.slow
def test_killed_in_the_middle_of_training(tmp_path):
    (tmp_path / "run.py").write_text(SCRIPT)
    environment = {
        **os.environ,
        "PYTHONPATH": f"{ROOT}:{Path(__file__).parent}",
        "VERIFAI_JAX_CACHE": str(tmp_path / "cache"),
    }

    def ends(folder, call):
        command = [sys.executable, "run.py", folder, str(call)]
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True
        )

    whole = ends("whole", 0)
    assert whole.returncode == 0, whole.stderr
    assert whole.stdout == "7\n"
    assert ends("killed", 4).returncode == -signal.SIGKILL
    assert not (tmp_path / "killed" / "table.parquet").exists()
    last = ends("killed", 0)
    assert last.returncode == 0, last.stderr
    assert last.stdout == "4\n", "three networks were finished"
    for name in ("table.parquet", "added.parquet"):
        one, other = (pd.read_parquet(tmp_path / place / name) for place in ("whole", "killed"))
        pd.testing.assert_frame_equal(one, other)
