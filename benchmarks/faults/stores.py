"""Folders of sweeps with damaged, exchanged and forged files.

What must hold: a sweep goes on in such a folder to the table of an undamaged one, computing anew
what is damaged, or is refused in words; a sweep that is loaded has the right table or is refused.
"""

import functools
import shutil
import tempfile
from pathlib import Path

import pandas as pd

import verifai_jax as vj
from benchmarks.faults.cases import Broken, chance
from benchmarks.faults.folders import NAMED, check_described, damage
from tests.addons.training.sweeps.drifting import drifting
from verifai_jax.addons.training.sweeps.study import Study

CONFIGURATIONS, SAMPLES = 3, 32


@functools.cache
def _study() -> Study:
    return drifting({"rate": vj.LogUniform(0.01, 0.3)}, seeds=2)


def _sweep(folder: Path) -> vj.Sweep:
    return vj.sweep(
        _study(),
        configurations=CONFIGURATIONS,
        certification=vj.Certification(samples=SAMPLES),
        folder=folder,
        progress=False,
    )


@functools.cache
def _base() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="stores-")) / "sweep"
    _sweep(folder).save(folder)
    return folder


@functools.cache
def _table() -> pd.DataFrame:
    return _sweep(_base()).table


def case(number: int) -> str:
    """Damage a sweep's folder, and use it. **Returns:** what came of it."""
    random_ = chance(number, "stores")
    expected = _table()
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "sweep"
        shutil.copytree(_base(), folder)
        for _ in range(random_.choice((1, 1, 1, 2, 3))):
            damage(folder, random_)
        try:
            _same(vj.load_sweep(folder, _study()).table, expected)
            loaded = "loaded"
        except NAMED as error:
            check_described(error)
            loaded = "not loaded"
        try:
            _same(_sweep(folder).table, expected)
        except NAMED as error:
            check_described(error)
            return f"{loaded}, refused"
        return f"{loaded}, went on"


def _same(table: pd.DataFrame, expected: pd.DataFrame) -> None:
    for name in expected:
        if "seconds" not in name and not (name in table and table[name].equals(expected[name])):
            raise Broken(f"column {name!r} of the sweep differs")
