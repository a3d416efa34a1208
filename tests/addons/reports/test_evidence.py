"""Evidence reports: everything that was asked and found, nothing that a text can break."""

import json
import re
from html.parser import HTMLParser

import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

import verifai_jax as vj
from verifai_jax.addons.reports import write_report
from verifai_jax.addons.reports.commands import run_command
from verifai_jax.addons.reports.english import formula_words
from verifai_jax.addons.reports.markup import data_block, element
from verifai_jax.addons.reports.provenance import Input, chained
from verifai_jax.addons.reports.view import MAX_ROWS, numbers_of, view_data
from verifai_jax.cli.main import main
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.user_code.sources import file_hash
from verifai_jax.mtl import parse

HOSTILE = "<script>alert(1)</script>"


def simulate(features):
    if features["a"] > 0.9:
        raise RuntimeError(f"out of fuel {HOSTILE}")
    return vj.Trace({"x": np.full(4, features["a"])}, dt=0.1)


PROBLEM = vj.Problem(
    "gallery",
    {"a": vj.Box(0.0, 1.0), "colour": vj.Categorical("red", HOSTILE)},
    vj.blackbox(simulate),
    "always[0, 0.3] x <= 0.6",
    description="the value stays low",
)


OPTIONS = {"units": {"a": "m"}, "reasons": {"a": "by <law>"}, "traces": 5, "studies": False}


