"""A saved sweep, hardening or augmentation is the old or the new, whenever its process dies."""

import ast
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from killed import killed_everywhere
from planted_sweep import ToyStudy, planted_rows, record_of

import verifai_jax
from verifai_jax.addons.training.augmentation.result import Augmentation
from verifai_jax.addons.training.hardening.result import Hardening
from verifai_jax.addons.training.sweeps.exported import TrainedConfiguration
from verifai_jax.addons.training.sweeps.result import Sweep, load_sweep
from verifai_jax.core.store.locks import settled


class Saved:
    """A policy that saves its number."""

    def __init__(self, number):
        self.number = number

    def save(self, path):
        Path(path).write_text(str(self.number))


def result_of(kind, number):
    frame = pd.DataFrame({"x": [float(number)] * (5 + number)})
    policies = {"start": Saved(number), "policy": Saved(number)}
    fake = SimpleNamespace(table=frame, added=frame, summary=lambda: str(number), **policies)
    assert {"table", "added"} <= {field.name for field in fields(kind)}
    return lambda folder: kind.save(fake, folder)


def sweep_of(number):
    return Sweep(record_of(planted_rows()[: 4 + number]), ToyStudy()).save


def configuration_of(number):
    fake = SimpleNamespace(study="s", steps=number, policy=Saved(number))
    return lambda folder: TrainedConfiguration.export(fake, folder)


def contents(folder):
    files = (p for p in folder.rglob("*") if p.is_file() and p.name != "writer.lock")
    named = {str(p.relative_to(folder)): p.read_bytes() for p in files}
    return {name: data for name, data in named.items() if not name.startswith(".")}


SAVERS = {
    "addons/training/sweeps/storage.py": (sweep_of, lambda f: load_sweep(f).table.to_dict("list")),
    "addons/training/hardening/result.py": (lambda n: result_of(Hardening, n), None),
    "addons/training/augmentation/result.py": (lambda n: result_of(Augmentation, n), None),
    "addons/training/sweeps/exported.py": (configuration_of, None),
    "falsification/run_folder.py": None,  # tests/core/store/test_replacements.py
}
"""What saves several files together: saves by number, and the reader where there is one."""


@pytest.mark.slow
@pytest.mark.parametrize("saver", [name for name, saver in SAVERS.items() if saver])
def test_it_is_the_old_or_the_new(saver, tmp_path):
    of, read = SAVERS[saver]
    old, new, folder = of(0), of(1), tmp_path / "it"
    old(folder)
    (folder / "sweep.cache").write_text("a user's, or another kind's")
    read = read or (lambda folder: contents(settled(folder)))
    before = set(contents(folder))

    def check():
        assert str(read(folder)) in told
        old(folder)
        assert set(contents(folder)) == before
        assert not list(folder.glob(".*"))

    told = [str(read(folder))]
    new(folder)
    told.append(str(read(folder)))
    old(folder)
    assert killed_everywhere(lambda: new(folder), check) > 10


@pytest.mark.slow
def test_there_is_no_other():
    root = Path(verifai_jax.__file__).parent
    calling = set()
    for file in root.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.Call) and "replacing_all" in ast.unparse(node.func):
                calling.add(file.relative_to(root).as_posix())
    assert calling == set(SAVERS)
