"""Tables of scores that others wrote: how they are read, and what their intervals cover."""

import json

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from scipy import stats

import verifai_jax as vj
from verifai_jax.addons.estimation.clustered import anytime_mean, clustered_mean, difference
from verifai_jax.addons.estimation.comparison.score_tables import read_scores
from verifai_jax.cli.main import main


def lerobot(path, successes, seeds=None):
    """Write an `eval_info.json` as LeRobot does: of many tasks, or of one with its seeds."""
    if seeds is None:
        info = {
            "per_task": [
                {"task_group": "libero", "task_id": i, "metrics": {
                    "sum_rewards": [1.0] * len(each), "successes": each, "video_paths": []}}
                for i, each in enumerate(successes)
            ],
            "per_group": {}, "overall": {"pc_success": 50.0},
        }  # fmt: skip
    else:
        info = {
            "per_episode": [
                {"episode_ix": i, "sum_reward": 1.0, "max_reward": 1.0, "success": s, "seed": seed}
                for i, (s, seed) in enumerate(zip(successes, seeds, strict=True))
            ],
            "aggregated": {"pc_success": 50.0},
        }
    path.write_text(json.dumps(info))
    return str(path)


def test_forms_of_scores_are_read_alike(tmp_path):
    won = [[True, False, True], [False, False, True]]
    file = lerobot(tmp_path / "eval_info.json", won)
    many = read_scores(file)
    assert many["score"].tolist() == [1, 0, 1, 0, 0, 1]
    assert many["task"].tolist() == ["libero/0"] * 3 + ["libero/1"] * 3
    one = read_scores(lerobot(tmp_path / "one.json", won[0], [7, 8, 9]))
    assert one[["seed", "score"]].to_numpy().tolist() == [[7, 1], [8, 0], [9, 1]]
    unseeded = read_scores(lerobot(tmp_path / "none.json", won[0], [None] * 3))
    assert list(unseeded.columns) == ["score"]
    runs = read_scores([file, file])
    assert runs["run"].tolist() == [0] * 6 + [1] * 6
    (tmp_path / "counts.csv").write_text("seed,Task,successes,episodes\n0,a,1,3\n1,a,2,2\n")
    counts = read_scores(tmp_path / "counts.csv")
    assert counts.groupby("seed")["score"].agg(["sum", "size"]).to_numpy().tolist() == [
        [1, 3], [2, 2]
    ]  # fmt: skip
    (tmp_path / "words.csv").write_text("seed,failed\n0,yes\n1,no\n")
    assert read_scores(str(tmp_path / "words.csv"))["score"].tolist() == [0, 1]
    matrix = np.array([[0.5, 2.0], [0.25, 1.0], [0.0, 4.0]])
    np.savez(tmp_path / "scores.npz", dqn=matrix)
    (tmp_path / "scores.json").write_text(json.dumps(matrix.tolist()))
    for given in (matrix, tmp_path / "scores.npz", tmp_path / "scores.json"):
        read = read_scores(given)
        assert read["run"].tolist() == [0, 0, 1, 1, 2, 2]
        assert read["score"].tolist() == matrix.ravel().tolist()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.json", "{}", "is neither an eval_info.json of LeRobot.*KeyError..per_episode"),
        ("a.json", '{"per_episode": [{"seed": 1, "success": "no"}]}', "neither true nor false"),
        ("a.json", "[[1, 2], [3]]", "is neither an eval_info.json"),
        ("a.json", "[1, 2]", r"must have the scores of runs \[runs, tasks\]; got float64 with the"),
        ("a.json", '{"per_task": []}', "needs scores that are finite numbers: none"),
        ("a.csv", "seed,result\n1,2\n", "has no column 'success'"),
        ("a.csv", "success\nyes\nmaybe\n", "row 1 of .*a.csv: success must be yes or no; got 'may"),
        ("a.csv", "score\n1\n\n2\ninf\n", "needs scores that are finite numbers: row 2"),
        ("a.csv", "successes,episodes\n4,3\n", "must be whole numbers from 0 to episodes"),
        ("a.npz", "no archive", "is not an archive"),
    ],
)
def test_what_is_no_table_of_scores_is_named(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=words):
        read_scores(tmp_path / name)