class Text(HTMLParser):
    """The text of a page, and the elements that run or load something."""

    def __init__(self):
        super().__init__()
        self.text, self.scripts, self.open, self.anchors, self.links = "", [], [], set(), []

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        if tag == "script":
            self.scripts.append(found.get("type"))
        for name, value in found.items():
            assert not name.startswith("on"), name
            if name == "src":
                assert value.startswith("data:image/")
            if name == "href":
                self.links.append(value)
            if name == "id":
                self.anchors.add(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["script"] and self.open[-1:] != ["style"]:
            self.text += data


def read(path):
    page = Text()
    page.feed(path.read_text())
    assert page.open == []
    return page


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "gallery-1"
    vj.falsify(PROBLEM, "uniform", 64, batch=32, seed=3, folder=path, progress=False)
    return path


@pytest.fixture(scope="module")
def report(folder, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "gallery.html"
    return vj.load(folder, PROBLEM).report(path, **OPTIONS)


@pytest.mark.slow
def test_the_questions_of_an_auditor_are_answered(report, folder):
    run, text = vj.load(folder, PROBLEM), read(report).text
    counts = run.table.counts
    assert f"{counts.violating:,} of {run.simulations:,} simulations violate" in text
    assert "at all times from 0 s to 0.3 s, x is at most 0.6" in text
    assert "uniform between 0 and 1" in text
    assert "by <law>" in text
    assert f"{counts.without_verdict} of 64 simulations have no verdict" in text
    assert f"{counts.without_verdict} error" in text
    assert str(run.failure_rate) in text
    assert "the rows are independent samples of the prior above" in text
    assert "Values outside of the ranges above: nothing is known of them." in text
    assert f"Failure 3: row {_row_of_failure(text, 3)}" in text
    assert f".replay({_row_of_failure(text, 3)})" in text
    assert "Seed 3, verifai_jax" in text
    assert "when simulated again; no finer step could be tried" in text
    assert "--unit a=m --reason 'a=by <law>' --traces 5 --no-studies" in text


def _row_of_failure(text, number):
    return int(re.search(rf"Failure {number}: row (\d+)", text)[1])


@pytest.mark.slow
def test_texts_of_people_are_text(report):
    page = read(report)
    assert page.scripts == ["application/json", "application/json", None]
    assert f"out of fuel {HOSTILE}" in page.text
    assert HOSTILE not in report.read_text()
    assert {link.removeprefix("#") for link in page.links} <= page.anchors


@pytest.mark.thorough
def test_its_policy_allows_nothing_from_elsewhere(report):
    head = report.read_text().partition("<style>")[0]
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', head)[1]
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'sha256-")
    assert "unsafe" not in policy
    assert "http" not in report.read_text().replace("http-equiv", "").replace(
        "http://www.w3.org/2000/svg", ""
    )


@pytest.mark.slow
def test_rebuilt_it_is_the_same(report, folder, tmp_path):
    again = vj.load(folder, PROBLEM).report(tmp_path / "another.html", **OPTIONS)
    assert again.read_bytes() == report.read_bytes()
    claims = report.with_suffix(".claims.json")
    assert again.with_suffix(".claims.json").read_bytes() == claims.read_bytes()


def test_claims_cite_evidence_and_assumptions(report):
    claims = json.loads(report.with_suffix(".claims.json").read_text())
    assert claims["subject"] == "gallery"
    for claim in claims["claims"]:
        assert claim["evidence"]
    rates = [each for each in claims["claims"] if "failure rate" in each["claim"]]
    assert rates
    assert any("independent samples" in text for text in rates[0]["assumptions"])
    block = re.search(r'id="claims-json">(.*?)</script>', report.read_text())[1]
    # A page cannot have its own hash.
    seals = {"report_sha256": file_hash(report), "claims_sha256": claims["claims_sha256"]}
    assert json.loads(block) | seals == claims


@pytest.mark.slow
def test_without_its_problem_a_run_is_reported_too(folder, tmp_path):
    path = tmp_path / "gallery.html"
    command = ["report", str(folder), "--without-problem", "--output", str(path)]
    result = CliRunner().invoke(main, [*command, "--unit", "a=m"])
    assert result.exit_code == 0, result.output
    text = read(path).text
    assert "The run was read without its problem" in text
    assert "uniform between 0 and 1" in text


def test_a_unit_of_nothing_is_refused(folder, tmp_path):
    with pytest.raises(UnknownNameError, match="colour"):
        vj.load(folder, PROBLEM).report(tmp_path / "x.html", units={"color": "m"})
    with pytest.raises(TypeError, match="got int"):
        write_report(3, tmp_path / "x.html")


def large(rows, features):
    generator = np.random.default_rng(0)
    values = generator.random((features, rows)).astype(np.float32)
    names = tuple(f"f{i}" for i in range(features))
    table = vj.ErrorTable(names)
    rho = values[0] - 0.1
    columns = {"rho": rho, "violated": rho < 0, "status": np.full(rows, "ok", object)}
    table.append(dict(zip(names, values, strict=True)) | columns)
    formulas = {"spec": "x >= 0"}
    return vj.Run("large", formulas, table, "Uniform()", 0, 64, "budget", 0, 0, "0", True)


def test_a_large_table_is_thinned():
    n = 9000
    data = view_data(large(n, 4), {7: {"label": "row 7"}})
    assert 7 in data["rows"]
    assert data["shown"] == len(data["rows"]) <= MAX_ROWS
    assert data["simulations"] == n
    failing = sum(group == 3 for group in data["group"])
    assert 100 < failing < 2 * n // 10


@pytest.mark.slow
def test_a_report_of_many_rows_is_small(tmp_path):
    path = large(100_000, 12).report(tmp_path / "large.html")
    assert path.stat().st_size < 5_000_000
    assert "Of 100,000 rows 4,000 are shown" in read(path).text


@settings(max_examples=40)
@given(st.text())
def test_data_cannot_end_its_block(text):
    block = str(data_block("view", {"text": text}))
    inner = block.partition(">")[2].removesuffix("</script>")
    assert not set("<>&") & set(inner)
    assert json.loads(inner) == {"text": text}


@settings(max_examples=40)
@given(st.text())
def test_text_stays_text(text):
    class Inner(HTMLParser):
        tags = 0

        def handle_starttag(self, tag, attrs):
            self.tags += 1

    inner = Inner()
    inner.feed(str(element("p", text, title=text)))
    assert inner.tags == 1


def test_numbers_that_are_none():
    assert numbers_of([1.0, np.nan, np.inf, 0.1234567]) == [1, None, None, 0.123457]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("always x > 1", "at all times, x is above 1"),
        ("eventually[1, 2] x < 1", "at some time from 1 s to 2 s, x is below 1"),
        ("x > 0 -> always y >= 1", "whenever x is above 0, (at all times, y is at least 1)"),
        ("x > 0 | y > 0", "x is above 0 or y is above 0"),
        (
            "x > 0 until[0, 3] y > 0",
            "x is above 0 until, at some time from 0 s to 3 s, y is above 0",
        ),
        ("always not (x > 0)", "at all times, (it is not so that x is above 0)"),
    ],
)
def test_formulas_in_words(text, words):
    assert formula_words(parse(text)).replace("(x is above 0)", "x is above 0") == words


@pytest.mark.parametrize(
    ("domain", "words"),
    [
        (vj.Box([0, 1], [1, 2]), "uniform between [0, 1] and [1, 2]"),
        (vj.DiscreteBox(1, 3), "the integers from 1 to 3, all equally probable"),
        (vj.Normal(0, 2), "normal with mean 0 and standard deviation 2"),
        (vj.LogUniform(0.1, 10), "log-uniform between 0.1 and 10"),
        (vj.Categorical("a", "b", weights=[0.75, 0.25]), "one of a (75 %), b (25 %)"),
        (vj.Array(vj.Box(0, 1), 3), "3 items, each uniform between 0 and 1"),
    ],
)
def test_priors_in_words(domain, words):
    assert domain.words() == words


