"""What an assessor gets: the claims as a tree, boxes on credibility, a page to be signed."""

import itertools
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.addons.reports.assessment import claims_tree
from verifai_jax.cli.main import main

SPEC = """
import numpy as np
import verifai_jax as vj
def simulate(features):
    return vj.Trace({"x": np.full(4, features["a"])}, dt=0.1)
slow = vj.Problem("slow", {"a": vj.Box(0.0, 1.0)}, vj.blackbox(simulate),
                  {"REQ-1": "always x < 0.9"}, requirements="reqs.csv")
"""


@pytest.mark.slow
def test_the_sections_of_an_assessment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.py").write_text(SPEC)
    (tmp_path / "reqs.csv").write_text("id,text,severity\nREQ-1,It stays <low>.,S2\n")
    ask = lambda *words: CliRunner().invoke(main, list(words))  # noqa: E731
    done = ask(
        "falsify", "spec.py:slow", "--search", "uniform", "--budget", "20", "--folder", "run"
    )
    assert done.exit_code == 0, done.output
    done = ask("report", "run", "--no-studies", "--assessment", "--output", "out.html")
    assert done.exit_code == 0, done.output
    page = (tmp_path / "out.html").read_text()
    assert "It stays &lt;low&gt;." in page
    assert page.count('class="box"') == 10
    assert page.count('class="blank"') == 9
    assert "Which decision depends on this simulation?" in page
    assert "report run --no-studies --assessment" in page
    assert "REQ-1: the robustness is below zero in" in page
    # The same folder gives the same file.
    ask("report", "run", "--no-studies", "--assessment", "--output", "again.html")
    assert (tmp_path / "again.html").read_bytes() == page.encode()


def test_the_tree_is_well_formed_and_has_every_claim():
    claims = [
        {"identifier": f"C{i}", "claim": f"claim {i} <&> " + 30 * "long ", "evidence": ["e1", "e2"],
         "assumptions": ["the model is right"] * (i % 2)}
        for i in range(1, 5)
    ]  # fmt: skip
    root = ElementTree.fromstring(claims_tree("some & other", "It holds.", claims))
    text = " ".join(each.text or "" for each in root.iter("text"))
    for i in range(1, 5):
        assert f"C{i} claim {i} <&>" in text
    assert "A1 (assumption): the model is right" in text
    assert "GM The model that was simulated" in text
    width, height = (int(root.get(name)) for name in ("width", "height"))
    ends = [(int(e.get("x")), int(e.get("y"))) for e in root.iter("text")]
    assert np.all(np.array(ends) < [width, height])
    # Boxes of the left column lie one below the other.
    boxes = [
        (int(e.get("y")), int(e.get("height"))) for e in root.iter("rect") if e.get("x") == "60"
    ]
    assert all(y + h <= other for (y, h), (other, _) in itertools.pairwise(boxes))


@pytest.mark.thorough
def test_any_result_can_have_one(tmp_path):
    def simulate(features):
        return vj.Trace({"x": np.full(2, features["a"])}, dt=0.1)

    problem = vj.Problem("any", {"a": vj.Box(0.0, 1.0)}, vj.blackbox(simulate), "always x < 0.9")
    found = vj.estimate(problem, "monte_carlo", 20, progress=False)
    page = found.report(tmp_path / "a.html", problem=problem, assessment=True).read_text()
    assert "The claims as a tree" in page
    assert "To be signed" in page
