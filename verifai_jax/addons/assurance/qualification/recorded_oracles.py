"""Oracles of recordings, their verdicts, monitors and the trace matrix."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from verifai_jax import mtl
from verifai_jax.addons.assurance.qualification.random_formulas import DT, brute, random_formulas
from verifai_jax.addons.assurance.traceability import trace_matrix
from verifai_jax.core.values.trace import Trace
from verifai_jax.falsification import falsify
from verifai_jax.features import Box
from verifai_jax.mtl import Requirement
from verifai_jax.problem import Problem
from verifai_jax.systems.blackbox import blackbox

RECORDED = """when;speed;brake
;km/h;
2024-03-01T12:00:00;1,5;true
2024-03-01T12:00:00.5;-2,25;false
2024-03-01T12:00:01;3,0;true
"""


@contextlib.contextmanager
def _empty_folder() -> Iterator[None]:
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(here)


def readings() -> None:
    """Check that a recording is read as written: times, units, decimal commas, truth values."""
    with _empty_folder():
        Path("drive.csv").write_text(RECORDED, encoding="utf-8")
        trace = mtl.read("drive.csv", time="when")
    clock = np.asarray(trace.clock())
    assert np.allclose(clock - clock[0], [0.0, 0.5, 1.0]), clock
    speed = np.asarray(trace.signals["speed"])
    assert np.allclose(speed, [1.5, -2.25, 3.0]), speed
    assert trace.units["speed"] == "km/h", trace.units
    formulas = {"now": "brake", "never": "always brake", "some": "eventually !brake"}
    truths = mtl.judge(formulas, trace)
    verdicts = {row.requirement: row.verdict for row in truths.rows}
    assert verdicts["now"] == verdicts["some"] == "holds", verdicts
    assert verdicts["never"] == "fails", verdicts


def judgements() -> None:
    """Check that random formulas have the verdict of their definition on random recordings."""
    for formula, tree, values in random_formulas(4):
        wanted = brute(tree, values, 0)
        table = pd.DataFrame({"time": DT * np.arange(5), **values})
        (row,) = mtl.judge(formula, [table]).rows
        assert row.robustness == wanted, f"{formula}: {row}"
        if wanted:
            assert row.verdict == ("holds" if wanted > 0 else "fails"), f"{formula}: {row}"


def monitors() -> None:
    """Check that a monitor that follows samples ends with the robustness of the definition."""
    for formula, tree, values in random_formulas(5):
        monitor = mtl.watch(formula, dt=DT)
        for x, y in zip(values["x"], values["y"], strict=True):
            monitor.step({"x": x, "y": y})
        found = float(np.ravel(monitor.finish())[0])
        assert found == brute(tree, values, 0), f"{formula}: {found}"


def matrices() -> None:
    """Check that the trace matrix shows what a run found, and claims that were edited."""

    def system(features: dict[str, float]) -> Trace:
        return Trace({"x": np.full(3, features["a"])}, dt=0.1)

    spec = {"fails": "always x < 0.5", "holds": "always x < 2"}
    demands = [Requirement(name) for name in spec]
    known = Problem("known", {"a": Box(0.0, 1.0)}, blackbox(system), spec, requirements=demands)
    with _empty_folder():
        run = falsify(known, "uniform", 40, progress=False, folder="runs/known")
        run.report("runs/known/report.html", studies=False)
        matrix = trace_matrix(known, runs=["runs"])
        assert matrix.complete, matrix
        outcomes = {row.requirement: row.outcome for row in matrix.rows}
        assert outcomes == {"fails": "violated", "holds": "met"}, outcomes
        claims = Path("runs/known/report.claims.json")
        claims.write_text(claims.read_text().replace("40 simulations", "41 simulations"))
        matrix = trace_matrix(known, runs=["runs"])
        assert {gap.link for gap in matrix.suspect} == {"claims"}, matrix
