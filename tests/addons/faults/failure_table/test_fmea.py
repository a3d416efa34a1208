"""The failure table against closed forms: redundant sensors, a voter, a single channel."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.addons import faults
from verifai_jax.addons.faults.failure_table import Effect, FailureTable, _fmea, rows

END = 1.0
"""Seconds of a simulation: ten samples, so that a duration counts in tenths."""


def redundant(vote):
    """A controller that hands out what it makes of sensors, which should all read 1."""
    return vj.ode(
        lambda time, state, control, features: {name: jnp.zeros(()) for name in state},
        lambda features, key: {name: jnp.ones(()) for name in ("a", "b", "c", "single")},
        controller=lambda time, state, features: {
            "voted": vote(state) + features["extra"], "level": state["single"]
        },
        dt=0.1,
        duration=END,
    )  # fmt: skip


def problem(vote, spec):
    space = {"extra": vj.Box(-0.1, 0.1)}
    return vj.Problem("redundant", space, redundant(vote), spec, nominal={"extra": 0.0})


def dropouts(*names):
    return [faults.Dropout(name, duration=vj.Box(0, 2)) for name in names]


def stuck():
    return faults.Bias("single", offset=vj.Box(0, 4), duration=vj.Box(0, END))


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Either of two sensors is enough; a third channel has no second one."""
    both = problem(
        lambda s: jnp.maximum(s["a"], s["b"]),
        {"voted": "always voted >= 0.5", "level": "always level <= 2"},
    )
    options = {"rate": {"a_dropout": 0.2, "b_dropout": 0.1, "single_bias": 0.05}}
    return vj.fmea(
        both, [*dropouts("a", "b"), stuck()], **options, mission_time=10.0, samples=600,
        budget=200, seed=1, folder=tmp_path_factory.mktemp("fmea"), progress=False,
    )  # fmt: skip


@pytest.mark.slow
def test_what_has_no_second_is_named_and_so_is_the_pair(table):
    assert [each.name for each in table if each.fails] == ["a_dropout + b_dropout", "single_bias"]
    assert table.healthy
    # Both are off at the first sample, however short.
    pair = table["a_dropout + b_dropout"]
    happen = (1 - np.exp(-2.0)) * (1 - np.exp(-1.0))
    assert pair.occurrence == pytest.approx(happen)
    assert pair.low <= happen <= pair.high
    single = table["single_bias"]
    truth = (1 - np.exp(-0.5)) * 0.75
    assert single.low <= truth <= single.high
    assert single.severity["single_bias.offset"] == pytest.approx(1.0, abs=0.01)
    assert single.broken == "level"
    assert (single.delay, single.shown_by, single.shown_after) == (0.0, "level", 0.0)


@pytest.mark.slow
def test_each_failure_is_confirmed_and_replayed(table, tmp_path):
    for each in table:
        if each.fails:
            assert each.verdict == "confirmed"
            assert table.replay(each.name).violated
            assert each.command.startswith("vj.load(")
        else:
            assert each.row is None
            assert each.probability == 0.0
            assert each.high > 0
    table.to_csv(tmp_path / "fmea.csv")
    again = pd.read_csv(tmp_path / "fmea.csv", index_col="fault")
    assert list(again.index) == [each.name for each in table]
    assert "single_bias" in table._repr_html_()
    assert "breaks level" in str(table)
    table.plot(tmp_path / "fmea.png")
    with pytest.raises(ValueError, match="a_dropout has no counterexample"):
        table.replay("a_dropout")
    with pytest.raises(ValueError, match="unknown row of the failure table"):
        table["gyro"]


@pytest.mark.slow
def test_it_goes_on_where_it_was_cut_off(tmp_path, monkeypatch):
    one = problem(lambda s: jnp.minimum(s["a"], s["b"]), "always voted >= 0.5")
    options = {"samples": 100, "budget": 0, "pairs": False, "progress": False, "folder": tmp_path}
    first = vj.fmea(one, dropouts("a", "b"), **options)
    assert [each.fails for each in first] == [True, True]
    with monkeypatch.context() as patch:
        # Finished work is read: the samples, and the counterexamples as a run.
        patch.setattr(_fmea, "simulate", None)
        again = vj.fmea(one, dropouts("a", "b"), **options)
    pd.testing.assert_frame_equal(again.table, first.table)
    with pytest.raises(ValueError, match="holds a different fmea: samples is 50, in the cache 100"):
        vj.fmea(one, dropouts("a", "b"), **{**options, "samples": 50})


