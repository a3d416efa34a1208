"""Mutated folders of sweeps are read, or refused in words."""

import shutil

import numpy as np
import pytest
from mutated import altered, flipped, wrong_answers
from planted_sweep import ToyStudy, planted_rows, record_of

from verifai_jax.addons.training.sweeps.result import Sweep, load_sweep


@pytest.mark.parametrize("count", [40, pytest.param(500, marks=pytest.mark.slow)])
def test_mutated_sweeps(tmp_path, count):
    whole, folder = tmp_path / "whole", tmp_path / "mutated"
    Sweep(record_of(planted_rows()[:6]), ToyStudy()).save(whole)
    files = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())
    wrong = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(whole, folder)
        file = folder / (files[rng.integers(len(files))] if rng.integers(2) else "sweep.json")
        of_json = file.suffix == ".json" and rng.integers(4)
        file.write_bytes((altered if of_json else flipped)(file.read_bytes(), rng))
        if why := wrong_answers(lambda: load_sweep(folder).summary()):
            wrong.append(f"{seed} {file.name}: {why}")
    assert not wrong, "\n".join(wrong)
