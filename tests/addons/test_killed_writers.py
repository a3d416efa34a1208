"""What writes files: those that belong together stay together, and no writer is unknown."""

from pathlib import Path

import pytest

import verifai_jax as vj
from verifai_jax.addons.reports import document
from verifai_jax.addons.reports.document import write_report

WRITERS = {
    "addons/agents/mcp.py", "addons/analysis/overview.py",
    "addons/assurance/operational_domain.py", "addons/assurance/qualification/result.py",
    "addons/assurance/signing.py", "addons/checking/corpus.py",
    "addons/faults/failure_table/sheet.py", "addons/estimation/trials/protocol.py",
    "addons/monitoring/commands/monitor.py", "addons/monitoring/fmu_monitor.py",
    "addons/monitoring/judgement.py", "addons/monitoring/plot.py",
    "addons/monitoring/requirement_files.py", "addons/native/native_code/library.py",
    "addons/perception/_detector.py", "addons/reports/document.py", "addons/reports/page.py",
    "addons/rl/policies/base.py", "addons/simulators/pictures/mujoco_scene.py",
    "addons/synthesis/commands/synthesize.py", "addons/verification/network.py",
    "cli/new.py", "core/compute/remembered.py",
    "core/display/notebook.py", "core/store/files.py", "addons/training/loggers.py",
    "addons/training/sweeps/function_runs.py",
    "pictures/animation.py", "pictures/style.py", "systems/forks.py", "addons/rl/policy.py",
}  # fmt: skip
"""Writers by `replacing`, which tests/core/store/test_replacements.py kills at each operation.
Those by `replacing_all` are in tests/addons/training/sweeps/test_killed_saves.py."""


def test_a_report_whose_claims_cannot_be_written_stays_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "it.html"
    of = lambda low: vj.Estimate(  # noqa: E731
        "it", 0.1, low, 0.2, 0.95, "monte_carlo", 50, 90, 6, 0, 0.4, 50, 6, 0
    )
    write_report(of(0.05), path)
    old = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    assert set(old) == {"it.html", "it.claims.json"}

    def full(claims):
        raise OSError("No space left on device")

    monkeypatch.setattr(document, "sealed", full)
    with pytest.raises(OSError, match="No space left"):
        write_report(of(0.06), path)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == old


def test_there_is_no_other_writer():
    root = Path(vj.__file__).parent
    own = {"core/store/atomic_files.py"}
    calling = {
        file.relative_to(root).as_posix()
        for file in root.rglob("*.py")
        if " replacing(" in file.read_text()
    }
    assert calling - own == WRITERS
