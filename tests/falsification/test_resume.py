"""A run that was stopped or cut off goes on as if it had not been."""

import dataclasses
import json
import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax import search
from verifai_jax.core.store.files import sealed
from verifai_jax.falsification.run_folder import STATE

SPACE = {"a": vj.Box(0, 1), "b": vj.Box(-1, 1), "kind": vj.Categorical("slow", "fast")}


NOMINAL = {"a": 0.5, "b": 0.0, "kind": "slow"}


def ramp(features, key):
    slope = features["a"] + 0.3 * features["b"] ** 2 + 0.1 * features["kind"]
    return vj.Trace({"x": slope * jnp.linspace(0, 1, 5)}, dt=0.25)


@pytest.fixture(scope="module")
def problem():
    return vj.Problem("ramp", space=SPACE, system=ramp, spec="always[0, 1] x <= 1.1")


def same(one, other):
    return one.table.all.equals(other.table.all)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "uniform",
        "portfolio",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("cross_entropy", "gradient")),
    ],
)
def test_in_memory(problem, name):
    whole = vj.falsify(problem, name, 96, batch=16)
    # In the middle of a round, which is simulated again as a whole.
    first = 39
    part = vj.falsify(problem, name, first, batch=16)
    resumed = vj.resume(part, budget=96)
    assert same(resumed, whole)
    assert (resumed.stopped, resumed.budget) == ("budget", 96)
    assert resumed.run_seconds > part.run_seconds
    # What it goes on from is untouched.
    assert len(part.table) == first


@pytest.mark.thorough
def test_with_more_counterexamples_than_are_replayed():
    problem = vj.Problem("ramp", space=SPACE, system=ramp, spec="always[0, 1] x <= 0.3")
    whole = vj.falsify(problem, "uniform", 8192, batch=1024)
    assert whole.verdict_counts["unexamined"] > 0
    half = vj.falsify(problem, "uniform", 4096, batch=1024)
    resumed = vj.resume(half, budget=8192)
    assert same(resumed, whole)
    assert resumed.verdict_counts == whole.verdict_counts
    assert resumed.summary().splitlines()[2] == whole.summary().splitlines()[2]


@pytest.mark.thorough
def test_a_budget_in_the_middle_of_a_round_that_was_reached_is_spent(problem):
    part = vj.falsify(problem, "cross_entropy", 25, batch=16)
    with pytest.raises(ValueError, match="has 25 simulations already"):
        vj.resume(part, budget=20)
    # The batch stays, where another budget would have had another.
    resumed = vj.resume(part, budget=2000)
    assert any(note.startswith("resumed in batches of 16: a run of 2000") for note in resumed.notes)


@pytest.mark.thorough
def test_rounds_simulated_ahead_are_those_in_turn(problem):
    """Only where the budget alone ends a run are rounds simulated before the last one is stored."""
    ahead = vj.falsify(problem, "uniform", 70, batch=16)
    assert same(ahead, vj.falsify(problem, "uniform", 70, batch=16, stop=vj.Stop(seconds=3600.0)))

    def interrupts(simulations, numbers):
        if simulations == 32:
            raise KeyboardInterrupt

    part = vj.falsify(problem, "uniform", 70, batch=16, callbacks=[interrupts])
    assert (part.stopped, len(part.table)) == ("interrupted", 32)
    assert same(vj.resume(part), ahead)


def test_passive_searches_go_on_within_a_batch(problem):
    whole = vj.falsify(problem, "halton", 64, batch=16)
    part = vj.falsify(problem, "halton", 25, batch=16)
    assert same(vj.resume(part, budget=64), whole)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cross_entropy", "portfolio"])
def test_from_a_folder_after_a_kill(problem, name, tmp_path):
    longest = vj.falsify(problem, name, 240, batch=16)
    end = 101
    whole = vj.falsify(problem, name, end, batch=16)
    vj.falsify(problem, name, 64, batch=16, folder=tmp_path / "run")
    # A process that dies has rows that its last saved state does not know of.
    first = 23
    earlier = vj.falsify(problem, name, first, batch=16, folder=tmp_path / "earlier")
    shutil.copy(earlier.folder / STATE, tmp_path / "run" / STATE)
    resumed = vj.resume(tmp_path / "run", problem, budget=end)
    assert same(resumed, whole)
    assert same(vj.load(tmp_path / "run", problem), whole)
    # And again, from what that has left.
    longer = vj.resume(tmp_path / "run", problem, budget=240)
    assert same(longer, longest)


def test_before_any_state_was_saved(problem, tmp_path):
    whole = vj.falsify(problem, "halton", 48, batch=16, folder=tmp_path / "run")
    (tmp_path / "run" / STATE).unlink()
    record = tmp_path / "run" / "run.json"
    entries = json.loads(record.read_text()) | {"stopped": "running"}
    record.write_text(json.dumps(sealed(entries)))
    assert same(vj.resume(tmp_path / "run", problem), whole)


@pytest.mark.thorough
def test_a_saved_run_can_be_resumed(problem, tmp_path):
    part = vj.falsify(problem, "cross_entropy", 32, batch=16)
    part.save(tmp_path)
    resumed = vj.resume(tmp_path, problem, budget=64)
    assert same(resumed, vj.falsify(problem, "cross_entropy", 64, batch=16))


@dataclasses.dataclass(frozen=True)
class Own(search.Uniform):
    """A search that verifai_jax does not know by name."""


