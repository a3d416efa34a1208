"""Mutated files give a right answer or one error in words, in bounded time and memory."""

import shutil
import warnings

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from mutated import altered, flipped, wrong_answers

import verifai_jax as vj
from verifai_jax.addons.checking.corpus import SavedCounterexample
from verifai_jax.addons.monitoring.requirement_files import read_requirements, write_requirements
from verifai_jax.addons.rl.policy import Policy, load_policy, save_policy
from verifai_jax.systems.actions import Continuous

FEW, MANY = 40, 500


def ramp(features, key):
    return vj.Trace({"x": features["a"] * jnp.linspace(0, 1, 5)}, dt=0.25)


@pytest.fixture(scope="module")
def problem():
    space = {"a": vj.Box(0, 1), "k": vj.Categorical("u", "v")}
    return vj.Problem("ramp", space, ramp, "always x <= 0.9")


@pytest.fixture(scope="module")
def run(problem, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    return vj.falsify(problem, "cross_entropy", 48, batch=16, folder=folder, progress=False)


def mutated_table(folder, rng):
    frame = pd.read_parquet(folder / "table.parquet")
    name = frame.columns[rng.integers(len(frame.columns))]
    match rng.integers(5):
        case 0:
            frame = frame.drop(columns=name)
        case 1:
            frame[name] = "text"
        case 2:
            frame[name] = [None] * len(frame)
        case 3:
            frame = frame.rename(columns={name: "other"})
        case 4:
            frame = frame.iloc[:: int(rng.integers(2, 5))]
    frame.to_parquet(folder / "table.parquet")


def read_run(folder, problem):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = vj.load(folder, problem)
        run.summary()
        assert len(run.table.counterexamples) <= 48


def check_run(run, problem, tmp_path, count):
    wrong = []
    for seed in range(count):
        rng, folder = np.random.default_rng(seed), tmp_path / str(seed)
        shutil.copytree(run.folder, folder)
        file = folder / rng.choice(["run.json", "table.parquet", "search.state"])
        if file.name == "table.parquet" and rng.integers(3):
            mutated_table(folder, rng)
        elif file.name == "run.json" and rng.integers(3):
            file.write_bytes(altered(file.read_bytes(), rng))
        else:
            file.write_bytes(flipped(file.read_bytes(), rng))
        if why := wrong_answers(lambda folder=folder: read_run(folder, problem)):
            wrong.append(f"{seed} {file.name}: {why}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
def test_mutated_runs(run, problem, tmp_path):
    check_run(run, problem, tmp_path, FEW)


@pytest.mark.slow
def test_many_mutated_runs(run, problem, tmp_path):
    check_run(run, problem, tmp_path, MANY)


REQUIREMENTS = """id,text,formula
R1,first,always x > 0
R2,"second, and more",always (x > 1) -> eventually y < 2
"""


@pytest.fixture(scope="module")
def samples(run, tmp_path_factory):
    """Valid files, each with what reads it."""
    made = tmp_path_factory.mktemp("samples")
    layers = ((np.ones((2, 3), np.float32), np.zeros(3, np.float32)),)
    save_policy(Policy(layers, None, None, None, Continuous(-1.0, 1.0, 3)), made / "p.npz")
    (made / "r.csv").write_text(REQUIREMENTS)
    write_requirements(read_requirements(made / "r.csv"), made / "r.reqif")
    (made / "r.toml").write_text(
        '[[requirement]]\nid = "R1"\nformula = "always x > 0"\n[constants]\nlimit = 2.5\n'
    )
    (made / "r.yaml").write_text(
        "requirements:\n- id: R1\n  formula: always x > limit\nconstants: {limit: 2.5}\n"
    )
    corpus = run.save_counterexamples(made / "corpus", max_count=1)
    shutil.copy(next(iter((made / "corpus").iterdir())), made / "c.json")
    assert corpus
    readers = {".csv": read_requirements, ".reqif": read_requirements, ".toml": read_requirements}
    readers |= {".yaml": read_requirements, ".npz": load_policy, ".json": SavedCounterexample.read}
    return {f.name: (f, readers[f.suffix]) for f in made.iterdir() if f.is_file()}


def check_sample(sample, tmp_path, count):
    file, read = sample
    read(file)
    path, wrong, content = tmp_path / file.name, [], file.read_bytes()
    for seed in range(count):
        rng = np.random.default_rng(seed)
        of_json = file.suffix == ".json" and rng.integers(3)
        path.write_bytes((altered if of_json else flipped)(content, rng))
        if why := wrong_answers(lambda: read(path)):
            wrong.append(f"{seed}: {why}")
    assert not wrong, "\n".join(wrong)


pytestmark = pytest.mark.filterwarnings("ignore:.*is read as Windows-1252")
NAMES = ["p.npz", "r.csv", "r.reqif", "r.toml", "r.yaml", "c.json"]


@pytest.mark.thorough
@pytest.mark.parametrize("name", NAMES)
def test_mutated(samples, name, tmp_path):
    check_sample(samples[name], tmp_path, FEW)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_many_mutated(samples, name, tmp_path):
    check_sample(samples[name], tmp_path, MANY)
