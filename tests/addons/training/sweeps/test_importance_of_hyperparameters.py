from itertools import product

import numpy as np
import pandas as pd
import pytest
from sklearn.ensemble import ExtraTreesRegressor

import verifai_jax as vj
from verifai_jax.addons.training.sweeps.fanova import Boxes, leaf_boxes, variance_shares
from verifai_jax.addons.training.sweeps.importance import hyperparameter_importance, trends

SPACE = vj.FeatureSpace(
    {
        "learning_rate": vj.LogUniform(1e-4, 1e-2),
        "discount": vj.Box(0.9, 0.999),
        "algorithm": vj.Categorical("ppo", "sac", "dqn"),
        "width": vj.Categorical(32, 64),
        "environments": vj.DiscreteBox(4, 8),
    }
)


def made(configurations, failing, returns, seed=0, checkpoints=(1000,)):
    """A table of configurations drawn from `SPACE`, safety by functions of the unit coordinates."""
    rng = np.random.default_rng(seed)
    rows = []
    for number in range(configurations):
        u = rng.random(5)
        values = {
            "learning_rate": 1e-4 * 100 ** u[0],
            "discount": 0.9 + 0.099 * u[1],
            "algorithm": ["ppo", "sac", "dqn"][int(3 * u[2])],
            "width": [32, 64][int(2 * u[3])],
            "environments": 4 + int(5 * u[4]),
        }
        for steps in checkpoints:
            rate = failing(u, steps)
            rows.append(
                {
                    "configuration": number,
                    "seed": 0,
                    "steps": steps,
                    **values,
                    "failure_rate": rate,
                    "nominal_return": returns(u, steps),
                    "verdict": "safe@0.01" if rate < 0.2 else "unsafe",
                }
            )
    return pd.DataFrame(rows)


@pytest.fixture(scope="module")
def planted():
    """Failing depends on the learning rate and somewhat on the algorithm, return on discount."""
    table = made(
        80,
        lambda u, steps: 0.8 * (u[0] > 0.5) + 0.2 * (int(3 * u[2]) == 1),
        lambda u, steps: 500 * u[1],
    )
    return hyperparameter_importance(table, list(SPACE.domains), SPACE, name="planted", repeats=3)


@pytest.mark.proves
def test_what_was_planted_is_found(planted):
    failing = planted.table["failure_rate"].sort_values(ascending=False)
    assert list(failing.index[:2]) == ["learning_rate", "algorithm"]
    assert failing.iloc[2:].abs().max() < 0.05
    assert planted.ranking[0] == "learning_rate"
    assert planted.table["nominal_return"].idxmax() == "discount"
    assert planted.is_reliable("failure_rate")
    assert planted.is_reliable("nominal_return")
    # 0.8^2 / 4 against 0.2^2 * 2 / 9: the learning rate has 95 % of the variance.
    assert planted.table.loc["learning_rate", "failure_rate_total"] == pytest.approx(0.95, abs=0.08)
    assert planted.table.loc["discount", "nominal_return_first"] > 0.9
    text = str(planted)
    assert text.startswith("failing depends on learning_rate (9")
    assert "return depends on discount" in text


@pytest.mark.slow
def test_components_of_the_unsafe_and_the_safe(planted):
    # The learning rate is confined to one half of its range in both, so others vary more.
    for components in (planted.unsafe, planted.safe):
        assert set(components.names) == {"learning_rate", "discount", "width", "environments"}
        place = components.names.index("learning_rate")
        assert abs(components.directions[0][place]) < 0.3
    assert planted.unsafe.pivot[place] > 0.6
    assert planted.safe.pivot[place] < 0.3
    assert "unsafe configurations vary most along" in str(planted)


@pytest.mark.slow
def test_checkpoints_count_as_training_set_size():
    table = made(
        12,
        lambda u, steps: float(steps < 2000),
        lambda u, steps: u[0],
        checkpoints=(1000, 2000, 4000),
    )
    found = hyperparameter_importance(table, list(SPACE.domains), SPACE, repeats=2)
    assert found.table["failure_rate"].idxmax() == "steps"
    assert found.table.loc["steps", "failure_rate_total"] > 0.9


@pytest.mark.thorough
def test_lengths_of_trainings_may_be_swept_with_checkpoints_before_their_ends():
    space = vj.FeatureSpace({**SPACE.domains, "steps": vj.Categorical(2000, 4000)})
    table = made(
        12, lambda u, steps: u[0], lambda u, steps: steps / 10, checkpoints=(1000, 2000, 4000)
    )
    found = hyperparameter_importance(table, list(space.domains), space, repeats=2)
    assert found.table["nominal_return"].idxmax() == "steps"


@pytest.mark.thorough
def test_noise_is_not_explained():
    noise = np.random.default_rng(5)
    table = made(40, lambda u, steps: noise.random(), lambda u, steps: 500.0)
    found = hyperparameter_importance(table, list(SPACE.domains), SPACE)
    assert not found.is_reliable("failure_rate")
    assert "failing: a model of these 40 configurations does not predict others" in str(found)
    assert "no single one correlates with it beyond chance" in str(found)
    assert "return: it is 500 for every policy" in str(found)


@pytest.mark.thorough
def test_a_trend_shows_where_no_model_can_be_learned():
    noise = np.random.default_rng(1)
    table = made(30, lambda u, steps: 0.6 * u[1] + noise.random(), lambda u, steps: -u[0])
    found = hyperparameter_importance(table, list(SPACE.domains), SPACE, repeats=2)
    assert found.scores["failure_rate"] < 0.4
    found.scores["failure_rate"] = 0.0
    assert found.table.loc["discount", "failure_rate_trend"] > found.chance["failure_rate"]
    assert "rank correlations beyond chance: discount (+0." in str(found)
    assert found.table.loc["learning_rate", "nominal_return_trend"] == pytest.approx(-1.0)
    assert np.isnan(found.table.loc["algorithm", "nominal_return_trend"])


