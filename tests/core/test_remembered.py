"""Programs are recalled where what they follow from is the same, to the last bit."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.remembered import lower_or_recall, remembered_as
from verifai_jax.evaluation.differentiation import Derivative
from verifai_jax.evaluation.engine import Engine

KEY = run_keys(0)[1]


class Pair(NamedTuple):
    first: object
    second: object


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path))
    return tmp_path / "derived"


class Traced:
    """A function that counts how often it is traced."""

    def __init__(self):
        self.times = 0

    def __call__(self, pair):
        self.times += 1
        return Pair(jnp.sin(pair.first), {"sum": pair.first.sum() + pair.second})


FORMS = (Pair(jax.ShapeDtypeStruct((4,), jnp.float32), jax.ShapeDtypeStruct((), jnp.float32)),)
RESULT = jax.tree.structure(Pair(0, {"sum": 0}))
VALUES = Pair(np.linspace(0, 1, 4, dtype=np.float32), np.float32(2.5))


def results(function, name):
    return lower_or_recall(name, function, FORMS, RESULT).compile()(VALUES)


def test_a_program_is_traced_once_and_recalled(folder):
    function, again = Traced(), Traced()
    name = remembered_as("kind", "what it follows from", 1)
    one, two = results(function, name), results(again, name)
    assert (function.times, again.times) == (1, 0)
    jax.tree.map(np.testing.assert_array_equal, one, two)
    jax.tree.map(np.testing.assert_array_equal, one, results(Traced(), None))
    assert [path.name for path in folder.iterdir()] == [name]


@pytest.mark.parametrize("harm", [b"", b"no program", None], ids=["empty", "text", "one bit"])
def test_a_damaged_file_is_none(folder, harm):
    name = remembered_as("kind", 1)
    one = results(Traced(), name)
    path = folder / name
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(bytes(data) if harm is None else harm)
    function = Traced()
    jax.tree.map(np.testing.assert_array_equal, one, results(function, name))
    assert function.times == 1
    assert path.stat().st_size == len(data)  # Mended.


def test_settings_and_values_are_in_the_name(folder):
    name = remembered_as("kind", 1)
    assert name == remembered_as("kind", 1) != remembered_as("kind", 2)
    with jax.enable_x64(True):
        assert remembered_as("kind", 1) != name
    assert remembered_as("kind", None) is None
    assert remembered_as("kind", lambda: 0) is None


def test_nothing_is_kept_without_a_cache(monkeypatch):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", "off")
    assert remembered_as("kind", 1) is None


def test_a_folder_that_cannot_be_written_costs_only_time(tmp_path, monkeypatch):
    place = tmp_path / "file"
    place.write_text("")
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(place))
    function = Traced()
    assert results(function, remembered_as("kind", 1)).second["sum"] == pytest.approx(4.5)


def test_what_cannot_be_exported_is_compiled_as_it_is(folder):
    def function(pair):
        value = jax.pure_callback(np.sin, pair.first, pair.first, vmap_method="sequential")
        return Pair(value, {"sum": pair.second})

    got = results(function, remembered_as("kind", "callback"))
    np.testing.assert_allclose(got.first, np.sin(VALUES.first), rtol=1e-6)
    assert not folder.exists()


def falling(high=1.5, pull=1.0, bound=0.2):
    system = vj.ode(
        lambda t, s, c, f: {"h": s["v"], "v": -pull - f["drag"] * s["v"]},
        lambda f, key: {"h": f["start"], "v": 0.0},
        dt=0.1,
        duration=1.0,
    )
    space = {"start": vj.Box(0.5, high), "drag": vj.Box(-0.5, 1.0)}
    return vj.Problem("fall", space, system, f"always (h >= {bound} & v > -0.9)")


@pytest.mark.slow
@pytest.mark.parametrize("clauses", [False, True])
def test_gradients_are_recalled_and_right(folder, monkeypatch, clauses):
    swept = []
    for verb in ("__call__", "of_several"):
        own = getattr(Derivative, verb)

        def counted(self, *arguments, own=own):
            swept.append(self)
            return own(self, *arguments)

        monkeypatch.setattr(Derivative, verb, counted)

    def verdicts(problem):
        points = np.random.default_rng(0).random((4, 2), np.float32)
        before = len(swept)
        engine = Engine(problem, 4, gradient=True, clauses=clauses)
        return engine.evaluate(points, KEY, temperature=0.1), len(swept) - before

    def fresh(problem):
        with monkeypatch.context() as patched:
            patched.setenv("VERIFAI_JAX_CACHE", "off")
            return verdicts(problem)[0]

    one, traced = verdicts(falling())
    assert traced == 1
    again, traced = verdicts(falling())
    assert traced == 0
    # Bounds of the space are arguments of the program; the dynamics and the formula are in it.
    wider, traced = verdicts(falling(high=2.5))
    assert traced == 0
    for other in (falling(pull=1.2), falling(bound=0.3)):
        different, traced = verdicts(other)
        assert traced == 1
        same(different, fresh(other))
    same(one, again)
    same(one, fresh(falling()))
    same(wider, fresh(falling(high=2.5)))
    assert not np.array_equal(one.features["start"], wider.features["start"])


def same(one, other):
    for name in ("rho", "status", "gradient", "clauses", "clause_gradients"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None)
        if a is not None:
            np.testing.assert_array_equal(a, b)
    jax.tree.map(np.testing.assert_array_equal, one.features, other.features)


@pytest.mark.slow
@pytest.mark.parametrize(
    "search",
    ["portfolio", "gradient", "cross_entropy", pytest.param("bayes", marks=pytest.mark.addons)],
)
def test_a_search_is_the_same_recalled(folder, monkeypatch, search):
    from verifai_jax.search.search_program import compiled_search

    def rows():
        compiled_search.cache_clear()
        run = vj.falsify(falling(), search, budget=64, batch=8, confirm=False, progress=False)
        return run.table.all

    first = rows()
    assert any(path.name.startswith("search-ask") for path in folder.iterdir())
    second = rows()
    monkeypatch.setenv("VERIFAI_JAX_CACHE", "off")
    for other in (second, rows()):
        assert first.equals(other)