def test_balanced_seeds_are_students_t_of_their_means():
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(2, 6, 3, 10)) + np.array([0, 0.5])[:, None, None, None]
    seed, task, _ = np.indices(one.shape).reshape(3, -1)
    paired = clustered_mean((other - one).ravel(), seed, task)
    each = (other - one).mean(axis=(1, 2))
    wanted = stats.t.interval(0.9, 5, each.mean(), stats.sem(each))
    np.testing.assert_allclose(paired.interval(0.9), wanted)
    apart = difference(*(clustered_mean(x.ravel(), seed, task) for x in (one, other)))
    spread = [stats.sem(x.mean(axis=(1, 2))) for x in (one, other)]
    assert (apart.variance, apart.freedom) == (pytest.approx(spread[0] ** 2 + spread[1] ** 2), 5)
    # Independent episodes: the strata of a survey.
    alone = clustered_mean(one[0].ravel(), np.arange(30), np.repeat(np.arange(3), 10))
    strata = [np.var(x, ddof=1) / 10 / 9 for x in one[0]]
    assert (alone.variance, alone.freedom) == (pytest.approx(sum(strata)), 27)
    with pytest.raises(ValueError, match="an interval needs two clusters at least"):
        clustered_mean(np.ones(4), np.zeros(4, int), np.zeros(4, int))


def world(rng, seeds, tasks, episodes, gap, spread):
    """Successes [side, seed, task, episode] whose seeds are better or worse than their mean."""
    hard = rng.uniform(0.3, 0.6, tasks)
    chance = np.array([0.0, gap])[:, None, None] + hard
    chance = chance + spread * rng.uniform(-1, 1, (2, seeds, 1))
    chance = chance + spread / 2 * rng.uniform(-1, 1, (2, seeds, tasks))
    return rng.binomial(1, chance[..., None], (2, seeds, tasks, episodes)).astype(float)


def tables(won, names=(0, 1)):
    place = np.indices(won.shape[1:]).reshape(3, -1)
    keys = dict(zip(("seed", "task", "episode"), place, strict=True))
    return [
        pd.DataFrame({**keys, "score": side.ravel()}).assign(seed=keys["seed"] + 100 * name)
        for side, name in zip(won, names, strict=True)
    ]


@pytest.mark.thorough
@pytest.mark.parametrize(("seeds", "spread"), [(5, 0.15), (10, 0.15), (5, 0.0), (3, 0.1)])
def test_intervals_cover_in_1000_worlds(seeds, spread):
    rng = np.random.default_rng(seeds)
    inside, naive = np.zeros(2), 0
    for _ in range(1000):
        won = world(rng, seeds, 3, 20, 0.1, spread)
        seed, task, _ = np.indices(won.shape[1:]).reshape(3, -1)
        one, other = (side.ravel() for side in won)
        apart = difference(clustered_mean(one, seed, task), clustered_mean(other, seed, task))
        for i, mean in enumerate((apart, clustered_mean(other - one, seed, task))):
            low, high = mean.interval(0.95)
            inside[i] += low <= 0.1 <= high
        half = 1.96 * np.sqrt((one.var() + other.var()) / len(one))
        naive += abs(other.mean() - one.mean() - 0.1) <= half
    assert inside.min() >= 936  # 950, less two standard deviations.
    if spread == 0.15:
        assert naive < 800  # What pooled episodes would have said.


@pytest.mark.slow
def test_a_comparison_covers_in_1000_worlds():
    rng = np.random.default_rng(8)
    inside = np.zeros(2)
    for _ in range(1000):
        won = world(rng, 4, 2, 10, 0.1, 0.1)
        for i in (0, 1):
            found = vj.compare(*tables(won, (0, i)))
            inside[i] += found.low <= 0.1 <= found.high
            assert (found.clusters, found.by, found.paired) == (4, "seed", i == 0)
    assert inside.min() >= 936


@pytest.mark.thorough
def test_an_interval_that_holds_at_any_time_in_1000_worlds():
    rng = np.random.default_rng(1)
    wrong = 0
    for _ in range(1000):
        values = rng.beta(1, 3, 200)
        low, high = anytime_mean(values, 0.9)  # Of all numbers of values up to here.
        wrong += not low <= 0.25 <= high
    assert wrong <= 100
    low, high = anytime_mean(rng.beta(1, 3, 5000), 0.95)
    assert high - low < 0.05


def test_the_verdict_of_matched_seeds_and_what_order_adds():
    rng = np.random.default_rng(3)
    won = world(rng, 8, 2, 40, 0.3, 0.02)
    found = vj.compare(*tables(won, (0, 0)))
    assert found.verdict == "better"
    assert found.estimate == pytest.approx((won[1] - won[0]).mean())
    assert found.table["difference"].tolist() == pytest.approx(
        (won[1] - won[0]).mean(axis=(0, 2)).tolist()
    )
    assert "8 clusters of seed in pairs" in str(found)
    turned = vj.compare(*reversed(tables(won, (0, 0))), margin=0.1)
    assert (turned.verdict, turned.regression) == ("worse", True)
    assert (turned.low, turned.high) == pytest.approx((-found.high, -found.low))
    same = vj.compare(*tables(won[[0, 0]], (0, 0)), margin=0.02)
    assert same.verdict == "the same"
    ordered = vj.compare(*tables(won, (0, 0)), in_order=True)
    assert ordered.at_any_time
    assert ordered.low < found.low < found.high < ordered.high
    # Single episodes: McNemar's pairs, which may be looked at after each.
    singles = [side[["episode", "score"]] for side in tables(won[:, :1, :1], (0, 0))]
    alone = vj.compare(*singles, in_order=True)
    assert alone.by == "episode of its own"
    pairs = vj.compare_trials(
        pd.concat(
            pd.DataFrame({"pair": s["episode"], "policy": name, "failed": s["score"] == 0})
            for name, s in zip(("old", "new"), singles, strict=True)
        ), "old", "new",
    )  # fmt: skip
    assert (alone.low, alone.high) == pytest.approx((-pairs.rates.high, -pairs.rates.low))


