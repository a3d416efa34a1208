"""Error bars: bounds that no value within them escapes, exact where a formula is monotone."""

import json
import re
import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.addons.monitoring.error_bars import Bounds, with_bars
from verifai_jax.cli.main import main
from verifai_jax.mtl.host_values import HostValues

DT, LENGTH = 0.5, 12
BARS = {"x": 0.4, "y": "0.1 + 0.2 * abs(z)", "u": ("u_low", "u_high")}


def term(rng, depth):
    kind = rng.integers(4 if not depth else 15)
    if kind < 3:
        return "xyzu"[rng.integers(4)]
    if kind == 3:
        return f"{rng.integers(-4, 5) / 2}"
    a, b = (term(rng, depth - 1) for _ in range(2))
    return (
        f"({a} + {b})", f"({a} - {b})", f"({a} * {b})", f"abs({a})", f"-({a})",
        f"min({a}, {b}, 1)", f"max({a}, {b})", f"sin({a})", f"exp({a} / 4)",
        f"({a}) ** {rng.integers(1, 4)}", f"({a}) / (z ** 2 + 1 + 0.1 * {b})",
    )[kind - 4]  # fmt: skip


def leaf(rng):
    while True:
        text = f"{term(rng, 2)} {('>', '>=', '<', '<=', '==', '!=')[rng.integers(6)]} 0.5"
        if re.search("[xyzu]", text.replace("exp", "").replace("max", "")):
            return text


def formula(rng, depth, leaf=leaf):
    if not depth:
        return leaf(rng)
    a, b = (formula(rng, depth - 1, leaf) for _ in range(2))
    window = f"[{rng.integers(3) * DT},{rng.integers(3, 7) * DT}]"
    return (
        f"({a}) & ({b})", f"({a}) | ({b})", f"always{window} ({a})", f"eventually{window} ({a})",
        f"historically{window} ({a})", f"once{window} ({a})", f"({a}) until{window} ({b})",
        f"({a}) since{window} ({b})", f"!({a})", f"({a}) -> ({b})", f"next ({a})", f"prev ({a})",
        f"({a}) <-> ({b})", f"duration({leaf(rng)}, 2) >= 1", f"count({leaf(rng)}, 2) <= 2",
        "mean(x + y, 2) >= abs(u)", "at_last(z > 0, x * u) < 1",
    )[rng.integers(17 if leaf is not monotone_leaf else 8)]  # fmt: skip


def recorded(rng):
    """Signals as they are measured, with those of their error bars."""
    x, y, z, u = rng.normal(size=(4, LENGTH))
    low, high = u - rng.uniform(0, 0.5, LENGTH), u + rng.uniform(0, 0.5, LENGTH)
    return {"x": x, "y": y, "z": z, "u": u, "u_low": low, "u_high": high}


def within(rng, signals, corners):
    """Signals that the error bars allow: anywhere in them, or at their ends."""
    shares = rng.uniform(-1, 1, (3, LENGTH))
    shares = np.sign(shares) if corners else shares
    u = (signals["u_low"] + signals["u_high"]) / 2
    return {
        **signals,
        "x": signals["x"] + 0.4 * shares[0],
        "y": signals["y"] + (0.1 + 0.2 * np.abs(signals["z"])) * shares[1],
        "u": u + (signals["u_high"] - signals["u_low"]) / 2 * shares[2],
    }


def values(signals):
    return HostValues(signals, DT)


@pytest.mark.thorough
@pytest.mark.parametrize("part", range(3))
def test_no_value_within_the_bars_escapes_300_formulas(part):
    rng = np.random.default_rng(part)
    decided = set()
    for _ in range(100):
        f = vj.parse(formula(rng, rng.integers(0, 4)))
        signals = recorded(rng)
        own = {name for name in BARS if name in str(f)}
        lower, upper = with_bars(f, BARS)
        assert own or lower == upper
        measured = values(signals)
        low, high = (float(measured.first(each)) for each in (lower, upper))
        truths = [float(measured.first(each, boolean=True)) for each in (lower, upper)]
        verdict = Bounds(*truths).verdict
        decided.add(verdict)
        for k in range(12):
            one = values(within(rng, signals, corners=k % 3 == 0))
            rho, truth = float(one.first(f)), float(one.first(f, boolean=True))
            room = 1e-9 * max(1.0, abs(rho)) if np.isfinite(rho) else 0.0
            assert low - room <= rho <= high + room, str(f)
            if verdict != "depends" and abs(rho) > 1e-9:
                assert truth == (1 if verdict == "holds" else -1), str(f)
    assert decided == {"holds", "fails", "depends"}


