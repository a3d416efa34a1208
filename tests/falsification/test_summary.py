"""Every number that a summary or the title of a picture states, read back from the table."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.cli.json_output import describe_run
from verifai_jax.counterexamples.selection import select_row
from verifai_jax.evaluation import confirmer
from verifai_jax.evaluation.confirmations import UNDECIDED, VERDICTS
from verifai_jax.pictures.robustness_history import plot_robustness_history
from verifai_jax.pictures.scatter import plot_features
from verifai_jax.systems.base import System

SPACE = {"a": vj.Box(0.0, 1.0), "b": vj.Box(-1.0, 1.0)}


def constant(value):
    """Return a system whose one signal is constant, as a function of the features says."""
    return lambda features, key: vj.Trace({"x": value(features) * jnp.ones(4)}, dt=0.1)


def raising(at_least):
    def simulate(features):
        if features["a"] >= at_least:
            raise RuntimeError("out of fuel")
        return vj.Trace({"x": np.full(4, features["a"])}, dt=0.1)

    return vj.blackbox(simulate)


decay = vj.ode(
    lambda time, x, control, features: -8.0 * (1 + features["a"]) * x,
    lambda features, key: features["b"],
    signals=lambda time, x, control, features: {"x": x},
    duration=1.0,
    dt=0.1,
    method="euler",
)


class Breaking(System):
    """A system of which no finer step can be simulated."""

    def __init__(self, factor=1):
        self.factor = factor

    def __call__(self, features, key=None):
        if self.factor > 1:
            raise RuntimeError("too fine")
        return vj.Trace({"x": features["a"] * jnp.ones(4)}, dt=0.1)

    def refined(self, factor):
        return Breaking(factor)


rounded = constant(lambda f: (f["a"] + 2.0**20) - 2.0**20)
TWO = {"low": "always x >= 0.1", "high": "always x <= 0.7"}

GALLERY = {
    "some fail": (constant(lambda f: f["a"]), "always x <= 0.6"),
    "none fails": (constant(lambda f: f["a"]), "always x <= 2"),
    "all fail": (constant(lambda f: f["a"]), "always x < 0"),
    "several formulas": (constant(lambda f: f["a"]), TWO),
    "a third is not finite": (
        constant(lambda f: jnp.where(f["a"] > 0.66, jnp.nan, f["a"])),
        "always x <= 0.3",
    ),
    "nothing is finite": (constant(lambda f: jnp.nan * f["a"]), "always x <= 0.3"),
    "coarse steps": (decay, "always x >= -0.35"),
    "coarse numbers": (rounded, "always x <= 0.5"),
    "replays that raise": (Breaking(), "always x <= 0.5"),
    "mostly not replayed": (rounded, "always x <= 0.5"),
    "a black box": (raising(2.0), "always x <= 0.5"),
    "a black box that raises": (raising(0.7), "always x <= 0.5"),
    "a black box that only raises": (raising(-1.0), "always x <= 0.5"),
}


@pytest.fixture(scope="module", params=[*GALLERY, "a search that learns", "unconfirmed", "resumed"])
def run(request):
    system, spec = GALLERY.get(request.param, GALLERY["some fail"])
    problem = vj.Problem("gallery", SPACE, system, spec)
    if request.param == "a search that learns":
        return vj.falsify(problem, "cross_entropy", 64, batch=32, progress=False)
    if request.param == "unconfirmed":
        return vj.falsify(problem, "uniform", 64, batch=64, confirm=False, progress=False)
    if request.param == "mostly not replayed":
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(confirmer, "LIMIT", 9)
            return vj.falsify(problem, "uniform", 64, batch=64, progress=False)
    if request.param == "resumed":
        first = vj.falsify(problem, "uniform", 32, batch=32, progress=False)
        return vj.resume(first, budget=64, progress=False)
    return vj.falsify(
        problem, "uniform", 64, batch=64, progress=False, stop=vj.Stop(keep_going=True)
    )


def numbers(text):
    return [float(word) for word in re.findall(r"(?<![\w.-])-?\d+(?:\.\d+)?", text)]


def line(run, name):
    found = [text for text in run.summary().splitlines() if text.startswith(f"  {name} ")]
    return found[0][len(name) + 2 :].strip() if found else None


@pytest.mark.thorough
def test_the_first_line_counts_the_table(run):
    table = run.table.all
    ok, violated = table["status"] == "ok", table["violated"]
    headline = run.summary().splitlines()[0]
    if not ok.any():
        assert headline == f"gallery: no verdict: none of {len(table)} simulations ended properly"
        return
    counts = [int((ok & violated).sum()), len(table)]
    assert headline.startswith("gallery: {} of {} simulations violate the property".format(*counts))
    without = int((~ok).sum())
    assert numbers(headline) == ([*counts, without] if without else counts)


def test_the_verdicts_add_up(run):
    table = run.table.all
    failing = table.loc[table["violated"]]
    text = line(run, "of these")
    if "verdict" not in table or not len(failing):
        assert text is None
        return
    counts = failing["verdict"].value_counts().to_dict()
    assert set(counts) <= set(VERDICTS)
    said = {word: int(n) for n, word in re.findall(r"(\d+) ([a-z]+)", text) if word in VERDICTS}
    assert said == counts
    undecided = sum(count for verdict, count in counts.items() if verdict in UNDECIDED)
    assert re.findall(r"(\d+) undecided", text) == ([str(undecided)] if undecided else [])
    claimed = failing["verdict"] == "confirmed"
    assert run.table.counterexamples.index.tolist() == failing.index[claimed].tolist()
    assert len(run.table.counterexamples) + len(run.table.unconfirmed) == len(failing)


def test_only_checks_that_were_made_are_named(run):
    text = line(run, "of these") or ""
    confirmed = "confirmed" in text
    traced = confirmed and not run.problem.black_box
    assert ("in double precision" in text) == traced
    assert ("when simulated again" in text) == (confirmed and run.problem.black_box)
    assert ("a quarter of the step" in text) == (confirmed and run.problem.system.can_refine)
    assert ("no finer step" in text) == (confirmed and not run.problem.system.can_refine)


def test_the_rates_are_those_of_the_table(run):
    text = line(run, "failure rate")
    table = run.table.all
    ok, n = table["status"] == "ok", len(table)
    if not run.prior:
        assert "not given" in text
        return
    if not ok.any():
        assert text is None
        return
    violating, without = int((ok & table["violated"]).sum()), int((~ok).sum())
    ends = [100 * violating / n] + ([100 * (violating + without) / n] if without else [])
    *said, level, low, high = numbers(text)
    np.testing.assert_allclose(said, ends, rtol=0.01)
    assert level == 95
    assert low - 1e-9 <= min(ends)
    assert max(ends) <= high + 1e-9
    assert text.endswith("as simulated")
    assert low == pytest.approx(100 * vj.clopper_pearson(violating, n).low, rel=0.01)
    assert high == pytest.approx(100 * vj.clopper_pearson(violating + without, n).high, rel=0.01)


def test_the_rate_of_what_is_confirmed_allows_for_the_undecided(run):
    rate = run.confirmed_failure_rate
    counts = run.verdict_counts
    if not run.prior or not any(counts.get(name) for name in ("confirmed", "refuted", "fragile")):
        assert rate is None
        return
    assert rate.failures == counts.get("confirmed", 0)
    most = len(run.table.violating) - counts.get("refuted", 0) + len(run.table.failed)
    assert rate.failures + rate.undecided == most
    assert rate.low <= rate.failures / run.simulations <= most / run.simulations <= rate.high
    assert (f"{rate} confirmed" in run.summary()) == (rate.failures < len(run.table.violating))


def test_the_row_that_is_named_is_the_worst_that_is_claimed(run):
    table = run.table.all
    proper = table.loc[table["status"] == "ok"]
    if not len(proper):
        assert line(run, "worst") is line(run, "nearest") is None
        return
    claimed = run.table.counterexamples
    text = line(run, "worst") if len(run.table.violating) else line(run, "nearest")
    rows = claimed if len(claimed) else proper
    number = int(re.findall(r"row (\d+)", text)[0])
    assert rows.loc[number, "rho"] == rows["rho"].min()
    assert float(re.findall(r"robustness (-?[\d.e-]+)", text)[0]) == pytest.approx(
        table.loc[number, "rho"], rel=1e-3, abs=1e-30
    )
    for name in run.table.features:
        assert float(re.findall(rf"{name}=(-?[\d.e-]+)", text)[0]) == pytest.approx(
            table.loc[number, name], rel=1e-3
        )


def test_rows_without_a_verdict_are_counted_by_their_end(run):
    failed = run.table.failed
    text = line(run, "no verdict")
    if not len(failed):
        assert text is None
        return
    assert {word: int(n) for n, word in re.findall(r"(\d+) ([a-z]+)", text)} == (
        failed["status"].value_counts().to_dict()
    )


def test_each_formula_says_how_often_it_fails(run):
    if len(run.formulas) == 1:
        return
    table = run.table.all
    for name in run.formulas:
        assert numbers(line(run, name))[-1] == (table[f"rho.{name}"] < 0).sum()


def test_titles_and_legends_of_pictures_count_the_same(run):
    violating, n = len(run.table.violating), run.simulations
    figure = plot_features(run)
    title = figure.get_suptitle()
    assert title.startswith(f"gallery: {violating} of {n} simulations violate the property\n")
    if run.failure_rate is not None:
        assert str(run.failure_rate) in " ".join(title.split())
    labels = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
    assert labels == {
        f"{len(part)} {name}"
        for name, part in (
            ("claimed" if run.confirm else "failing", run.table.counterexamples),
            ("not claimed", run.table.unconfirmed),
            ("safe", run.table.safe),
            ("without a verdict", run.table.failed),
        )
        if len(part)
    }
    if run.table.all["rho"].notna().any():
        axes = plot_robustness_history(run).axes[0]
        assert numbers(axes.get_title()) == [violating, n]


@pytest.mark.addons
def test_the_analysis_counts_the_same(run):
    if not (run.table.all["status"] == "ok").any():
        return
    text = str(run.analyze())
    violating, counts = len(run.table.violating), run.table.counts
    assert f"{violating} of {run.simulations} simulations violate the property" in text
    assert (f"{counts.refused} of them are not claimed" in text) == (counts.refused > 0)
    left = counts.not_replayed
    assert (f"{left} are not claimed, as they were not replayed" in text) == (left > 0)


@pytest.mark.addons
def test_everything_that_counts_claims_counts_the_same(run):
    from verifai_jax.addons.reports.run_findings import number_rows
    from verifai_jax.addons.reports.view import view_data

    """One run, and its table, JSON, gate, evidence and analysis."""
    table, counts = run.table.all, run.table.counts
    failing = table.loc[(table["status"] == "ok") & table["violated"]]
    verdicts = failing["verdict"] if "verdict" in table else ["confirmed"] * len(failing)
    number = {name: sum(verdict == name for verdict in verdicts) for name in VERDICTS}
    claimed = number["confirmed"]
    refused, left = number["refuted"] + number["fragile"], number["raised"] + number["unexamined"]
    assert (counts.claimed, counts.refused, counts.not_replayed) == (claimed, refused, left)
    assert len(run.table.counterexamples) == claimed
    assert len(run.table.unconfirmed) == refused + left
    assert f"{claimed} counterexamples" in repr(run.table)
    plain = describe_run(run)
    keys = ("counterexamples", "refused", "not_replayed", "violating")
    assert [plain[key] for key in keys] == [claimed, refused, left, len(failing)]
    assert counts.may_fail == (claimed + left > 0)
    rows = dict(number_rows(run))
    assert rows["claimed as failures"] == str(claimed)
    assert rows["not claimed: not replayed"] == str(left)
    groups = view_data(run, {})["groups"]
    shown = {group["name"]: group["count"] for group in groups}
    assert (shown["claimed"], shown["not claimed"]) == (str(claimed), str(refused + left))
    if claimed:
        assert select_row(run, None)[0] in run.table.counterexamples.index
    else:
        with pytest.raises(ValueError, match="has no counterexample"):
            select_row(run, None)


def test_the_times_add_up(run):
    spoken = line(run, "time")
    compiled, *spent = numbers(spoken)[: 3 if run.search_seconds else 2]
    spent += [float(rest) for rest in re.findall(r"([\d.]+) s for callbacks and files", spoken)]
    assert compiled == pytest.approx(run.compile_seconds, abs=0.051)
    assert sum(spent) == pytest.approx(run.run_seconds, abs=0.0201)
    assert ("to search" in line(run, "time")) == (run.search_seconds > 0)
    assert ("to confirm" in line(run, "time")) == bool(run.checked)