@pytest.mark.slow
def test_work_that_ctrl_c_cuts_short_is_not_kept(tmp_path, monkeypatch):
    one = problem(lambda s: jnp.maximum(s["a"], s["b"]), "always voted >= 0.5")
    options = {"samples": 50, "budget": 64, "pairs": False, "progress": False}
    with monkeypatch.context() as patch:
        cut = lambda *a, **k: replace(vj.falsify(*a, **k), stopped="interrupted")  # noqa: E731
        patch.setattr(rows, "falsify", cut)
        with pytest.raises(KeyboardInterrupt):
            vj.fmea(one, dropouts("a"), **options, folder=tmp_path)
    searches = []
    watched = lambda *a, **k: searches.append(a) or vj.falsify(*a, **k)  # noqa: E731
    monkeypatch.setattr(rows, "falsify", watched)
    vj.fmea(one, dropouts("a"), **options, folder=tmp_path)
    assert len(searches) == 1


@pytest.mark.proves
def test_probabilities_of_a_voter_lie_in_their_intervals():
    """Two of three: a pair fails if both are off by more than the threshold at one sample."""
    voter = problem(
        lambda s: jnp.median(jnp.stack([s["a"], s["b"], s["c"]])), "always voted <= 1.6"
    )
    made = [faults.Bias(n, offset=vj.Box(0, 1), duration=vj.Box(0, 2)) for n in "abc"]
    inside = 0
    for seed in range(20):
        found = vj.fmea(voter, made, samples=400, budget=0, seed=seed, progress=False)
        assert {each.name for each in found if each.fails} == {
            "a_bias + b_bias", "a_bias + c_bias", "b_bias + c_bias"
        }  # fmt: skip
        pair = found["a_bias + b_bias"]
        inside += pair.low <= 0.4**2 <= pair.high
    assert inside >= 19


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate": 1.0}, "rate .in an hour. and mission_time .in hours. go together"),
        ({"rate": -1.0, "mission_time": 1.0}, "rate of fault 'a_dropout' must be a number of occ"),
        (
            {"rate": {"a": 1.0}, "mission_time": 1.0},
            "unknown fault 'a'. Known: a_dropout, b_dropout",
        ),
        ({"rate": 1.0, "mission_time": -1.0}, "mission_time must be a number of hours"),
        ({"samples": 0}, "samples must be an integer of at least 1"),
    ],
)
def test_bad_options(options, words):
    one = problem(lambda s: s["a"], "always voted >= 0.5")
    with pytest.raises(ValueError, match=words):
        vj.fmea(one, dropouts("a", "b"), **options)


def test_faults_that_cannot_be_off_are_refused():
    one = problem(lambda s: s["a"], "always voted >= 0.5")
    always = faults.Stuck("a", value=vj.Box(0, 1))
    with pytest.raises(
        ValueError, match=r"fault 'a_stuck' cannot be switched off, not even at its weakest \(value"
    ):
        vj.fmea(one, [always])
    with pytest.raises(ValueError, match="fmea takes faults one by one; 'fault' is AtMost"):
        vj.fmea(one.with_faults(faults.AtMost(1, dropouts("a", "b"))))
    with pytest.raises(ValueError, match="problem 'redundant' has no faults that vary"):
        vj.fmea(one)


@pytest.mark.slow
def test_the_report_names_each_row_with_its_command(table, tmp_path):
    page = table.report(tmp_path / "table.html").read_text()
    claims = json.loads((tmp_path / "table.claims.json").read_text())["claims"]
    for effect, claim in zip(table, claims, strict=True):
        assert effect.name in page
        assert effect.name in claim["claim"]
    assert (
        table["single_bias"].command
        in claims[[e.name for e in table].index("single_bias")]["evidence"]
    )
    assert "2 of 4 faults and pairs break the property; 2 of these are confirmed." in page


@pytest.mark.thorough
def test_the_report_on_a_table_without_a_failure(tmp_path):
    effect = Effect(("gyro_dropout",), False, 0, 512, probability=0.0, high=0.006)
    empty = FailureTable("balance", (effect,), None, None, None, 0.95, True, 1.0)
    page = empty.report(tmp_path / "empty.html").read_text()
    assert "No failure by gyro_dropout was found" in page
    assert "given that it happens" in page
    assert "0 of 1 faults and pairs break the property" in page


def test_the_headline_counts_failures_that_closer_replays_refute():
    sure = Effect(("a",), True, 9, 512, verdict="confirmed", row=0, probability=0.02)
    thin = replace(sure, faults=("b",), verdict="refuted", row=1)
    whole = FailureTable("balance", (sure, thin), None, None, None, 0.95, True, 1.0)
    assert "2 of 2 faults and pairs break the property, 1 of them in closer replays" in str(whole)
    alone = replace(whole, effects=(sure,))
    assert "1 of 1 faults and pairs break the property; probabilities" in str(alone)