def monotone_leaf(rng):
    """X is good, y is bad: the worst are the ends of their bars."""
    a, b = rng.normal(size=2).round(2)
    return (f"x > {a}", f"y <= {b}", f"exp(x) - y ** 3 > {a}", f"x - 2 * y >= {b}")[rng.integers(4)]


def test_bounds_of_monotone_formulas_are_those_of_the_worst_and_best_signals():
    rng = np.random.default_rng(4)
    for _ in range(60):
        f = vj.parse(formula(rng, rng.integers(0, 4), monotone_leaf))
        signals = recorded(rng)
        width = 0.1 + 0.2 * np.abs(signals["z"])
        for bound, sign in zip(with_bars(f, BARS), (-1, 1), strict=True):
            ends = {"x": signals["x"] + sign * 0.4, "y": signals["y"] - sign * width}
            wanted = float(values({**signals, **ends}).first(f))
            assert float(values(signals).first(bound)) == pytest.approx(wanted, rel=1e-12)


def test_an_uncertain_divisor_that_may_be_zero_bounds_nothing():
    lower, upper = with_bars(vj.parse("1 / x > 0"), {"x": 1.0})
    near, far = ({"x": np.array([value])} for value in (0.5, 2.0))
    assert float(values(near).first(lower)) == -np.inf
    assert float(values(near).first(upper)) == np.inf
    ends = [float(values(far).first(each)) for each in (lower, upper)]
    assert ends == pytest.approx([1 / 3, 1.0])


def test_judge_says_what_holds_for_all_and_what_depends(tmp_path):
    time = np.arange(20) * 0.1
    table = pd.DataFrame({"time": time, "x": np.sin(3 * time), "x_error": 0.05 + 0 * time})
    asked = {"loose": "always x < 1.2", "close": "always x < 1.02", "wrong": "always x < 0.5",
             "other": "always time >= 0"}  # fmt: skip
    asked.pop("other")
    exact = vj.mtl.judge(asked, table)
    assert [row.verdict for row in exact.rows] == ["holds", "holds", "fails"]
    assert all(row.robustness == row.highest for row in exact.rows)
    for bar in (0.05, "x_error", ("x - x_error", "x + x_error")):
        found = vj.mtl.judge(asked, table, error_bars={"x": bar})
        assert [row.verdict for row in found.rows] == ["holds", "depends", "fails"]
        for row, sharp in zip(found.rows, exact.rows, strict=True):
            assert row.robustness == pytest.approx(sharp.robustness - 0.05)
            assert row.highest == pytest.approx(sharp.robustness + 0.05)
        assert not found.all_hold
        assert [row.requirement for row in found.depending] == ["close"]
    assert "1 of 3 verdicts fail, 1 depend on values within error bars" in str(found)
    assert 'failures="0" errors="1"' in found.junit(tmp_path / "found.xml").read_text()
    page = found.report(tmp_path / "found.html").read_text()
    assert "1 verdicts depend on values within error bars" in page
    with pytest.raises(ValueError, match="unknown signal with an error bar 'xx'; did you mean 'x'"):
        vj.mtl.judge(asked, table, error_bars={"xx": 0.1})
    with pytest.raises(ValueError, match="the error bar of x must be a width of 0 or more"):
        vj.mtl.judge(asked, table, error_bars={"x": -0.1})
    with pytest.raises(ValueError, match="the error bar of x must be a number, an expression"):
        vj.mtl.judge(asked, table, error_bars={"x": "x > 1"})
    with pytest.raises(ValueError, match=r"norm\(v\) has no bounds for signals with error bars"):
        with_bars(vj.parse("norm(v) < 1"), {"v": 0.1})


