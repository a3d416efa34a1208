"""Monitors on the host, compiled and in Python, against the definitions and the offline values."""

import shutil
import subprocess

import numpy as np
import pytest
from checked_types import unchecked
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mtl_oracle import DT, Oracle, formulas, recordings

from verifai_jax import mtl
from verifai_jax.addons.native.native_code.machine_code import COMPILERS
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.host_values import HostValues

QUICK = settings(
    max_examples=60, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip
NAMES = [f"f{k}" for k in range(12)]


def followed(some, **options):
    """Monitors of those formulas that bounded memory can follow."""
    kept = {}
    for name, f in some.items():
        try:
            mtl.watch(f, DT, **options)
        except ValueError:
            continue
        kept[name] = f
    return kept


def samples(recording):
    n = len(recording["x"])
    return [{name: values[k] for name, values in recording.items()} for k in range(n)]


def check_prefixes(some, recording):
    """Each prefix has its offline value, and lies in an interval that gets no wider."""
    some = followed(some)
    if not some:
        return
    monitor = mtl.watch(some, DT)
    final = {name: Oracle(recording).rho(f, 0) for name, f in some.items()}
    before = dict.fromkeys(some, (-np.inf, np.inf))
    for k, sample in enumerate(samples(recording)):
        monitor.step(sample)
        prefix = Oracle({name: values[: k + 1] for name, values in recording.items()})
        finish, (low, high) = monitor.finish(), monitor.interval()
        for name, f in some.items():
            assert finish[name] == prefix.rho(f, 0)
            assert before[name][0] <= low[name] <= final[name] <= high[name] <= before[name][1]
        before = {name: (low[name], high[name]) for name in some}


def check_every_instant(some, recording, boolean):
    semantics = mtl.boolean if boolean else mtl.hard
    some = followed(some, every=True, semantics=semantics)
    if not some:
        return
    monitor = mtl.watch(some, DT, every=True, semantics=semantics)
    values = HostValues({name: np.asarray(v) for name, v in recording.items()}, DT)
    first = [list(monitor.step(sample).values()) for sample in samples(recording)]
    out = np.concatenate([first, monitor.rest().reshape(-1, len(some))])
    for k, f in enumerate(some.values()):
        expected = np.broadcast_to(values.truth(f) if boolean else values(f), len(first))
        delay = monitor.delays[k]
        assert np.isnan(out[:delay, k]).all()
        np.testing.assert_array_equal(out[delay : delay + len(first), k], expected)


@pytest.fixture
def compiler(monkeypatch, tmp_path_factory):
    if not any(map(shutil.which, COMPILERS)):
        pytest.skip("there is no C++ compiler")
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path_factory.mktemp("cache")))


@given(formulas(3, counted=True), recordings(sizes=(1, 5, 7)))
@QUICK
def test_every_prefix_has_its_offline_value(formula, recording):
    check_prefixes({"f": formula}, recording)


@given(formulas(3, counted=True), recordings(sizes=(1, 5, 7)), st.booleans())
@QUICK
def test_every_instant_has_its_offline_value(formula, recording, boolean):
    check_every_instant({"f": formula}, recording, boolean)


@pytest.mark.slow
@given(
    st.lists(formulas(3, counted=True), min_size=9, max_size=12),
    recordings(sizes=(9,)),
    st.booleans(),
)
@settings(QUICK, max_examples=3)
def test_compiled_monitors_have_the_same_values(compiler, some, recording, boolean):
    named = dict(zip(NAMES, some, strict=False))
    assert mtl.watch("x > 0", DT).compiled
    # Each formula that cannot be followed is found without a compiler.
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VERIFAI_JAX_CACHE", "off")
        named = followed(followed(named), every=True)
    check_prefixes(named, recording)
    check_every_instant(named, recording, boolean)


