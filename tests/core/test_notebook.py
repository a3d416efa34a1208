"""What a notebook shows: results as HTML with pictures, names for people, zeros without a sign."""

import base64
import io
import re

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from PIL import Image

import verifai_jax as vj
from verifai_jax.core.display.notebook import Tabular


@pytest.fixture(scope="module")
def problem():
    def system(features, key):
        return vj.Trace({"x": features["x"] * jnp.ones(4), "<b>": jnp.zeros(4)}, dt=0.5)

    spec = {"low": "always x < 0.5", "named": 'always "<b>" <= x + 2'}
    return vj.Problem("a <b> problem", {"x": vj.Box(-1, 1)}, system, spec, description="x & y")


@pytest.fixture(scope="module")
def run(problem):
    return vj.falsify(problem, "uniform", budget=32, batch=32, progress=False, confirm=False)


def pictures(html):
    found = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    return [Image.open(io.BytesIO(base64.b64decode(text))) for text in found]


@pytest.mark.slow
def test_results_show_themselves(problem, run):
    replay = run.replay(run.best)
    shown = {
        "problem": problem, "run": run, "table": run.table, "space": problem.space,
        "replay": replay, "trace": replay.trace, "formula": problem.formulas["named"],
    }  # fmt: skip
    for name, thing in shown.items():
        html = thing._repr_html_()
        # What a person writes is text, never markup.
        assert "<b>" not in html, name
    assert "a &lt;b&gt; problem: x &amp; y" in problem._repr_html_()
    assert r"$\Box \left(\mathit{x} &lt; 0.5\right)$" in problem._repr_html_()
    assert "Box(-1, 1)" in problem._repr_html_()
    assert problem.formulas["low"]._repr_latex_() == r"$\Box \left(\mathit{x} < 0.5\right)$"
    assert "32 simulations" in run._repr_html_()
    # The table shows what fails, ten rows at most.
    rows = re.findall(r"<td>True</td>", run.table._repr_html_())
    assert 0 < len(rows) <= 10
    (picture,) = pictures(replay._repr_html_())
    assert picture.size[0] > 400
    assert "trace of 4 samples every 0.5 s" in replay.trace._repr_html_()


@pytest.mark.addons
def test_results_of_every_verb_show_themselves():
    from verifai_jax import counterexamples
    from verifai_jax.addons import analysis
    from verifai_jax.addons.checking.check import CheckOutcome
    from verifai_jax.addons.estimation.certification.result import Certificate
    from verifai_jax.addons.estimation.comparison.result import Transfer
    from verifai_jax.addons.estimation.sequence_result import SequenceEstimate
    from verifai_jax.addons.faults.failure_table.result import FailureTable
    from verifai_jax.addons.perception.training import Score
    from verifai_jax.addons.training.hardening.result import Hardening
    from verifai_jax.addons.training.sweeps.importance import HyperparameterImportance
    from verifai_jax.core.display.notebook import InNotebook

    verbs = [vj.Estimate, vj.Modes, vj.Comparison, vj.Certificates, vj.Augmentation]
    verbs += [vj.Synthesis, vj.Repair, vj.Confirmation, vj.Confirmations, vj.FuzzRun]
    verbs += [counterexamples.Explained, counterexamples.Shrunk, vj.Mode]
    verbs += [vj.perception.Compositional, vj.mtl.Explanation, vj.mtl.Mined]
    verbs += [vj.mtl.Judgement, Transfer, Hardening, vj.Study, Certificate]
    verbs += [analysis.Clusters, analysis.Diverse, analysis.FrequentPatterns, analysis.Neighbours]
    verbs += [CheckOutcome, SequenceEstimate, HyperparameterImportance, Score, FailureTable]
    assert [kind for kind in verbs if not issubclass(kind, InNotebook)] == []


def names(thing):
    return {name for name in dir(thing) if not name.startswith("_")}


