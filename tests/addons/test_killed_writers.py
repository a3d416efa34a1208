"""What each writer of files leaves, whatever instant its process dies at: old files or new ones."""

import ast
import json
from pathlib import Path

import pytest
from killed import killed_everywhere

import verifai_jax as vj
from verifai_jax.addons.reports.claims import PAGE, sealed
from verifai_jax.addons.reports.document import write_report
from verifai_jax.core.user_code.sources import file_hash


def report(path, number):
    low = 0.05 + 0.01 * number
    write_report(
        vj.Estimate("it", 0.1, low, 0.2, 0.95, "monte_carlo", 50, 90, 6, 0, 0.4, 50, 6, 0), path
    )


TRIED = {
    "addons/reports/document.py": (report, "it.html", 2),
}
"""What writes files by number, the name of one, and how many there are."""
ALONE = {
    "addons/estimation/trials/protocol.py", "addons/monitoring/requirement_files.py",
    "addons/perception/_detector.py", "systems/policy.py",
    "addons/agents/mcp.py", "addons/analysis/overview.py",
    "addons/assurance/operational_domain.py", "addons/assurance/qualification/result.py",
    "addons/checking/corpus.py", "addons/monitoring/commands/monitor.py",
    "addons/monitoring/fmu_monitor.py", "addons/monitoring/judgement.py",
    "addons/monitoring/plot.py", "addons/native/native_code/library.py", "addons/reports/page.py",
    "addons/rl/policies/base.py", "addons/simulators/pictures/mujoco_scene.py",
    "addons/synthesis/commands/synthesize.py", "cli/new.py", "core/compute/remembered.py",
    "core/display/notebook.py", "core/store/files.py", "core/store/loggers.py",
    "pictures/animation.py", "pictures/style.py",
}  # fmt: skip
"""Other writers by `replacing`, which tests/core/store/test_replacements.py kills. Those by
`replacing_all` are in tests/addons/training/sweeps/test_killed_saves.py."""


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if not p.name.startswith(".")}


@pytest.mark.thorough
@pytest.mark.parametrize("writer", TRIED)
def test_each_file_is_the_old_or_the_new(writer, tmp_path):
    write, name, count = TRIED[writer]
    told = []
    for number in (1, 0):
        write(tmp_path / name, number)
        told.append(contents(tmp_path))
    new, old = told
    assert len(old) == count
    assert all(old[name] != new[name] for name in old if name != "it_key.csv")
    seen = []

    def check():
        now = contents(tmp_path)
        assert now.keys() == old.keys()
        assert all(now[name] in (old[name], new[name]) for name in now)
        seen.append(now)
        if write is report and now not in (old, new):
            claims = json.loads(now["it.claims.json"])  # They say that the page is another one.
            assert sealed(claims) == claims
            assert claims[PAGE] != file_hash(tmp_path / name)
        write(tmp_path / name, 0)
        assert contents(tmp_path) == old
        assert len(list(tmp_path.iterdir())) == count

    assert killed_everywhere(lambda: write(tmp_path / name, 1), check) >= 3 * count
    # Nothing is replaced before all is complete: the renames are the last of the operations.
    assert seen[: -count - 3] == [old] * (len(seen) - count - 3)


def test_there_is_no_other_writer():
    root, calling = Path(vj.__file__).parent, set()
    for file in root.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] == "replacing":
                calling.add(file.relative_to(root).as_posix())
    assert calling == TRIED.keys() | ALONE