def test_many_samples_at_once_are_the_samples_one_by_one():
    rng = np.random.default_rng(0)
    recording = {
        "x": rng.normal(size=50),
        "p": rng.normal(size=(50, 3)),
        "ok": rng.random(50) > 0.5,
    }
    formula = "ok -> ((x**3 / 2 - norm(p) > sin(x)) since[0, 3] (p[1] >= 0))"
    one, many = (mtl.watch(formula, 0.5, every=True, sizes={"p": 3}) for _ in range(2))
    values = many.steps(recording)
    stepped = [one.step({name: v[k] for name, v in recording.items()}) for k in range(50)]
    np.testing.assert_array_equal(values, stepped)
    assert len(many.steps({name: v[:0] for name, v in recording.items()})) == 0
    offline = HostValues.of(Trace(recording, dt=0.5))(mtl.parse(formula))
    np.testing.assert_allclose(values, offline, rtol=1e-15)


def test_a_future_formula_is_late_by_what_it_looks_ahead():
    monitor = mtl.watch("eventually[0, 1] x > 0", 0.5, every=True)
    assert monitor.delays == (2,)
    assert [monitor.step({"x": x}) for x in (1.0, -1.0, -3.0, 4.0)][2:] == [1.0, 4.0]
    assert monitor.interval() == (4.0, np.inf)
    assert monitor.finish() == 4.0
    assert list(monitor.rest()) == [4.0, 4.0]


def test_a_gap_is_no_verdict_until_no_window_sees_it():
    monitor = mtl.watch("historically[0, 1] x > 0", 0.5, every=True)
    seen = [monitor.step({"x": x}) for x in (1.0, None, 2.0, 3.0, 4.0)]
    np.testing.assert_array_equal(seen, [1.0, np.nan, np.nan, np.nan, 2.0])


def test_a_false_value_is_below_zero():
    monitor = mtl.watch("once ok", 0.5, every=True)
    seen = [monitor.step({"ok": ok}) for ok in (False, 0.0, np.True_)]
    assert seen == [-1.0, 0.0, 1.0]


def test_formulas_share_what_they_have_in_common():
    monitor = mtl.watch({"a": "always (x > 0 -> eventually[0, 9] y > 0)", "b": "always x > 0"}, 1.0)
    assert monitor.step({"x": 1.0, "y": 2.0})["b"] == 1.0
    slow = "(eventually[0, 9] y > 0)"
    same = mtl.export_c({"a": f"always {slow}", "b": f"{slow} until (x > 0)"}, 1.0)
    assert same.count("vj_window(1, m->") == 1


def test_a_norm_needs_a_size_and_a_sample_its_signals():
    with pytest.raises(ValueError, match=r'norm\(p\) needs .*: give it, as in sizes=\{"p": 3\}'):
        mtl.watch("always norm(p) < 1", 0.1)
    with pytest.raises(UnknownNameError, match="the sample has no signal 'speed'; did you mean"):
        mtl.watch("always speed > 0", 0.1).step({"sped": 1.0})
    with pytest.raises(ValueError, match=r"signals have one length; got \{'x': 2, 'y': 3\}"):
        mtl.watch("x > y", 0.1).steps({"x": [1.0, 2.0], "y": [1.0, 2.0, 3.0]})
    with pytest.raises(TypeError, match="signal 'x' must hold real numbers"):
        mtl.watch("x > 0", 0.1).step({"x": "fast"})
    with pytest.raises(ValueError, match="looks ahead without end within another operator"):
        mtl.watch("always x > 0", 0.1, every=True)
    with unchecked(), pytest.raises(ValueError, match="the windows hold 999999999 samples"):
        mtl.watch("always eventually[0, 999999998] x > 0", 1.0)
    with pytest.raises(ValueError, match="needs one formula or more; got none"):
        mtl.watch({}, 1.0)
    with pytest.raises(ValueError, match="got smooth ones"):
        mtl.watch("x > 0", 0.1, semantics=mtl.smooth(0.1))


@pytest.mark.parametrize("name", ["", "2fast", "a-b", "ä"])
def test_a_name_that_c_does_not_know_is_refused(name):
    with pytest.raises(ValueError, match="the name of a monitor in C is a letter"):
        mtl.export_c("x > 0", 0.1, name)


TAKEN = (
    "int class exp expf NAN INFINITY EOF m x out low scratch a0 v12 i int32_t uint8_t isnan j0 y1 "
    "vj_best true bool signbit fabs pow log2 M typeof noexcept"
)
FREE = ("monitor", "gap", "mm", "exp_monitor", "a", "v", "signals", "j2", "scan", "logs")