def test_trends_are_those_of_scipy_and_chance_is_rarely_beaten():
    from scipy.stats import spearmanr

    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 5, (40, 3)).astype(float), rng.integers(0, 9, 40).astype(float)
    correlation, chance = trends(x, y, np.arange(40))
    assert correlation == pytest.approx([spearmanr(c, y).statistic for c in x.T])
    # Rows of a group count once.
    again, _ = trends(np.repeat(x, 2, 0), np.repeat(y, 2), np.repeat(np.arange(40), 2))
    assert again == pytest.approx(correlation)
    assert np.isnan(trends(np.ones((9, 1)), y[:9], np.arange(9))[0]).all()
    beaten = []
    for _ in range(100):
        unrelated, chance = trends(rng.random((20, 5)), rng.random(20), np.arange(20))
        beaten.append(np.abs(unrelated).max() > chance)
    assert np.sum(beaten) <= 11  # 5 are expected; more than 11 come in 1 of 200.


@pytest.mark.thorough
def test_too_few_configurations_are_admitted():
    table = made(6, lambda u, steps: u[0], lambda u, steps: u[1], checkpoints=(1, 2, 3))
    found = hyperparameter_importance(table, list(SPACE.domains), SPACE)
    assert found.scores == {}
    assert "failing: 6 configurations with a verdict, too few to learn from (at least 10)" in str(
        found
    )
    with pytest.raises(ValueError, match="nothing to draw: failing: 6 configurations"):
        found.plot()


@pytest.mark.thorough
def test_columns_without_a_space_and_with_gaps():
    table = made(60, lambda u, steps: float(u[2] > 0.6), lambda u, steps: 1.0)
    table["clip"] = np.where(table["algorithm"] == "ppo", 0.2 + 0.001 * table.index, np.nan)
    found = hyperparameter_importance(table, [*SPACE.domains, "clip"], None)
    assert found.table["failure_rate"].idxmax() == "algorithm"


def on_grid(forest, dimensions):
    """First-order and total shares of a forest by summing over all the cells it tells apart."""
    cuts = [[0.0, 1.0] for _ in range(dimensions)]
    for tree in forest.estimators_:
        for j, at in zip(tree.tree_.feature, tree.tree_.threshold, strict=True):
            if j >= 0:
                cuts[j].append(at)
    cuts = [np.unique(edges) for edges in cuts]
    middles = [(edges[1:] + edges[:-1]) / 2 for edges in cuts]
    weights = np.prod(np.array(list(product(*[np.diff(edges) for edges in cuts]))), axis=1).reshape(
        [len(m) for m in middles]
    )
    values = forest.predict(np.array(list(product(*middles)))).reshape(weights.shape)
    mean = (weights * values).sum()
    variance = (weights * (values - mean) ** 2).sum()

    def explained(known):
        rest = tuple(j for j in range(dimensions) if j not in known)
        mass = weights.sum(axis=rest, keepdims=True)
        given = (weights * values).sum(axis=rest, keepdims=True) / mass
        return (mass * (given - mean) ** 2).sum() / variance

    everything = set(range(dimensions))
    first = [explained({j}) for j in range(dimensions)]
    total = [1 - explained(everything - {j}) for j in range(dimensions)]
    return np.array(first), np.array(total), variance


def test_shares_are_those_of_a_sum_over_all_cells():
    rng = np.random.default_rng(3)
    x = rng.random((60, 3))
    y = np.sin(4 * x[:, 0]) * x[:, 1] + 0.5 * (x[:, 2] > 0.5)
    forest = ExtraTreesRegressor(n_estimators=3, max_leaf_nodes=12, random_state=0).fit(x, y)
    shares = variance_shares(leaf_boxes(forest, [None] * 3))
    first, total, variance = on_grid(forest, 3)
    # scikit-learn rounds the inputs to float32, which moves no cell's middle across a cut.
    assert shares.first == pytest.approx(first, abs=1e-9)
    assert shares.total == pytest.approx(total, abs=1e-9)
    assert shares.variance == pytest.approx(variance)


def test_an_interaction_alone_has_no_first_order_share():
    corners = [([a, b], [a + 0.5, b + 0.5], 1.0 if a == b else -1.0)
               for a in (0.0, 0.5) for b in (0.0, 0.5)]  # fmt: skip
    low, high, value = (np.array(part) for part in zip(*corners, strict=True))
    shares = variance_shares(Boxes(low, high, value))
    assert shares.first == pytest.approx([0, 0], abs=1e-12)
    assert shares.total == pytest.approx([1, 1])
    assert shares.variance == pytest.approx(1.0)


def test_a_constant_has_no_shares():
    shares = variance_shares(Boxes(np.zeros((1, 2)), np.ones((1, 2)), np.array([3.0])))
    assert np.isnan(shares.first).all()
    assert shares.variance == 0


def test_cuts_between_cells_move_to_their_edges():
    x = np.array([[0.1]] * 5 + [[0.6]] * 5)  # Middles of cells [0, 0.2] and [0.2, 1].
    forest = ExtraTreesRegressor(n_estimators=1, random_state=0).fit(x, x[:, 0] > 0.5)
    boxes = leaf_boxes(forest, [np.array([0.0, 0.2, 1.0])])
    assert variance_shares(boxes).variance == pytest.approx(0.2 * 0.8)