def test_the_command_judges_with_error_bars(tmp_path):
    (tmp_path / "log.csv").write_text("time,x\n0,0.9\n1,0.95\n2,0.9\n")
    arguments = ["monitor", "always x < 1", str(tmp_path / "log.csv"), "--error-bar", "x=0.1"]
    result = CliRunner().invoke(main, [*arguments, "--json", "--fail-on", "incomplete"])
    assert result.exit_code == 1, result.output
    found = json.loads(result.stdout)
    assert (found["failing"], found["depending"]) == (0, 1)
    assert found["verdicts"][0]["verdict"] == "depends"
    result = CliRunner().invoke(main, [*arguments[:-1], "x"])
    assert "--error-bar is NAME=WIDTH" in result.output


def test_watch_gives_bounds():
    monitor = vj.mtl.watch("always x < 1", DT, error_bars={"x": 0.1})
    assert monitor.step({"x": 0.5}) == pytest.approx((0.4, 0.6))
    assert monitor.step({"x": 0.95}).verdict == "depends"
    assert monitor.interval()[1].high == pytest.approx(0.15)
    assert monitor.step({"x": 1.2}).verdict == "fails"
    assert monitor.finish() == pytest.approx((-0.3, -0.1))
    two = vj.mtl.watch({"a": "always x < 1", "b": "once x > 0"}, DT, error_bars={"x": 0.1})
    found = two.step({"x": 0.95})
    assert found["a"].verdict == "depends"
    assert found["b"].verdict == "holds"
    assert two.steps({"x": np.zeros(3)}).shape == (3, 4)
    with pytest.raises(ValueError, match="unknown signal with an error bar 'y'"):
        vj.mtl.watch("always x < 1", DT, error_bars={"y": 0.1})


MAIN = """
#include <stdio.h>
#include "bars.h"
int main(void) {
  bars m; double x[@];
  bars_start(&m);
  for (;;) {
    for (int i = 0; i < @; i++) if (scanf("%la", &x[i]) != 1) return 0;
    bars_step(&m, x);
    printf("%a %a\\n", m.out[0], m.out[1]);
  }
}
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_exported_c_gives_the_bounds_of_watch_bit_for_bit(tmp_path, monkeypatch):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path / "cache"))
    rng = np.random.default_rng(6)
    for _ in range(6):
        while "sin" in (text := formula(rng, 2)) or "exp" in text or "**" in text:
            pass  # Their last digit is that of a library.
        bars = {name: bar for name, bar in BARS.items() if re.search(rf"\b{name}\b", text)}
        monitor = vj.mtl.watch(text, DT, error_bars=bars)
        assert monitor.compiled
        header = vj.mtl.export_c(text, DT, "bars", error_bars=bars)
        columns = re.findall(r"^ \* x\[\d+\] (\w+)$", header, re.MULTILINE)
        (tmp_path / "bars.h").write_text(header)
        (tmp_path / "main.c").write_text(MAIN.replace("@", str(len(columns))))
        flags = ["-O2", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off"]
        subprocess.run(["gcc", *flags, "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
        signals = recorded(rng)
        rows = np.stack([signals[name] for name in columns], axis=1)
        given = "\n".join(" ".join(float(v).hex() for v in row) for row in rows)
        run = subprocess.run(
            ["./main"], cwd=tmp_path, input=given, text=True, check=True, capture_output=True
        )
        seen = [[float.fromhex(v) for v in line.split()] for line in run.stdout.splitlines()]
        np.testing.assert_array_equal(np.array(seen), monitor.steps(signals))


def test_a_quantity_is_completed_before_its_bounds_are_taken():
    trace = vj.Trace({"speed": np.full(2, 36.0)}, dt=1.0, units={"speed": "m/s"})
    formula = "always speed <= 130 km/h"
    assert vj.mtl.judge(formula, trace, error_bars={"speed": 0.05}).rows[0].verdict == "holds"
    assert vj.mtl.judge(formula, trace, error_bars={"speed": 0.2}).rows[0].verdict == "depends"


@pytest.mark.parametrize("text", ["rate(x) < 1", "peak_to_peak(x, 2) < 1", "at_last(x > 0, z) < 1"])
def test_functions_without_bounds_are_refused(text):
    with pytest.raises(ValueError, match="has no bounds for signals with error bars"):
        with_bars(vj.mtl.parse(text), {"x": 0.1})