def test_clusters_that_agree_by_chance_are_not_certain():
    won = np.ones((2, 3, 1, 4))
    found = vj.compare(*tables(won))
    assert found.low < -0.2
    assert found.high > 0.2
    assert found.verdict == "undecided"
    many = vj.compare(np.full((5, 2), 2.5), np.full((5, 2), 2.5))  # No successes, but scores.
    assert (many.low, many.high) == (0.0, 0.0)


def test_what_cannot_be_compared():
    one, other = tables(world(np.random.default_rng(0), 4, 2, 5, 0.1, 0.1), (0, 0))
    with pytest.raises(ValueError, match="the same tasks; only one of them has 1"):
        vj.compare(one, other[other["task"] == 0])
    with pytest.raises(ValueError, match="unknown column of both sides 'sead'; did you mean 'seed"):
        vj.compare(one, other, cluster="sead")
    with pytest.raises(ValueError, match="in_order needs the same episodes of both sides"):
        vj.compare(one, other[:-1], in_order=True)
    with pytest.raises(ValueError, match="in_order needs scores from 0 to 1; they go from 0 to 3"):
        vj.compare(one, other.assign(score=3 * other["score"]), in_order=True)
    with pytest.raises(ValueError, match="in_order needs all tasks in each episode of its own"):
        vj.compare(one.drop(columns="seed"), other.drop(columns="seed"), in_order=True)
    with pytest.raises(ValueError, match="margin must be a difference of scores, 0 or more"):
        vj.compare(one, other, margin=-1)
    with pytest.raises(ValueError, match="cluster and in_order are for tables of scores on both"):
        vj.compare(one, "spec.py:balance", in_order=True)
    with pytest.raises(FileNotFoundError, match=r"there is no file gone.csv of scores"):
        vj.compare("gone.csv", one)


def test_the_command_compares_files(tmp_path):
    rng = np.random.default_rng(2)
    files = [
        lerobot(tmp_path / f"{name}.json", (rng.random(200) < chance).tolist(), range(200))
        for name, chance in (("old", 0.9), ("new", 0.4))
    ]
    result = CliRunner().invoke(main, ["compare", *files, "--fail-on", "regression", "--json"])
    assert result.exit_code == 1, result.output
    found = json.loads(result.stdout)
    assert (found["verdict"], found["by"], found["clusters"]) == ("worse", "seed", 200)
    assert found["paired"]
    assert found["high"] < -0.3
    result = CliRunner().invoke(main, ["compare", *files, files[0]])
    assert result.exit_code == 2
    assert "a table of scores is compared with one other table" in result.output


DISTURBED = {"a": vj.Box(0.0, 0.8)}


@pytest.mark.slow
def test_a_matched_arm_without_disturbances_says_what_makes_the_difference():
    def loop(gain, name):
        system = vj.ode(
            lambda time, state, control, features: {"x": control["u"]},
            lambda features, key: {"x": features["a"]},
            controller=lambda time, state, features: {"u": -gain * state["x"]},
            dt=0.1, duration=1.0,
        )  # fmt: skip
        problem = vj.Problem(name, DISTURBED, system, "always x <= 0.9", nominal={"a": 0.5})
        return problem.with_faults(
            vj.faults.Bias("x", offset=vj.Box(-1, 1), duration=vj.Box(0, 1), name="bias")
        )

    found = vj.compare(loop(1.0, "slow"), loop(9.0, "fast"), budget=4000)
    one = found.candidates[0]
    rates, first, second = one.undisturbed
    assert (first, second) == (0, 0)  # Without the fault neither of them fails.
    assert rates.pairs == one.rates.pairs
    assert found.simulations == 4 * one.rates.pairs
    assert one.rates.only_second > 0
    assert "without disturbances it fails in 0 % of the same pairs" in str(found)
    plain = vj.compare(loop(1.0, "slow"), loop(9.0, "fast"), budget=4000, undisturbed=False)
    assert plain.candidates[0].undisturbed is None
    both = min(plain.candidates[0].rates.pairs, one.rates.pairs)
    assert plain.candidates[0].pairs[:both].equals(one.pairs[:both])
