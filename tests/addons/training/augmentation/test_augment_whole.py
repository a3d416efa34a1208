"""Whole augmentations of a tiny task: arms, paired numbers, resuming, and what goes wrong."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from rings import SMALL, STEPS, inside, rings, train

import verifai_jax as vj
from verifai_jax.addons.training.augmentation import ARMS
from verifai_jax.core.store.cache import CacheError

pytestmark = pytest.mark.thorough

CALLS = []


def jitter(inputs, labels, key):
    return inputs + 0.01 * jax.random.normal(key, inputs.shape), labels


def counted(inputs, labels, weights, steps, key):
    CALLS.append(len(inputs))
    return train(inputs, labels, weights, steps, key)


TASK = rings(
    transform=jitter,
    train=counted,
    measures={"offset": lambda weights, key: float(weights[1][1][0])},
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return vj.augment(TASK, "all", seeds=2, folder=folder, **SMALL), folder


@pytest.mark.slow
def test_every_arm_adds_what_it_says(whole):
    result, _ = whole
    table = result.table.set_index(["arm", "seed"])
    assert result.arms == tuple(ARMS)
    assert set(table["status"]) == {"trained"}
    space = result.task.space
    for arm in ARMS:
        for seed in (0, 1):
            added = result.added
            rows = added.loc[(added["arm"] == arm) & (added["seed"] == seed)]
            # So few failures may support no rule, and then the arm says so.
            no_rule = arm.startswith("rules") and "no rule for" in table.loc[(arm, seed), "why"]
            wanted = 0 if arm == "none" or no_rule else 24
            assert len(rows) == table.loc[(arm, seed), "added"] == wanted
            if not wanted:
                continue
            for name in ("x", "y"):
                assert rows[name].between(-1, 1).all()
            errors = result.error_tables[seed]
            known = set(zip(errors["x"], errors["y"], strict=True))
            wrong = set(zip(*errors.loc[errors["violated"], ["x", "y"]].to_numpy().T, strict=True))
            chosen = set(zip(rows["x"], rows["y"], strict=True))
            if arm in ("counterexamples", "table_random", "table_closest"):
                assert chosen <= {(x, y) for x, y in wrong}
            elif arm in ("random", "table_pca", "pca_kept", "rules", "rules_kept"):
                assert not chosen & known
            if arm in ("counterexamples", "pca_kept", "rules_kept"):
                assert (rows["wrongness"] > 0).all()
                assert table.loc[(arm, seed), "wrong_added"] == 1.0
    examples = result.examples("counterexamples", 1)
    expected = [float(inside({"x": x, "y": y})) for x, y in np.asarray(examples.inputs)]
    np.testing.assert_array_equal(examples.labels, expected)
    assert space.columns == ("x", "y")


@pytest.mark.slow
def test_numbers_are_those_of_the_networks(whole):
    result, _ = whole
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (20_000, 2)).astype(np.float32)
    labels = np.asarray(jax.vmap(inside)({"x": points[:, 0], "y": points[:, 1]})) > 0.5
    for arm in ("base", "none", "counterexamples"):
        weights = result.weights[arm, 0]
        found = np.asarray(TASK.predict(weights, points)) > 0
        row = result.table.loc[(result.table["arm"] == arm) & (result.table["seed"] == 0)].iloc[0]
        # 512 test inputs against 20 000: five standard deviations.
        assert row["error"] == pytest.approx(np.mean(found != labels), abs=0.1)
        assert row["recall"] == pytest.approx(np.mean(found[labels]), abs=0.15)
        assert row["precision"] == pytest.approx(np.mean(labels[found]), abs=0.15)
        assert row["offset"] == float(weights[1][1][0])


def test_the_same_seed_gives_the_same_table(whole):
    result, _ = whole
    again = vj.augment(TASK, ("counterexamples", "none"), seeds=1, **SMALL)
    for name in ("none", "counterexamples", "base"):
        for one, other in ((again.table, result.table), (again.added, result.added)):
            rows = [t.loc[(t["arm"] == name) & (t["seed"] == 0)] for t in (one, other)]
            pd.testing.assert_frame_equal(*[row.reset_index(drop=True) for row in rows])
    other = vj.augment(TASK, "none", seeds=1, **{**SMALL, "hard": 0}, seed=1)
    assert other.table["error"].iloc[0] != result.table["error"].iloc[0]
    assert "hard_error" not in other.table


def test_finished_work_is_read_and_the_rest_computed(whole):
    result, folder = whole
    CALLS.clear()
    again = vj.augment(TASK, "all", seeds=2, folder=folder, **SMALL)
    assert CALLS == []
    pd.testing.assert_frame_equal(again.table, result.table)
    pd.testing.assert_frame_equal(again.added, result.added)
    assert str(again) == str(result)
    for name, weights in result.weights.items():
        jax.tree.map(np.testing.assert_array_equal, again.weights[name], weights)
    assert (folder / "summary.txt").read_text() == f"{result}\n"
    stored = pd.read_parquet(folder / "table.parquet")
    pd.testing.assert_frame_equal(stored, result.table)
    with pytest.raises(CacheError, match=r"holds a different augmentation: options\.added"):
        vj.augment(TASK, "none", seeds=2, folder=folder, **{**SMALL, "added": 25})


@pytest.mark.slow
def test_an_interrupted_study_goes_on(whole, tmp_path):
    result, _ = whole
    arms = ("none", "counterexamples", "random")

    def interrupted(inputs, labels, weights, steps, key):
        CALLS.append(len(inputs))
        if len(CALLS) == 4:
            raise KeyboardInterrupt
        return train(inputs, labels, weights, steps, key)

    # Under one name: the task is the same, as far as a cache can know.
    interrupted.__qualname__ = counted.__qualname__
    part = rings(transform=jitter, train=interrupted, measures=TASK.measures)
    CALLS.clear()
    cut = vj.augment(part, arms, seeds=2, folder=tmp_path, **SMALL)
    assert not cut.complete
    assert "NOT FINISHED" in str(cut)
    done = len(cut.table)
    CALLS.clear()
    whole_again = vj.augment(TASK, arms, seeds=2, folder=tmp_path, **SMALL)
    assert whole_again.complete
    assert len(CALLS) == 8 - done
    columns = ["arm", "seed"]
    expected = result.table.loc[result.table["arm"].isin((*arms, "base"))]
    pd.testing.assert_frame_equal(
        whole_again.table.sort_values(columns, ignore_index=True),
        expected.sort_values(columns, ignore_index=True),
    )


def test_a_search_that_is_interrupted_leaves_no_table(tmp_path, monkeypatch):
    from verifai_jax.addons.training.augmentation import study

    def cut(*arguments, **options):
        run = search(*arguments, **options)
        return replace(run, stopped="interrupted")

    search = study.falsify
    monkeypatch.setattr(study, "falsify", cut)
    options = {**SMALL, "steps": (STEPS, STEPS), "hard": 0}
    result = vj.augment(TASK, "counterexamples", seeds=1, folder=tmp_path, **options)
    assert not result.complete
    assert list(result.table["arm"]) == ["base"]
    monkeypatch.undo()
    result = vj.augment(TASK, "counterexamples", seeds=1, folder=tmp_path, **options)
    assert result.complete
    assert len(result.error_tables[0]) == SMALL["budget"]


def test_pictures_are_drawn_and_written(whole, tmp_path):
    result, _ = whole
    for metric in ("error", "offset"):
        result.plot(tmp_path / f"{metric}.png", metric)
        assert (tmp_path / f"{metric}.png").stat().st_size > 5000
    with pytest.raises(ValueError, match=r"needs inputs that are images .*got shape \[2\]"):
        result.montage()
    with pytest.raises(ValueError, match="the arm 'none' added no inputs in seed 1"):
        result.montage(arm="none", seed=1)
    with pytest.raises(ValueError, match="unknown seed 7"):
        result.examples("random", 7)
    with pytest.raises(ValueError, match="unknown metric 'eror'; did you mean 'error'"):
        result.compare("eror")


def test_a_base_that_is_never_wrong():
    right = rings(wrongness=lambda logit, label: jnp.float32(-1.0) + 0.0 * logit)
    options = {**SMALL, "steps": (STEPS, STEPS)}
    arms = ("none", "counterexamples", "table_random", "table_closest", "table_pca", "rules_kept")
    result = vj.augment(right, arms, seeds=1, **options)
    assert (result.table["added"] == 0).all()
    assert (result.table["error"] == 0).all()
    assert result.table["hard_error"].isna().all()
    text = str(result)
    assert "no seed has a counterexample" in text
    assert "no input was found on which an independent network errs" in text
    assert "the error table has no counterexamples in 256 rows" in text


def test_training_that_diverges_is_told():
    def diverges(inputs, labels, weights, steps, key):
        found = train(inputs, labels, weights, steps, key)
        # The arm that adds something diverges; so does the base of no seed.
        bad = jnp.nan if weights is not None and len(inputs) > SMALL["initial"] else 1.0
        return jax.tree.map(lambda leaf: leaf * bad, found)

    result = vj.augment(rings(train=diverges), ("none", "random"), seeds=2, **SMALL)
    status = result.table.set_index(["arm", "seed"])["status"]
    assert status["random", 0] == "not finite"
    assert status["none", 0] == "trained"
    assert "not finite   2 networks (2 of random)" in str(result)

    def lost(inputs, labels, weights, steps, key):
        return jax.tree.map(lambda leaf: leaf * jnp.nan, train(inputs, labels, None, STEPS, key))

    result = vj.augment(rings(train=lost), ("none", "counterexamples"), seeds=1, **SMALL)
    assert (result.table["status"] == "not finite").all()
    assert "the base network is not finite" in set(result.table["why"])
    assert "not finite   3 networks" in str(result)


@pytest.mark.slow
@pytest.mark.parametrize("search", ["cross_entropy", "gradient"])
def test_any_search_fills_the_table(search):
    options = {**SMALL, "steps": (STEPS, STEPS), "budget": 64}
    result = vj.augment(rings(), "counterexamples", seeds=1, search=search, **options)
    table = result.error_tables[0]
    assert len(table) == 64
    weights = result.weights["base", 0]
    points = table[["x", "y"]].to_numpy(np.float32)
    labels = np.asarray(jax.vmap(inside)({"x": points[:, 0], "y": points[:, 1]}))
    margins = np.asarray(TASK.predict(weights, points)) * (2 * labels - 1)
    np.testing.assert_allclose(table["rho"], margins, atol=1e-4)
    np.testing.assert_array_equal(table["violated"], margins < 0)


def test_a_task_that_jax_cannot_trace_gives_the_same(whole):
    result, _ = whole

    def render(features):
        return np.array([float(features["x"]), float(features["y"])], np.float32)

    def label(features):
        radius = np.hypot(float(features["x"]), float(features["y"]))
        return np.float32(0.35 < radius < 0.8)

    def predict(weights, inputs):
        return np.asarray(TASK.predict(weights, jnp.asarray(inputs)))

    def fit(inputs, labels, weights, steps, key):
        assert isinstance(inputs, np.ndarray)
        return train(jnp.asarray(inputs), jnp.asarray(labels), weights, steps, key)

    task = rings(render=render, label=label, predict=predict, train=fit, black_box=True)
    found = vj.augment(task, ("none", "counterexamples"), seeds=1, **SMALL)
    for arm in ("none", "counterexamples"):
        one, other = (
            t.loc[(t["arm"] == arm) & (t["seed"] == 0)].iloc[0] for t in (found.table, result.table)
        )
        assert one["added"] == other["added"]
        assert one["error"] == pytest.approx(other["error"], abs=0.02)


def test_a_narrow_initial_set_is_drawn_from_its_space():
    narrow = rings(training_space={"x": vj.Box(-1, 0), "y": vj.Box(-1, 1)}, train=seen)
    result = vj.augment(narrow, ("none", "random"), seeds=1, **{**SMALL, "hard": 0})
    assert SEEN[0] <= 0
    assert SEEN[-1] > 0
    assert result.added["x"].max() > 0


SEEN = []


def seen(inputs, labels, weights, steps, key):
    SEEN.append(float(inputs[:, 0].max()))
    return train(inputs, labels, weights, steps, key)
