"""Searches of add-ons have the names of all others, and without them the core goes on."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import verifai_jax as vj
from verifai_jax import search as searches
from verifai_jax.falsification import validation

ROOT = Path(__file__).parents[3]
ENTRIES = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
CLASSES = {
    name: target.partition(":")[2] for name, target in ENTRIES["verifai_jax.searches"].items()
}


def problem(dim):
    space = {f"x{i}": vj.Box(0, 1) for i in range(dim)}
    return vj.Problem("slow", space, vj.blackbox(lambda f: None), "x > 0")


@pytest.mark.parametrize("name", CLASSES)
def test_each_has_its_name_and_its_class(name):
    search = searches.named(name)
    assert type(search) is getattr(searches, CLASSES[name])
    assert {CLASSES[name]} <= set(dir(searches))
    assert name in searches.names()
    described = searches.to_json(search)
    assert described["name"] == name
    assert searches.from_json(described) == search
    if name == "likeliest":
        return  # It cannot be kept away from failures.
    around = searches.Diverse(search)
    assert searches.from_json(searches.to_json(around)) == around


def test_a_class_of_the_same_name_is_another_search():
    class Bayes(searches.Uniform):
        pass

    assert searches.to_json(Bayes()) is None


def test_a_misspelt_class_has_the_nearest_names():
    with pytest.raises(AttributeError, match=r"no 'Bayess'; did you mean 'Bayes'"):
        _ = searches.Bayess


def test_listing_them_imports_none():
    program = (
        "import sys, verifai_jax as vj; dir(vj.search); vj.search.names(); "
        "print(*[m for m in sys.modules if 'searches.' in m or m == 'jax'])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


@pytest.mark.parametrize(("dim", "priority"), [(2, False), (2, True), (30, True)])
def test_the_default_of_slow_simulations(dim, priority, monkeypatch):
    if priority:
        monkeypatch.setattr(validation, "_why_no_traces", lambda *_: "no traces")
    name = ("turbo" if dim > 20 else "bayes") if priority else "trace_surrogate"
    search, note = validation.slow_search(problem(dim), 2.0)
    assert search == searches.named(name)
    assert note == f"search {name}: a simulation takes 2 s; search= sets another"
    assert validation.slow_search(problem(dim), 0.1) is None
    # As where the add-on is missing.
    monkeypatch.setattr(searches, "extensions", lambda group: ())
    search, note = validation.slow_search(problem(dim), 2.0)
    assert search == searches.Portfolio(gradients=False)
    assert note == (
        f"search portfolio: a simulation takes 2 s, but {name}, which needs fewer of them, is not "
        "installed"
    )
    with pytest.raises(ValueError, match=f"unknown search '{name}'.*Known: uniform, halton, cross"):
        searches.named(name)