@pytest.mark.slow
def test_a_black_box_with_everything_that_a_space_has(tmp_path):
    def cars(features):
        items = features["cars"]
        load = features["x"] + items.length + float(np.sum(items.values * items.mask))
        return vj.Trace({"load": np.array([load])}, dt=1.0)

    space = vj.FeatureSpace(
        {"x": vj.Normal(0, 1), "cars": vj.Array(vj.Box(0, 1), length=(0, 3))},
        where=lambda features: features["x"] > -1,
    )
    spec = {"grave": "load < 4", "light": "load < 2"}
    loaded = vj.Problem("cars", space, vj.blackbox(cars), spec, priority=["grave", "light"])
    vj.falsify(loaded, "cross_entropy", 60, batch=20, folder=tmp_path / "run")
    resumed = vj.resume(tmp_path / "run", loaded, budget=100)
    assert same(resumed, vj.falsify(loaded, "cross_entropy", 100, batch=20))
    table = resumed.table.all
    assert np.all(table["x"] > -1)
    np.testing.assert_array_equal(table["cars[2]"].isna(), table["cars.length"] < 3)
    load = table["x"] + table["cars.length"] + table[[f"cars[{i}]" for i in range(3)]].sum(axis=1)
    np.testing.assert_allclose(table["rho.grave"], 4 - load, atol=1e-5)
    assert resumed.replay(resumed.best).rho["light"] == pytest.approx(resumed.best["rho"])


class TestRefused:
    def test_a_spent_budget(self, problem):
        run = vj.falsify(problem, "halton", 16, batch=16)
        with pytest.raises(ValueError, match="has 16 simulations already; resume it with a larger"):
            vj.resume(run)

    def test_without_its_problem(self, problem, tmp_path):
        vj.falsify(problem, "halton", 16, batch=16, folder=tmp_path / "run")
        with pytest.raises(ValueError, match="needs its problem"):
            vj.resume(tmp_path / "run", budget=32)

    def test_another_search(self, problem):
        run = vj.falsify(problem, "halton", 16, batch=16)
        with pytest.raises(vj.RunError, match="the saved state is not one of search CrossEntropy"):
            vj.resume(run, search=search.CrossEntropy(), budget=32)

    def test_another_space(self, problem):
        run = vj.falsify(problem, "halton", 16, batch=16)
        other = vj.Problem(
            "ramp", {**SPACE, "b": vj.Box(-1, 2)}, ramp, "always[0, 1] x <= 1.1", nominal=NOMINAL
        )
        with pytest.raises(ValueError, match="was over another space: its feature 'b' was"):
            vj.resume(run, other, budget=32)
        with pytest.raises(ValueError, match="its feature 'b' was"):
            vj.resume(run, other.only("a", "kind"), budget=32)

    def test_a_search_of_ones_own_has_to_be_given(self, problem):
        run = vj.falsify(problem, Own(), 16, batch=16)
        with pytest.raises(ValueError, match=r"is not one of .*; give it"):
            vj.resume(run, budget=32)
        resumed = vj.resume(run, search=Own(), budget=32)
        assert same(resumed, vj.falsify(problem, Own(), 32, batch=16))

    def test_a_search_without_the_base(self, problem):
        with unchecked(), pytest.raises(TypeError, match="search must be a name or a search"):
            vj.falsify(problem, search.CrossEntropy)


class TestWarmStart:
    @pytest.mark.thorough
    def test_a_search_starts_where_the_table_says(self, problem):
        earlier = vj.falsify(problem, "uniform", 256, batch=64)
        assert len(earlier.table.counterexamples) > 5
        cold = vj.falsify(problem, "cross_entropy", 16, batch=16)
        for start in (earlier, earlier.table, earlier.table.all):
            warm = vj.falsify(problem, vj.Start("cross_entropy", run=start), 16, batch=16)
            assert len(warm.table.counterexamples) >= 6 > len(cold.table.counterexamples)
        assert len(warm.table) == 16

    @pytest.mark.slow
    def test_a_gradient_search_starts_from_the_nearest(self, problem):
        earlier = vj.falsify(problem, "uniform", 64, batch=64)
        warm = vj.falsify(problem, vj.Start("gradient", run=earlier), 16, batch=16)
        nearest = earlier.table.safe.nsmallest(4, "rho")
        np.testing.assert_allclose(warm.table.all["rho"][:4], nearest["rho"], atol=1e-5)

    def test_rows_without_a_verdict_do_not_count(self, problem):
        earlier = vj.falsify(problem, "uniform", 32, batch=16).table.all.copy()
        earlier.loc[5, ["rho", "status"]] = [np.nan, "nonfinite"]
        run = vj.falsify(problem, vj.Start("cross_entropy", run=earlier), 16, batch=16)
        assert np.all(np.isfinite(run.table.all["rho"]))
        nothing = earlier.loc[earlier["status"] != "ok"]
        cold = vj.falsify(problem, "cross_entropy", 16, batch=16)
        assert same(vj.falsify(problem, vj.Start("cross_entropy", run=nothing), 16, batch=16), cold)

    def test_bad_tables(self, problem):
        table = vj.falsify(problem, "uniform", 16, batch=16).table.all
        with pytest.raises(ValueError, match="unknown column of the earlier run 'kind'"):
            vj.falsify(problem, vj.Start(run=table.drop(columns="kind")))
        with (
            unchecked(),
            pytest.raises(TypeError, match="a run, an error table or a DataFrame; got 3"),
        ):
            vj.falsify(problem, vj.Start(run=3))
