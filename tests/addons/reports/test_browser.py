"""The report in a real browser: nothing is fetched, nothing fails, rows answer."""

import base64
import json

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.reports import write_report
from verifai_jax.addons.reports.page import asset
from verifai_jax.addons.reports.view import trace_data, view_data

chromium = pytest.importorskip("chromium")
HOSTILE = "<script>alert(1)</script>"
PAPER = 700
"""Pixels between the margins of a page of A4."""
BOX = """(() => {
  const box = document.querySelector(".vj-scatter").getBoundingClientRect();
  return [box.left, box.top, box.width, box.height];
})()"""

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(
        chromium.EXECUTABLE is None,
        reason="no Chromium is installed: the report was not opened in a browser",
    ),
]


def test_the_page_answers_in_a_browser(tmp_path):
    problem = vj.Problem(
        "gallery",
        {HOSTILE: vj.Box(0.0, 1.0), "b": vj.Box(-1.0, 1.0)},
        lambda features, key: vj.Trace({"x": features[HOSTILE] * jnp.ones(4)}, dt=0.1),
        "always x <= 0.6",
        description=f"{HOSTILE} </script>",
    )
    run = vj.falsify(problem, "uniform", 64, batch=64, progress=False)
    path = write_report(run, tmp_path / "report.html", traces=6, studies=False, assessment=True,
                        odd=vj.odd_of(problem.space))  # fmt: skip
    with chromium.Browser(tmp_path / "profile") as browser:
        for width in (1280, 400):
            browser.open(path.as_uri(), width, 900)
            assert browser.value("document.title") == "gallery: evidence report"
            # Nothing but what may scroll by itself is wider than the page.
            assert browser.value("document.documentElement.scrollWidth") <= width
            assert not browser.value("document.getElementById('explore').hidden")
            broken = "[...document.images].filter((i) => !i.naturalWidth).length"
            assert browser.value(broken) == 0
            assert HOSTILE in str(browser.value("document.body.innerText"))
        _rows_answer(browser, run)
        # On paper nothing scrolls, so that nothing may be wider than the page.
        browser.call("Emulation.setEmulatedMedia", media="print")
        browser.open(path.as_uri(), PAPER, 990)
        assert browser.value("document.documentElement.scrollWidth") <= PAPER
        assert browser.value("document.getElementById('explore').offsetHeight") == 0
        assert browser.value("document.getElementById('still').offsetHeight") > 100
        printed = base64.b64decode(browser.call("Page.printToPDF")["data"])
        assert printed.startswith(b"%PDF-")
        assert browser.errors == []
        assert browser.requests == []


def _rows_answer(browser, run):
    """Point at the worst row in the scatter, and click it."""
    browser.value("document.querySelector('.vj-scatter').scrollIntoView({block: 'center'})")
    data = "JSON.parse(document.getElementById('table-view').textContent)"
    names = browser.value(f"{data}.columns.map((c) => c.name)")
    across, up = browser.value(f"{data}.axes")
    table, worst = run.table.all, int(run.best.name)
    left, top, width, height = browser.value(BOX)

    def share(name):
        column = table[name]
        return (column[worst] - column.min()) / (column.max() - column.min())

    x = left + 52 + share(names[across]) * (width - 62)
    y = top + height - 34 - share(names[up]) * (height - 44)
    browser.mouse("mouseMoved", float(x), float(y))
    shown = browser.value("document.querySelector('.vj-details').innerText")
    assert f"{table[names[across]][worst]:.4g}"[:5] in shown
    assert browser.value("document.getElementById('explore').dataset.row") == str(worst)
    browser.click(float(x), float(y))
    assert browser.value("document.getElementById('explore').dataset.selected") == str(worst)
    trace = browser.value("document.querySelector('.vj-trace').innerText")
    assert trace.startswith(f"Row {worst} violates the property")
    assert browser.value("document.querySelectorAll('.vj-trace svg polyline').length") == 1


def test_the_widget_asks_for_a_trace(tmp_path):
    """The script of the notebook, with the kernel's side played by a few lines."""
    problem = vj.Problem(
        "gallery",
        {"a": vj.Box(0.0, 1.0), "b": vj.Box(-1.0, 1.0)},
        lambda features, key: vj.Trace({"x": features["a"] * jnp.ones(4)}, dt=0.1),
        "always x <= 0.6",
    )
    run = vj.falsify(problem, "uniform", 64, batch=64, confirm=False, progress=False)
    worst = int(run.best.name)
    script = asset("view.js") + asset("widget.js").replace("export default", "const widget =")
    kernel = f"""
      const data = {json.dumps(view_data(run, {}))};
      const trace = {json.dumps(trace_data(run.replay(worst)))};
      let told;
      const model = {{
        get: (name) => data,
        on: (event, call) => {{ told = call; }},
        send: ({{ row }}) => {{ window.asked = row; told({{ row, trace }}); }},
      }};
      widget.render({{ model, el: document.getElementById("cell") }});
    """
    page = tmp_path / "cell.html"
    style = f"<style>{asset('view.css')}</style>"
    body = f'<div id="cell"></div><script type="module">{script}{kernel}</script>'
    page.write_text(f"<!doctype html>{style}<body>{body}")
    with chromium.Browser(tmp_path / "profile") as browser:
        browser.open(page.as_uri(), 1000, 900)
        table, data = run.table.all, view_data(run, {})
        names = [column["name"] for column in data["columns"]]
        across, up = (table[names[axis]] for axis in data["axes"])
        left, top, width, height = browser.value(BOX)
        x = left + 52 + (across[worst] - across.min()) / np.ptp(across) * (width - 62)
        y = top + height - 34 - (up[worst] - up.min()) / np.ptp(up) * (height - 44)
        browser.click(float(x), float(y))
        assert browser.value("window.asked") == worst
        assert browser.value("document.querySelectorAll('.vj-trace svg').length") == 1
        assert browser.errors == []
