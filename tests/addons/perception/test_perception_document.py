"""The document's landing pad: its code runs as it stands, with fewer images and steps."""

import re
from pathlib import Path

import numpy as np
import pytest

TEXT = (Path(__file__).parents[3] / "docs" / "perception.md").read_text()
CODE = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
SMALLER = {
    "examples(3000, 0), steps=600": "examples(40, 0), steps=2",
    "examples(1000, 1)": "examples(8, 1)",
    "budget=1000": "budget=8",
    "length=36": "length=33",
    "Camera(24, 24,": "Camera(8, 8,",
    'frame, "logit < 0"': 'frame, "logit < 0", budget=60, samples=64',
}


@pytest.mark.slow
def test_the_landing_pad_trains_and_is_falsified(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = "\n".join(block for block in CODE if "Supervisor" not in block)
    for long, short in SMALLER.items():
        assert code.count(long) == 1, long
        code = code.replace(long, short)
    names: dict = {}
    exec(compile(code, "docs/perception.md", "exec"), names)
    assert len(names["run"].table.all) == 8
    assert np.isfinite(names["worst"]["rho"])
    assert names["network"].shape == (8, 8)
    assert "8 images: precision" in capsys.readouterr().out
    assert 0 < names["result"].frames["total"] <= 60
    assert (tmp_path / "region.png").exists()


def test_the_controller_for_webots_is_python():
    (controller,) = [block for block in CODE if "Supervisor" in block]
    compile(controller, "controller", "exec")
    assert "was not run" in TEXT
