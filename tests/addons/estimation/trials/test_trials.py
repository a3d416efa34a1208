"""Real trials: the rate in reality by trials and simulations, pairs of policies, protocols."""

import json

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

import verifai_jax as vj


def brake(features, key):
    times = jnp.arange(50) * 0.1
    gap = 40 - features["speed"] * times + 0.5 * features["brake"] * times**2
    return vj.Trace({"gap": gap}, dt=0.1)


PROBLEM = vj.Problem(
    "brake",
    {"speed": vj.Normal(20.0, 5.0), "brake": vj.Box(4.0, 9.0)},
    brake,
    "always gap > 0",
)


def fails(row, worn=0.93):
    return 40 - row.speed**2 / (2 * row.brake * worn) < 0


def made(sheet, **options):
    return sheet.assign(failed=[fails(row, **options) for row in sheet.itertuples()])


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    path = tmp_path_factory.mktemp("trials") / "sheet.html"
    return made(vj.trial_protocol(PROBLEM, path, 60, seed=3))


@pytest.fixture(scope="module")
def found(trials):
    return vj.real_trials(PROBLEM, trials, simulations=4000)


@pytest.mark.thorough
class TestRealTrials:
    @pytest.mark.slow
    def test_the_rate_is_that_of_reality(self, found):
        rng = np.random.default_rng(0)
        drawn = pd.DataFrame(
            {"speed": rng.normal(20, 5, 100_000), "brake": rng.uniform(4, 9, 100_000)}
        )
        truth = made(drawn)["failed"].mean()
        assert found.rate.low < truth < found.rate.high
        assert found.rate.worth > 1.5 * found.rate.trials
        assert found.simulated.estimate < truth

    @pytest.mark.slow
    def test_the_summary_is_made_of_the_counts(self, found, trials):
        text = str(found)
        assert f"60 real trials, {trials['failed'].sum()} failed" in text
        assert f"{len(found.wrong)} predictions, at a simulated robustness of" in text
        assert len(found.wrong) == np.sum(found.table["predicted"] != trials["failed"])
        assert found.predictions(True).simulations == found.table["predicted"].sum()

    def test_the_next_trials_are_drawn_from_both_sides_safest_first(self, found):
        chosen = found.next_trials(20)
        assert len(chosen) == 20
        assert chosen["robustness"].is_monotonic_decreasing
        # Predictions of success are the ones that were wrong.
        assert (~chosen["predicted"]).sum() > 10

    def test_few_wrong_predictions_make_no_rules(self, found):
        assert "rules need 10" in str(found.rules())

    def test_other_features_than_those_of_the_problem_are_noted(self, trials):
        fast = vj.real_trials(PROBLEM, trials.assign(speed=trials["speed"] / 2 + 25))
        assert any("speed of the trials is distributed otherwise" in n for n in fast.notes)

    def test_recordings_are_judged(self, tmp_path, trials):
        table = trials.head(3).drop(columns="failed")
        for number, gap in enumerate(([5, 1, 2], [5, -1, 2])):
            pd.DataFrame({"time": [0.0, 0.1, 0.2], "gap": gap}).to_csv(
                tmp_path / f"{number}.csv", index=False
            )
        pd.DataFrame({"time": [0.0, 0.1], "other": [1, 2]}).to_csv(tmp_path / "2.csv", index=False)
        table = table.assign(recording=[f"{number}.csv" for number in range(3)])
        table.to_csv(tmp_path / "table.csv", index=False)
        judged = vj.real_trials(PROBLEM, tmp_path / "table.csv", simulations=4000)
        assert list(judged.table["failed"]) == [False, True, None]
        assert any("1 recording without a verdict" in note for note in judged.notes)
        assert ", 1 undecided" in str(judged)

    @pytest.mark.slow
    def test_command(self, tmp_path, monkeypatch, trials):
        from verifai_jax.cli.main import main

        monkeypatch.chdir(tmp_path)
        trials.to_csv("made.csv", index=False)
        (tmp_path / "model.py").write_text(
            "import jax.numpy as jnp\nimport verifai_jax as vj\n"
            "def system(f, key):\n    return vj.Trace({'gap': f['speed'][None]}, dt=1.0)\n"
            "brake = vj.Problem('brake', {'speed': vj.Box(0.0, 40.0)}, system, 'gap < 30')\n"
        )
        arguments = ["trials", "model.py:brake", "made.csv", "--next", "3", "--json"]
        done = CliRunner().invoke(main, [*arguments, "--sheet", "next.html"])
        assert done.exit_code == 0, done.output
        result = json.loads(done.stdout)
        assert result["rate"]["trials"] == 60
        assert len(result["next"]) == 3
        assert len(pd.read_csv("next.csv")) == 3
        assert "give a file of trials" in CliRunner().invoke(main, arguments[:2]).output


