"""`verifai-jax last-chance`: a run in a folder, its row, and its picture."""

import json

import pytest
from click.testing import CliRunner

from verifai_jax.cli.main import main

MODEL = """
import jax.numpy as jnp
import verifai_jax as vj

car = vj.ode(
    lambda t, s, u, f: {"x": s["v"], "v": u},
    initial=lambda f, key: {"x": jnp.zeros(()), "v": f["v0"]},
    controller=lambda t, s, f: 0.0 * s["v"],
    dt=0.05, duration=3.0,
)
wall = vj.Problem("wall", {"v0": vj.Box(5, 8)}, car, "always x <= 10")
"""


@pytest.mark.slow
def test_the_command_prints_the_bracket_and_draws_it(tmp_path):
    (tmp_path / "model.py").write_text(MODEL)
    folder = tmp_path / "run"
    options = ("--search", "uniform", "--budget", "16", "--folder", str(folder), "--no-progress")
    done = CliRunner().invoke(main, ["falsify", f"{tmp_path / 'model.py'}:wall", *options])
    assert folder.is_dir(), done.output
    few = ("--problem", f"{tmp_path / 'model.py'}:wall", "--forks", "256", "--rounds", "6")
    without = CliRunner().invoke(main, ["last-chance", str(folder), *few])
    assert without.exit_code == 2
    assert "have no bounds, so nothing would be unavoidable" in without.output
    bounds = ("--actions", "-4", "4", "--json")
    done = CliRunner().invoke(main, ["last-chance", str(folder), *few, *bounds])
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert result["by"] == "the controller"
    assert 0 <= result["avoidable_until"] < result["no_escape_from"] <= result["failed"]
    assert "at its lowest, -4" in result["escape"]
    assert (folder / f"last-chance-{result['row']}.png").exists()
