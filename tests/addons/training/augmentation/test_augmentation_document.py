"""The worked example of the document runs as it stands there."""

import re
from pathlib import Path

import pytest

import verifai_jax as vj

DOCUMENT = Path(__file__).parents[4] / "docs" / "augmentation.md"


@pytest.mark.slow
def test_the_worked_example_runs(capsys):
    blocks = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert len(blocks) == 3
    names: dict = {}
    for block in blocks:
        exec(compile(block, str(DOCUMENT), "exec"), names)
    result = names["result"]
    assert isinstance(result, vj.Augmentation)
    assert result.complete
    assert set(result.table["status"]) == {"trained"}
    assert str(result) in capsys.readouterr().out
    errors = names["shifted"].means["error"]
    assert errors["counterexamples"] < errors["none"], "the half that was never seen"


def test_every_arm_is_in_the_document():
    text = DOCUMENT.read_text()
    assert all(f"`{arm}`" in text for arm in vj.augmentation.ARMS)
