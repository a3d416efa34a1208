"""The table of claims: each is a sentence of README.md or docs/overview.md, and can be checked."""

import re
from pathlib import Path

import pytest

from benchmarks.claims import CLAIMS, MEASURES, Claim, main, read_claims

ROOT = Path(__file__).parents[1]


def words(text):
    """Return text without what Markdown and line ends add."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return re.sub(r"[\s#*`]+", " ", text)


def test_each_claim_is_a_sentence_of_the_readme_or_the_overview():
    pages = words((ROOT / "README.md").read_text() + (ROOT / "docs" / "overview.md").read_text())
    for claim in read_claims(CLAIMS.read_text()):
        assert words(claim.sentence).strip() in pages, claim.sentence


def test_each_claim_has_what_it_takes_to_be_checked():
    claims = read_claims(CLAIMS.read_text())
    assert {claim.name for claim in claims if claim.name} == set(MEASURES)
    for claim in claims:
        assert claim.holds(float(claim.figure))
        assert re.fullmatch(r"at least|at most|±[\d.e]+", claim.tolerance)
        assert re.fullmatch(r"[0-9a-f]{7,}", claim.commit)
        if script := re.match(r"`python (\S+\.py)", claim.command):
            assert (ROOT / script[1]).exists()


@pytest.mark.parametrize(
    ("tolerance", "good", "bad"),
    [("±2", (5, 7, 9), (4.9, 9.1)), ("at least", (7, 100), (6.9,)), ("at most", (7, 0), (7.1,))],
)
def test_tolerances(tolerance, good, bad):
    claim = Claim("a", "`python -m benchmarks.claims at1`", "7", tolerance, "abcdef0")
    assert claim.name == "at1"
    assert all(map(claim.holds, good))
    assert not any(map(claim.holds, bad))


def test_a_figure_that_is_off_ends_with_1(monkeypatch, capsys):
    monkeypatch.setitem(MEASURES, "balance", lambda: 604.0)
    assert main(["balance"]) == 0
    monkeypatch.setitem(MEASURES, "balance", lambda: 904.0)
    assert main(["balance"]) == 1
    assert "WRONG balance: 904, claimed 604 (±3)" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["nothing"])
    with pytest.raises(ValueError, match="a claim has the cells sentence, command"):
        read_claims("| a | b |")
