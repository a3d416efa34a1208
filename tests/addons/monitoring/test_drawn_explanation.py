"""The picture of an explanation."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from verifai_jax import mtl
from verifai_jax.core.values.trace import Trace


@pytest.mark.thorough
def test_an_explanation_is_drawn_with_its_predicates(tmp_path):
    t = np.arange(101) * 0.04
    trace = Trace(
        {"x": np.sin(t), "theta": 0.1 * t * np.sin(3 * t), "p": np.ones((101, 2))}, dt=0.04
    )
    formula = "always[0,4] (abs(x) <= 2.4 & abs(theta) <= 0.2095 & norm(p) < 2 & TRUE)"
    file = tmp_path / "why.png"
    figure = mtl.draw(mtl.explain(formula, trace), file)
    assert isinstance(figure, Figure)
    assert file.read_bytes().startswith(b"\x89PNG")
    labels = [text.get_text() for text in figure.texts]
    assert "abs(theta) <= 0.2095" in labels
    assert any("fails with robustness" in label for label in labels)
