"""Seconds of pytest in a fresh project: it fails, fails from the corpus, passes after the fix.

python benchmarks/pytest_runs.py                    # a minute

A pendulum with a limited torque, two tests of it: `@vj.test` with a search of 2000 simulations, and
the same problem from its file with `vj_max_failure_probability = 0.005`. The compile cache begins
empty. The plugin is the one that is installed, or that of this checkout.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONTROLLER = """
import jax.numpy as jnp


def torque(time, state, features):
    return jnp.clip(-GAIN * state["angle"] - 4.0 * state["speed"], -6.0, 6.0)
"""
PROBLEM = """
import jax.numpy as jnp

import verifai_jax as vj
from controller import torque

upright = vj.Problem(
    "upright",
    {"angle": vj.Box(-0.3, 0.3), "speed": vj.Box(-0.5, 0.5), "mass": vj.Box(0.8, 1.2)},
    vj.ode(
        lambda time, state, control, features: {
            "angle": state["speed"],
            "speed": 9.81 * jnp.sin(state["angle"]) + control / features["mass"],
        },
        lambda features, key: {"angle": features["angle"], "speed": features["speed"]},
        controller=torque, dt=0.02, duration=4.0,
        signals=lambda time, state, control, features: state,
    ),
    "always abs(angle) <= 0.8",
    nominal={"angle": 0.0, "speed": 0.0, "mass": 1.0},
)
"""
TEST = """
import verifai_jax as vj


@vj.test("specs/pendulum.py:upright", budget=2000)
def test_stays_upright():
    pass
"""
SETTINGS = """
[tool.pytest.ini_options]
testpaths = ["tests"]
vj_specs = ["specs/*.py"]
vj_budget = "4000"
vj_max_failure_probability = "0.005"
"""


def main() -> None:
    """Make the project, run pytest in it, and print the seconds."""
    with tempfile.TemporaryDirectory() as folder:
        project = Path(folder)
        for name, text in {
            "controller.py": f"GAIN = 8.0\n{CONTROLLER}",
            "specs/pendulum.py": PROBLEM,
            "tests/test_upright.py": TEST,
            "pyproject.toml": SETTINGS,
        }.items():
            path = project / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        own = {
            "PYTHONPATH": os.pathsep.join([str(ROOT), folder]),
            "VERIFAI_JAX_CACHE": str(project / "cache"),
        }
        plugin = ("-p", "_verifai_jax_pytest", "-p", "no:cacheprovider", "-q")
        for label in ("fails, nothing compiled", "fails again", "fixed", "fixed, again"):
            if label == "fixed":
                (project / "controller.py").write_text(f"GAIN = 30.0\n{CONTROLLER}")
            began = time.perf_counter()
            done = subprocess.run(
                [sys.executable, "-m", "pytest", *plugin],
                cwd=project, env={**os.environ, **own}, capture_output=True, text=True,
            )  # fmt: skip
            seconds = time.perf_counter() - began
            last = done.stdout.strip().splitlines()[-1]
            print(f"{label:26}{seconds:6.1f} s, exit code {done.returncode}: {last}", flush=True)


if __name__ == "__main__":
    main()