@pytest.mark.parametrize("name", TAKEN.split())
def test_a_name_that_c_or_the_code_uses_is_refused(name):
    with pytest.raises(ValueError, match=f"must be free in C.* {name.lower()}_monitor"):
        mtl.export_c("x > 0", 0.1, name)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_headers_of_free_names_and_of_odd_signals_compile_without_a_warning(tmp_path):
    formula = "always[0, 0.3] (exp(x) > 0 & max(y, 1) < 3)"
    odd = ("a*/b", "a/*b", "a??/b", "a\\", "a\u202eb", "a**//b")
    texts = [mtl.export_c(formula, 0.1, name) for name in FREE]
    texts += [mtl.export_c({name: formula}, 0.1) for name in odd]
    for text in texts:
        (tmp_path / "all.c").write_text(f"{text}\nint main(void) {{ return 0; }}\n")
        for language in ("c", "c++"):
            command = ["gcc", "-x", language, "-Wall", "-Wextra", "-Werror", "-trigraphs"]
            command += ["-Wno-unused-function", "-fsyntax-only", tmp_path / "all.c"]
            subprocess.run(command, check=True)


MAIN = r"""
#include <stdio.h>
int main(void) {
  static monitor m, scratch;
  double x[@n], low[@k], high[@k], end[@k];
  int length;
  while (scanf("%d", &length) == 1) {
    monitor_start(&m);
    for (int i = 0; i < length; i++) {
      for (int j = 0; j < @n; j++) if (scanf("%lf", &x[j]) != 1) return 1;
      monitor_step(&m, x);
    }
    monitor_interval(&m, &scratch, low, high);
    monitor_finish(&m, &scratch, end);
    for (int j = 0; j < @k; j++)
      printf("%.17g %.17g %.17g %.17g\n", m.out[j], low[j], high[j], end[j]);
  }
  return 0;
}
"""


@pytest.mark.slow
@given(st.lists(formulas(3, counted=True), min_size=9, max_size=12), st.integers(0, 2**31))
@settings(QUICK, max_examples=2)
def test_the_exported_header_is_sound_c_and_has_the_same_values(tmp_path_factory, some, seed):
    tool = next(filter(None, map(shutil.which, ("gcc", "clang"))), None)
    if tool is None:
        pytest.skip("there is no C compiler")
    named = followed(dict(zip(NAMES, some, strict=False)))
    folder, monitor = tmp_path_factory.mktemp("c"), mtl.watch(named, DT)
    header = mtl.export_c(named, DT)
    columns = [line.split()[2] for line in header.splitlines() if line.startswith(" * x[")]
    main = MAIN.replace("@n", str(max(1, len(columns)))).replace("@k", str(len(named)))
    (folder / "monitor.c").write_text(header + main)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-ffp-contract=off"]
    sanitize = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    command = [tool, *flags, *sanitize, "monitor.c", "-o", "monitor", "-lm"]
    subprocess.run(command, cwd=folder, check=True, timeout=120)
    rng = np.random.default_rng(seed)
    fed, expected = [], []
    for length in rng.integers(1, 30, size=40):
        recording = {
            name: np.round(4 * rng.normal(size=shape)) / 4
            for name, shape in {"x": length, "y": length, "p": (length, 2)}.items()
        }
        monitor = mtl.watch(named, DT)
        for sample in samples(recording):
            out = monitor.step(sample)
        (low, high), end = monitor.interval(), monitor.finish()
        expected += [[out[f], low[f], high[f], end[f]] for f in named]
        rows = [recording[c] if "[" not in c else recording[c[0]][:, int(c[2])] for c in columns]
        table = np.stack(rows, axis=1) if rows else np.zeros((length, 1))
        fed.append(f"{length} " + " ".join(map(repr, table.ravel().tolist())))
    ran = subprocess.run(
        ["./monitor"], cwd=folder, input="\n".join(fed), text=True, capture_output=True,
        check=True, timeout=120,
    )  # fmt: skip
    got = [[float(word) for word in line.split()] for line in ran.stdout.splitlines()]
    np.testing.assert_array_equal(got, expected)