class TestTables:
    def test_what_is_missing_is_named(self, trials, tmp_path):
        with pytest.raises(ValueError, match=r"'failed'.*this table has speed, brake"):
            vj.real_trials(PROBLEM, trials[["speed", "brake"]])
        with pytest.raises(ValueError, match="has no column 'brake'"):
            vj.real_trials(PROBLEM, trials.drop(columns="brake"))
        with pytest.raises(ValueError, match=r"row 0: failed must be yes or no.*got 'perhaps'"):
            vj.real_trials(PROBLEM, trials.assign(failed="perhaps"))
        with pytest.raises(FileNotFoundError, match=r"no file .*absent\.csv of trials"):
            vj.real_trials(PROBLEM, tmp_path / "absent.csv")
        with pytest.raises(ValueError, match="has no rows"):
            vj.real_trials(PROBLEM, trials.head(0))


class TestPolicies:
    def test_a_blinded_comparison(self, tmp_path):
        sheet = vj.trial_protocol(PROBLEM, tmp_path / "p.html", 60, policies=("old", "new"))
        assert (sheet.groupby("pair")["speed"].nunique() == 1).all()
        assert set(sheet["policy"]) == {"A", "B"}
        page = (tmp_path / "p.html").read_text()
        assert "always (gap &gt; 0)" in page
        assert "old" not in page
        codes = pd.read_csv(tmp_path / "p_key.csv").set_index("code")["policy"]
        wear = {"old": 0.5, "new": 0.9}
        verdicts = [fails(row, wear[codes[row.policy]]) for row in sheet.itertuples()]
        result = vj.compare_trials(
            sheet.assign(failed=verdicts), "old", "new", key=tmp_path / "p_key.csv"
        )
        assert result.verdict == "better"
        assert result.rates.only_second == 0
        assert str(result).startswith("new is BETTER than old")

    def test_undecided_says_how_many_more(self):
        pairs = pd.DataFrame(
            {"pair": [1, 1, 2, 2], "policy": ["a", "b"] * 2, "failed": ["yes", "no", "no", ""]}
        )
        result = vj.compare_trials(pairs, "a", "b")
        assert (result.verdict, result.rates.undecided) == ("undecided", 1)
        assert result.pairs_to_go > 2
        assert f"about {result.pairs_to_go} more pairs" in str(result)

    def test_wrong_tables_are_refused(self):
        pairs = pd.DataFrame({"pair": [1, 1], "policy": ["a", "a"], "failed": ["yes", "no"]})
        with pytest.raises(ValueError, match="policy 'b'"):
            vj.compare_trials(pairs, "a", "b")
        with pytest.raises(ValueError, match="pair 1 has the policy 'a' twice"):
            vj.compare_trials(pairs, "a", "a")
        with pytest.raises(ValueError, match="two policies; got one"):
            vj.trial_protocol(PROBLEM, "x.html", policies=("one",))


@pytest.mark.thorough
class TestCalibration:
    @pytest.mark.slow
    def test_the_wear_of_the_brakes_is_found(self, trials):
        def worn(features, key):
            return brake({**features, "brake": features["wear"] * features["brake"]}, key)

        space = {**PROBLEM.space.domains, "wear": vj.Box(0.5, 1.5)}
        problem = vj.Problem("worn", space, worn, "always gap > 0")
        found = vj.calibrate(problem, trials, ["wear"], simulations=6000)
        low, high = found.samples["wear"].quantile([0.025, 0.975])
        assert low < 0.93 < high
        assert high - low < 0.3
        assert "unexplained  0 trials" in str(found)
        assert isinstance(found.problem.space.domains["wear"], vj.Empirical)
        with pytest.raises(ValueError, match="1,200 simulations for 60 trials"):
            vj.calibrate(problem, trials, ["wear"], simulations=500)
        with pytest.raises(ValueError, match="wore"):
            vj.calibrate(problem, trials, ["wore"])
