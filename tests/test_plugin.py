"""The package of a third party in `examples/plugin`, installed as its users install it."""

import os
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PLUGIN = ROOT / "examples" / "plugin"
PROGRAM = """
import verifai_jax as vj
from verifai_jax.core.values.cube import Cube
from verifai_jax.testing import check_search, check_system

space = vj.FeatureSpace(
    {"level0": vj.Box(0.5, 2.0), "inflow": vj.Box(0.5, 1.5), "outlet": vj.Box(0.6, 1.2)}
)
problem = vj.Problem("tank", space, vj.tank(duration=10.0), "always level <= 3")
check_system(vj.tank(duration=1.0), space)
check_search(vj.search.named("edges"), Cube((0, 0)))
run = vj.falsify(problem, "edges", 256, batch=64, folder="run", progress=False)
again = vj.load("run", problem)
assert str(run.search) == "Edges(margin=0.01)", run.search
assert again.search_data == {"name": "edges", "options": {"margin": 0.01}}
assert 0 < len(run.table.counterexamples) < 256
assert "edges" in vj.search.names()
try:
    vj.search.named("edge")
except ValueError as error:
    assert "did you mean 'edges'" in str(error), error
"""


def use(folder: Path, environment: dict[str, str], python: str = sys.executable) -> None:
    """Use all that the plugin registers, in a process of its own."""

    def call(*words: str) -> str:
        done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    call(python, "-c", PROGRAM)
    command = (python, "-m", "verifai_jax")
    assert "level0: " in call(*command, "extremes", "run")
    assert "extremes" in call(*command, "--help")
    call(*command, "report", "run", "--without-problem", "--section", "ranges")
    assert "Where violations lie" in (folder / "run" / "report.html").read_text()


@pytest.mark.slow
def test_a_registered_package_is_found_as_add_ons_are(
    tmp_path: Path, shared_cache: dict[str, str]
) -> None:
    """The files that an installation writes are enough; `pip` itself has the test below."""
    info = tmp_path / "site" / "tank_lab-0.1.dist-info"
    info.mkdir(parents=True)
    groups = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]["entry-points"]
    lines = []
    for group, points in groups.items():
        lines += [f"[{group}]", *(f"{name} = {target}" for name, target in points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tank_lab\nVersion: 0.1\n")
    path = os.pathsep.join(map(str, (info.parent, PLUGIN, ROOT)))
    use(tmp_path, {**shared_cache, "PYTHONPATH": path})


@pytest.mark.slow
def test_the_plugin_is_installed_into_a_fresh_environment(
    tmp_path: Path, shared_cache: dict[str, str]
) -> None:
    venv.create(tmp_path / "fresh", with_pip=False)
    python = str(tmp_path / "fresh" / "bin" / "python")
    site = next((tmp_path / "fresh" / "lib").glob("python*")) / "site-packages"
    # All but the plugin comes from the environment of the tests.
    here = [path for path in sys.path if path.endswith("site-packages")]
    (site / "here.pth").write_text("\n".join([*here, str(ROOT)]) + "\n")
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps"]
    subprocess.run([*pip, str(PLUGIN)], check=True)
    environment = {name: value for name, value in shared_cache.items() if name != "PYTHONPATH"}
    use(tmp_path, environment, python)
