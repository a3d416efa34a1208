"""The arguments of the verbs: few, the same words everywhere, checked where they are given."""

import inspect
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj

VERBS = (
    "augment", "certify", "compare", "confirm", "estimate", "explain", "falsify", "fmea", "fuzz",
    "harden", "modes", "real_trials", "repair", "resume", "sequence", "shrink", "simulate", "sweep",
    "synthesize", "transfer", "verify",
)  # fmt: skip
JOINED = {
    "after", "attack_simulations", "backend", "engine", "executor", "keep_going", "max_seconds",
    "stop_after", "stop_when", "target", "warm_start",
}  # fmt: skip


def constant(f, key):
    return vj.Trace({"x": f["x"] * np.ones(3, np.float32)}, dt=1.0)


PROBLEM = vj.Problem("flat", vj.FeatureSpace({"x": vj.Box(0, 1)}), constant, "always x <= 0.9")


@pytest.mark.addons
@pytest.mark.parametrize("verb", VERBS)
def test_verbs_take_few_arguments_and_share_their_words(verb):
    arguments = set(inspect.signature(getattr(vj, verb)).parameters)
    assert len(arguments) <= (12 if verb == "falsify" else 15)
    assert not arguments & JOINED


@pytest.mark.addons
@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: vj.Stop(after=0), ValueError, "after must be an integer of at least 1; got 0"),
        (lambda: vj.Stop(seconds=0), ValueError, "seconds must be positive; got 0"),
        (lambda: vj.Stop(when=0.05), TypeError, r"a rule such as Within\(0.005\); got 0.05"),
        (lambda: vj.RunOn(engine="nativ"), ValueError, "engine 'nativ'; did you mean 'native'"),
        (lambda: vj.RunOn(executor=3), TypeError, "executor must have concurrent.futures' submit"),
        (lambda: vj.Certification(confidence=95), ValueError, "confidence must lie between 0 and"),
        (lambda: vj.Certification(samples=0), ValueError, "samples must be an integer of at least"),
        (
            lambda: vj.Certification(attack_simulations=1.5),
            ValueError,
            "attack_simulations must be an integer of at least 0; got 1.5",
        ),
        (lambda: vj.FurtherTraining(own=0.6, failing=0.6), ValueError, "shares of all episodes"),
        (lambda: vj.Aim(margin=-1.0), ValueError, "margin must be a robustness of at least 0"),
        (lambda: vj.Aim(held_out=-1), ValueError, "held_out must be an integer of at least 0"),
        (lambda: vj.Aim("robustnes"), ValueError, "did you mean 'robustness'"),
        (
            lambda: vj.Start(rows=[{"x": 0.1}], cheap=PROBLEM),
            ValueError,
            "give either rows, or a cheap model",
        ),
    ],
)
def test_a_value_is_checked_when_it_is_made(make, error, message):
    with unchecked(), pytest.raises(error, match=message):
        make()


def test_a_pool_that_forks_is_refused_when_it_is_named():
    import multiprocessing

    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork"))
    with pool, pytest.raises(ValueError, match="forks this process"):
        vj.RunOn(executor=pool)


@pytest.mark.addons
def test_a_verb_refuses_what_it_does_not_use():
    with pytest.raises(ValueError, match=r"does not use after= of vj.Stop; it uses seconds="):
        vj.estimate(PROBLEM, stop=vj.Stop(after=1))
    with pytest.raises(ValueError, match=r"compare does not use engine= of vj.RunOn"):
        vj.compare(PROBLEM, PROBLEM, run_on=vj.RunOn(engine="native"))
    with pytest.raises(ValueError, match=r"resume does not use backend= of vj.RunOn"):
        vj.resume("nowhere", PROBLEM, run_on=vj.RunOn(backend="mjx"))


def test_a_problem_keeps_its_target_in_what_is_derived_from_it(tmp_path):
    named = vj.Problem("flat", PROBLEM.space, constant, "always x <= 0.9", target="specs/f.py:flat")
    assert named.only("x").target == named.target
    run = vj.falsify(named, "uniform", 8, folder=tmp_path / "run", progress=False)
    assert run.target == vj.load(tmp_path / "run", PROBLEM).target == "specs/f.py:flat"
    again = vj.resume(tmp_path / "run", PROBLEM, budget=12, progress=False)
    assert again.target == "specs/f.py:flat"


@pytest.mark.slow
@pytest.mark.addons
def test_an_archive_of_failures_has_room_for_those_that_are_wanted():
    stop = vj.Stop(after=300)
    run = vj.falsify(PROBLEM, vj.search.Diverse(capacity=20), 16, stop=stop, progress=False)
    assert "capacity=300" in run.search
    assert run.batch <= 16


@dataclass(frozen=True)
class Around(vj.search.Wrapper):
    """A search around another one that no package registers."""

    search: vj.search.Search


@pytest.mark.slow
@pytest.mark.addons
def test_names_of_searches_around_others():
    assert vj.search.named("diverse") == vj.search.Diverse(vj.search.Portfolio())
    assert vj.search.named("likeliest") == vj.search.Likeliest(vj.search.CrossEntropy())
    assert {"diverse", "likeliest"} <= set(vj.search.names())
    rows = vj.falsify(PROBLEM, "diverse", 40, progress=False).table.all
    told = vj.falsify(PROBLEM, vj.search.Diverse(), 40, progress=False).table.all
    assert rows.equals(told)
    inner = {"name": "cross_entropy", "options": vars(vj.search.CrossEntropy())}
    described = vj.search.to_json(vj.search.Likeliest())
    assert described == {"name": "likeliest", "options": {"search": inner}}
    own = Around(vj.search.Uniform())
    assert vj.search.to_json(own) is vj.search.to_json(vj.search.Diverse(own)) is None