def test_the_chain_depends_on_every_input_and_their_order():
    one, two = Input("a", "", "1"), Input("b", "", "2")
    last = chained([one, two])[-1].chain
    assert last == chained([one, two])[-1].chain
    assert last != chained([two, one])[-1].chain
    assert last != chained([one._replace(sha256="3"), two])[-1].chain


def test_the_command_repeats_the_run():
    options = {"target": "specs/a b.py:c", "budget": 64, "precision": "float64"}
    search = vj.search.CrossEntropy()
    run = vj.Run(
        "c", {}, vj.ErrorTable(()), repr(search), 5, 32, "budget", 0, 0, "0", False,
        search_data=vj.search.to_json(search), confirm=True, **options,
    )  # fmt: skip
    assert run_command(run) == (
        "verifai-jax falsify 'specs/a b.py:c' --search cross_entropy --budget 64 --batch 32 "
        "--seed 5 --precision float64"
    )


@pytest.mark.slow
def test_a_failure_is_explained_and_shrunk(tmp_path):
    problem = vj.Problem(
        "sum",
        {"a": vj.Box(0.0, 1.0), "b": vj.Box(0.0, 1.0)},
        lambda f, key: vj.Trace({"x": (f["a"] + 0.1 * f["b"]) * jnp.ones(4)}, dt=0.1),
        "always x <= 0.6",
        nominal={"a": 0.0, "b": 0.0},
        draw=lambda axes, trace, sample, features: axes.plot([0, sample]),
    )
    run = vj.falsify(problem, "uniform", 64, batch=64, progress=False)
    text = read(run.report(tmp_path / "sum.html", traces=8)).text
    assert "Failure 1, shrunk" in text
    assert "sum: 1 of 2 features away from nominal is enough" in text
    assert "The reason of failure 1" in text
    assert "as an animation" in text


@pytest.mark.slow
def test_features_of_every_kind_are_shown(tmp_path):
    car = vj.Struct({"x": vj.Box(0.0, 1.0), "kind": vj.Categorical("van", "bus")})
    problem = vj.Problem(
        "road",
        {
            "wind": vj.Signal(vj.Box(-1.0, 1.0), knots=3, duration=1.0),
            "cars": vj.Array(car, length=(0, 2)),
            "v": vj.Box([0.0, 0.0], [1.0, 2.0]),
        },
        lambda f, key: vj.Trace(
            {"x": jnp.stack([f["wind"](0.0), f["wind"](1.0)]) + f["v"][0]}, dt=1.0
        ),
        "always x <= 1",
    )
    run = vj.falsify(problem, "uniform", 64, batch=64, progress=False)
    text = read(run.report(tmp_path / "road.html", traces=4, studies=False)).text
    assert "a function of time with 3 control points, each uniform between -1 and 1" in text
    assert "x: uniform between 0 and 1; kind: one of van, bus, all equally probable" in text
    assert "absent" in text
    assert not re.search(r"\bnan\b", text)
    assert "wind at 0.5 s" in text


@pytest.mark.slow
def test_the_ways_of_failing_stand_in_the_report_with_their_probabilities(tmp_path):
    def jump(features, key):
        distance = jnp.minimum(3.0 - features["a"], 3.3 + features["b"])
        return vj.Trace({"distance": jnp.full(3, distance)}, dt=0.1)

    space = {"a": vj.Normal(0.0, 1.0), HOSTILE: vj.Box(0.0, 1.0), "b": vj.Normal(0.0, 1.0)}
    problem = vj.Problem("jump", space, jump, "always distance >= 0")
    run = vj.falsify(problem, "uniform", 500, progress=False, folder=tmp_path / "run")
    path = run.report(tmp_path / "report.html", studies=False, traces=0, modes=4000)
    found = vj.modes(problem, 4000, seed=run.seed, progress=False)
    text, claims = read(path).text, path.with_suffix(".claims.json").read_text()
    assert len(found) == 2
    assert f"A failure has probability {found.probability:.3g}" in claims
    for mode in found:
        told = f"{mode.probability:.3g} (95 % interval {mode.low:.3g} to {mode.high:.3g})"
        assert told in text
        assert told in claims
    assert "--modes 4000" in text
    assert HOSTILE not in path.read_text()
    again = run.report(tmp_path / "again.html", studies=False, traces=0, modes=4000)
    assert again.read_bytes() == path.read_bytes()


def test_simulations_for_the_ways_of_failing_are_counted(folder, tmp_path):
    with pytest.raises(ValueError, match="modes must be"):
        write_report(vj.load(folder), tmp_path / "report.html", modes=0)
