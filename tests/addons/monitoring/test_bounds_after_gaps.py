"""Monitors after gaps, against the definitions with the extreme values in the gaps."""

import shutil
import subprocess

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mtl_oracle import DT, Oracle, formulas, numbers
from test_watching import MAIN, NAMES, followed, samples

from verifai_jax import mtl
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import Arithmetic

QUICK = settings(
    max_examples=60, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip


@st.composite
def broken(draw, size=6):
    """A recording, and the same with gaps."""
    columns = [draw(numbers(size)) for _ in "xyab"]
    gap = st.lists(st.sampled_from([False, False, True]), min_size=size, max_size=size)
    hidden = [
        [np.nan if g else v for v, g in zip(column, draw(gap), strict=True)] for column in columns
    ]
    named = [
        {"x": x, "y": y, "p": list(zip(a, b, strict=True))} for x, y, a, b in (columns, hidden)
    ]
    return named[0], named[1]


class Bounds(Oracle):
    """The definitions, in which an unknown predicate is the greatest (or the least) value."""

    def __init__(self, signals, side, boolean=False):
        # What is to come is unknown, too, and the oracle holds it.
        super().__init__(
            {k: [*v, (np.nan, np.nan) if k == "p" else np.nan] for k, v in signals.items()}
        )
        self.side, self.boolean = side, boolean
        self.opposite = self if side > 0 else Bounds(signals, 1, boolean)
        if side < 0:
            self.opposite.opposite = self

    def number(self, e, i):
        if isinstance(e, Arithmetic) and e.name in ("min", "max"):
            values = [self.number(a, i) for a in e.arguments]
            return float((np.min if e.name == "min" else np.max)(values))
        return super().number(e, i)

    def _rho(self, f, i):
        if isinstance(f, ast.Not):
            return -self.opposite.rho(f.operand, i)
        value = super()._rho(f, i)
        if isinstance(f, ast.Leaf):
            if np.isnan(value):
                value = self.side * np.inf
            elif self.boolean:
                value = 1.0 if self.holds(f, i) else -1.0
        return float(np.clip(value, -1, 1)) if self.boolean else value


def bounds(f, signals, boolean=False):
    low = Bounds(signals, -1, boolean)
    return low.rho(f, 0), low.opposite.rho(f, 0)


@pytest.fixture
def uncompiled(monkeypatch):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", "off")


@pytest.mark.thorough
@given(formulas(3), broken(), st.booleans())
@QUICK
def test_the_interval_is_what_the_gaps_and_the_future_allow(uncompiled, formula, both, boolean):
    whole, hidden = both
    semantics = mtl.boolean if boolean else mtl.hard
    if not followed({"f": formula}, semantics=semantics):
        return
    monitor = mtl.watch(formula, DT, semantics=semantics)
    before = -np.inf, np.inf
    for k, sample in enumerate(samples(hidden)):
        monitor.step(sample)
        low, high = monitor.interval()
        assert (low, high) == bounds(formula, {n: v[: k + 1] for n, v in hidden.items()}, boolean)
        assert before[0] <= low <= high <= before[1]
        before = low, high
    if not boolean:
        assert before[0] <= Oracle(whole).rho(formula, 0) <= before[1]


@pytest.mark.thorough
@given(formulas(2, counted=True), broken(), st.lists(st.floats(-1e9, 1e9), min_size=24))
@QUICK
def test_no_value_in_the_gaps_leaves_the_interval(uncompiled, formula, both, extremes):
    _, hidden = both
    if not followed({"f": formula}):
        return
    monitor = mtl.watch(formula, DT)
    monitor.steps(hidden)
    low, high = monitor.interval()
    fill = iter(extremes * 2)

    def filled(value):
        if isinstance(value, tuple):
            return tuple(map(filled, value))
        return next(fill) if np.isnan(value) else value

    final = Oracle({name: [filled(v) for v in values] for name, values in hidden.items()})
    assert low <= final.rho(formula, 0) <= high


@pytest.mark.parametrize("compiled", [False, True])
def test_a_later_sample_decides_whatever_a_gap_hid(compiled, monkeypatch):
    if not compiled:
        monkeypatch.setenv("VERIFAI_JAX_CACHE", "off")
    monitor = mtl.watch({"all": "always x > 0", "one": "eventually x > 0"}, 1.0)
    for x in (1.0, None, 2.0):
        monitor.step({"x": x})
    low, high = monitor.interval()
    assert (low, high) == ({"all": -np.inf, "one": 2.0}, {"all": 1.0, "one": np.inf})
    assert np.isnan(monitor.step({"x": -3.0})["all"])
    assert monitor.interval()[1]["all"] == -3.0
    assert np.isnan(monitor.finish()["all"])
    newest = mtl.watch("historically[0, 1] x > 0", 1.0, every=True)
    seen = [newest.step({"x": x}) and newest.interval() for x in (1.0, None, -2.0, 4.0, 5.0)]
    assert seen == [(1, 1), (-np.inf, 1), (-np.inf, -2), (-2, -2), (4, 4)]


@pytest.mark.slow
@given(formulas(2), broken(4))
@settings(QUICK, max_examples=15)
def test_the_monitor_in_jax_has_the_same_interval(formula, both):
    if not followed({"f": formula}):
        return
    with jax.enable_x64(True), jax.disable_jit():
        monitor = mtl.online(formula, DT)
        state = monitor.init()
        for sample in samples(both[1]):
            state = monitor.step(state, {name: np.asarray(v) for name, v in sample.items()})
        interval = tuple(map(float, monitor.interval(state)))
    assert interval == bounds(formula, both[1])


def test_a_monitor_in_jax_decides_after_a_gap():
    with jax.disable_jit():
        for gaps, ends in ((True, (-np.inf, -3.0)), (False, (np.nan, np.nan))):
            monitor = mtl.online("always x > 0", 1.0, gaps=gaps)
            state = monitor.init()
            for x in (1.0, np.nan, -3.0):
                state = monitor.step(state, {"x": x})
            np.testing.assert_array_equal(monitor.interval(state), ends)
            assert np.isnan(monitor.finish(state))
        assert monitor.memory < mtl.online("always x > 0", 1.0).memory


@pytest.mark.slow
@given(st.lists(formulas(3, counted=True), min_size=9, max_size=12), st.lists(broken(), min_size=9))
@settings(QUICK, max_examples=2)
def test_the_exported_header_has_the_same_interval(tmp_path_factory, some, recordings):
    tool = next(filter(None, map(shutil.which, ("gcc", "clang"))), None)
    if tool is None:
        pytest.skip("there is no C compiler")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VERIFAI_JAX_CACHE", "off")
        named = followed(dict(zip(NAMES, some, strict=False)))
        fed, expected = [], []
        header = mtl.export_c(named, DT)
        columns = [line.split()[2] for line in header.splitlines() if line.startswith(" * x[")]
        for _, hidden in recordings:
            monitor = mtl.watch(named, DT)
            for sample in samples(hidden):
                out = monitor.step(sample)
            (low, high), end = monitor.interval(), monitor.finish()
            expected += [[out[f], low[f], high[f], end[f]] for f in named]
            values = {n: np.asarray(v, float) for n, v in hidden.items()}
            rows = [values[c] if "[" not in c else values[c[0]][:, int(c[2])] for c in columns]
            table = np.stack(rows, axis=1) if rows else np.zeros((6, 1))
            fed.append("6 " + " ".join(map(repr, table.ravel().tolist())))
    folder = tmp_path_factory.mktemp("c")
    main = MAIN.replace("@n", str(max(1, len(columns)))).replace("@k", str(len(named)))
    (folder / "monitor.c").write_text(header + main)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-ffp-contract=off"]
    sanitize = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    command = [tool, *flags, *sanitize, "monitor.c", "-o", "monitor", "-lm"]
    subprocess.run(command, cwd=folder, check=True, timeout=120)
    ran = subprocess.run(
        ["./monitor"], cwd=folder, input="\n".join(fed), text=True, capture_output=True,
        check=True, timeout=120,
    )  # fmt: skip
    got = [[float(word) for word in line.split()] for line in ran.stdout.splitlines()]
    np.testing.assert_array_equal(got, expected)