@pytest.mark.thorough
def test_completion_shows_what_is_for_users(problem, run):
    assert names(vj.Box(0, 1)) == {
        "check", "columns", "contains", "from_intervals", "from_unit", "high", "low", "size",
        "to_unit",
    }  # fmt: skip
    assert names(vj.Categorical("a", "b")) >= {"choices", "probabilities", "check"}
    assert names(vj.signal("x")) >= {"abs", "max", "norm", "name"}
    for thing, wanted, internal in (
        (vj.Normal(0, 1), {"mean", "std"}, {"coverage_id_count", "settled", "tail"}),
        (problem, {"check", "only", "space", "nominal"}, {"programs", "made_in", "draws"}),
        (problem.space, {"sample", "domains", "where"}, {"root", "cube", "nudged"}),
        (problem.system, set(), {"reverse_hint", "lanes", "why_not"}),
        (problem.formulas["low"], {"horizon", "until", "signals"}, {"below", "children"}),
        (run, {"replay", "table", "best", "plot"}, {"checkpoint", "damage", "space_data"}),
        (run.table, {"all", "counterexamples", "safe"}, {"append", "digest", "missing"}),
        (vj.search.Uniform(), {"ask", "tell"}, {"wants", "fallback"}),
    ):
        assert wanted <= names(thing), thing
        assert not internal & names(thing), thing
        # They are there all the same.
        assert all(hasattr(type(thing), name) or hasattr(thing, name) for name in internal), thing


def test_methods_of_a_users_own_class_are_shown():
    class Steady(vj.search.Uniform):
        def settle(self):
            """Settle."""

    assert "settle" in names(Steady())


@pytest.mark.thorough
def test_no_zero_has_a_sign(problem):
    def still(features, key):
        return vj.Trace({"x": features["x"] * jnp.zeros(3)}, dt=0.5)

    flat = vj.Problem("flat", {"x": vj.Box(-1, 0)}, still, "always -x >= 0")
    run = vj.falsify(flat, "uniform", budget=4, batch=4, progress=False, confirm=False)
    rho = run.table.all["rho"].to_numpy()
    assert not np.signbit(rho[rho == 0]).any()
    texts = [str(run), str(run.replay(0)), run._repr_html_(), str(run.replay(0).trace)]
    texts += [str(vj.Box(-0.0, 1)), str(vj.parse("x > -0.0"))]
    assert not [text for text in texts if re.search(r"-0(?![.\d])|-0\.0+(?!\d)", text)]


@pytest.mark.parametrize("index", [None, "fault"])
def test_a_table_is_shown_and_written(tmp_path, index):
    class Found(Tabular):
        table = pd.DataFrame({"low": [0.5, 1.0]}, pd.Index(["a", "b"], name=index))

    assert "<td>0.5</td>" in Found()._repr_html_()
    path = Found().to_csv(tmp_path / "found.csv")
    # Names of rows are written where they mean something.
    assert list(pd.read_csv(path)) == [*filter(None, [index]), "low"]


@pytest.mark.addons
@pytest.mark.slow
def test_names_of_others_steer_no_terminal_and_draw_no_warnings(tmp_path):
    # Right-to-left writing, a clear screen, a character that the font lacks; a long name.
    name, signal = "a\u202eb \N{SLIGHTLY SMILING FACE} " + "long" * 80, "x\x1b[2J"

    def system(features, key):
        return vj.Trace({signal: features[name] * jnp.ones(4)}, dt=0.5)

    formula = vj.always(vj.signal(signal) < 0.5)
    odd = vj.Problem(name, {name: vj.Box(-1, 1)}, system, {name: formula}, nominal={name: -1})
    run = vj.falsify(odd, "uniform", budget=16, batch=16, progress=False)
    replay = run.replay(run.best)
    judged = vj.mtl.judge(formula, replay.trace, progress=False)
    results = [odd, run, replay, replay.trace, judged, vj.confirm(run, progress=False)]
    results += [vj.shrink(run, progress=False), vj.mtl.explain(formula, replay.trace)]
    for text in [*map(str, results), *map(repr, results), run.summary(), judged.summary()]:
        assert not re.search("[\u202e\x1b]", text)
    assert vj.parse(str(formula)) == formula  # A formula is what a parser reads.
    replay.plot(tmp_path / "replay.png")
    [saved] = run.save_counterexamples(tmp_path, max_count=1)
    assert len(saved.name) < 100
