"""The table in a notebook: traces come when they are asked for; without widgets a picture."""

import sys

import jax.numpy as jnp
import pytest

import verifai_jax as vj
from verifai_jax.addons.reports import widget

PROBLEM = vj.Problem(
    "gallery",
    {"a": vj.Box(0.0, 1.0), "b": vj.Box(-1.0, 1.0)},
    lambda features, key: vj.Trace({"x": features["a"] * jnp.ones(4)}, dt=0.1),
    "always x <= 0.6",
)


@pytest.fixture(scope="module")
def run():
    return vj.falsify(PROBLEM, "uniform", 64, batch=64, confirm=False, progress=False)


def test_without_anywidget_it_is_a_picture(run, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "anywidget", None)
    widget._widget_class.cache_clear()
    figure = run.explore()
    assert figure.get_axes()
    assert "pip install 'verifai_jax[widget]'" in caplog.text


@pytest.mark.thorough
def test_a_row_that_is_asked_for_is_simulated(run, monkeypatch):
    pytest.importorskip("anywidget")
    widget._widget_class.cache_clear()
    view = run.explore()
    assert len(view.data["rows"]) == run.simulations
    sent = []
    monkeypatch.setattr(view, "send", sent.append)
    view.answer({"row": 5})
    view.answer({"row": 1000})
    view.answer({"row": "5"})
    assert [each["row"] for each in sent] == [5, 1000]
    values = sent[0]["trace"]["signals"][0]["values"][0]
    assert values == pytest.approx([float(run.table.all["a"][5])] * 4, rel=1e-5)
    assert "row 1000 is not in the table" in sent[1]["trace"]["text"]
    bundle = view._repr_mimebundle_()
    assert (bundle[0] if isinstance(bundle, tuple) else bundle)["image/png"].startswith(b"\x89PNG")
