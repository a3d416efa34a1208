"""Errors planted in a copy of the package, one at a time, and caught by the oracle that should.

python tests/addons/assurance/qualification/test_planted_errors.py E03 E17     # some of them, with what fell
"""
# ruff: noqa: E501 - what stands in the package, and what is planted, are read side by side

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from verifai_jax.addons.assurance.qualification import qualify
from verifai_jax.addons.assurance.qualification._qualify import not_exercised
from verifai_jax.addons.assurance.qualification.oracles import ORACLES
from verifai_jax.addons.assurance.qualification.result import HAZARDS

ROOT = Path(__file__).parents[4]

EVALUATE, BINOMIAL, DISTRIBUTIONS = (
    "mtl/evaluate.py",
    "statistics/binomial.py",
    "features/distributions.py",
)
PLANTED = {
    "E01": (EVALUATE, "min(first + count - 1 + int(b), end)", "max(begin, min(first + count - 2 + int(b), end))"),
    "E02": ("mtl/windows.py", "if sign > 0 else jnp.min(x, axis=0)", "if sign > 0 else jnp.max(x, axis=0)"),
    "E03": (EVALUATE, "terms.append(self._future(f, -1, 0, a - 1, first, last))", "pass"),
    "E04": (EVALUATE, "return -self.value(operand, first, last)", "return self.value(operand, first, last)"),
    "E05": ("mtl/formula.py", "return Or((Not(self), formula(other)))", "return Or((Not(formula(other)), self))"),
    "E06": ("mtl/semantics.py", "margin = right - left", "margin = left - right"),
    "E07": ("mtl/formula.py", 'return "implies", (p, q), None', 'return "implies", (q, p), None'),
    "E08": (EVALUATE, 'return self.end != "truncate"', "return False"),
    "E09": ("mtl/semantics.py", "else margin > 0", "else margin >= 0"),
    "E10": ("mtl/semantics.py", "holds = margin >= 0 if", "holds = margin > 0 if"),
    "E11": ("evaluation/verdicts.py", "broken |= undecided & ~np.all(holds(), axis=1)", "broken |= undecided"),
    "E12": ("mtl/windows.py", "return fixed + sign * tau * jnp.log(total)", "return m + sign * tau * jnp.log(total)"),
    "E13": ("mtl/windows.py", "return fixed + sign * tau * jnp.log(jnp", "return fixed + 0.1 + sign * tau * jnp.log(jnp"),
    "E14": ("evaluation/verdicts.py", "broken = proper & (lowest < 0)", "broken = proper & (lowest < -0.1)"),
    "E15": ("evaluation/verdicts.py", "broken = proper & (lowest < 0)", "broken = proper & (lowest < 0.1)"),
    "E16": ("falsification/table_view.py", "self._frame = self._concatenate(frames)", "self._frame = self._concatenate(frames).iloc[1:]"),
    "E17": ("falsification/table_view.py", "            if self._batches:\n                frames.append(", "            if self._batches:\n                frames.append(to_frame(row_numbers(self._batches), merge(self._batches)).iloc[:1])\n                frames.append("),
    "E18": ("falsification/table.py", "        self._hold(first, batch)\n        if self._tail", '        batch["rho"] = np.roll(batch["rho"], 1)\n        self._hold(first, batch)\n        if self._tail'),
    "E19": ("falsification/counts.py", "counts.violating += int(np.sum(violating))", "counts.violating += int(np.sum(violating)) + 1"),
    "E20": ("falsification/counts.py", "index = indices[np.argmin(rho[indices])]", "index = indices[np.argmax(rho[indices])]"),
    "E21": ("search/uniform.py", "jax.random.uniform(key, (dim,), jnp.float32))(keys)", "jax.random.uniform(key, (dim,), jnp.float32) ** 2)(keys)"),
    "E22": ("evaluation/host_engine.py", "return RowVerdict(np.array(np.nan), int(status), np.array(True), message)", "return RowVerdict(np.array(-1.0), int(Status.OK), np.array(False), message)"),
    "E23": ("evaluation/verdicts.py", "finite &= jnp.all(jnp.isfinite(signal))", "finite &= True"),
    "E24": ("falsification/run.py", "undecided=undecided + without)", "undecided=undecided)"),
    "E25": (BINOMIAL, "tail = (1 - confidence) / 2", "tail = 1 - confidence"),
    "E26": ("statistics/confidence_sequences.py", "limit = log_mixture(k, n) + math.log(1 - confidence)", "limit = log_mixture(k, n) + math.log(10 * (1 - confidence))"),
    "E27": (BINOMIAL, "math.log1p(-confidence) / math.log1p(-rate) - 1e-9", "0.5 * math.log1p(-confidence) / math.log1p(-rate) - 1e-9"),
    "E28": ("addons/estimation/intervals.py", "n, total = len(x), float(x.sum())", "x = 5 * x\n    n, total = len(x), float(x.sum())"),
    "E29": ("addons/estimation/monte_carlo.py", "return upper_bound(self.failures + self.no_verdict, self.simulations, confidence)", "return upper_bound(self.failures, 1000 * self.simulations, confidence)"),
    "E30": ("features/box.py", "high - (1 - u) * width)", "high - (1 - u) * 0.9 * width)"),
    "E31": (DISTRIBUTIONS, "return self.mean + self.std * continuous.normal_score(u)", "return self.mean + self.std**2 * continuous.normal_score(u)"),
    "E32": (DISTRIBUTIONS, "return end * jnp.exp(jnp.where(left, u, u - 1) * self._width)", "return self.low + u * (self.high - self.low)"),
    "E33": ("features/choice.py", "np.cumsum(self.probabilities)", "np.linspace(0, 1, len(self.probabilities) + 1)[1:]"),
    "E34": ("systems/ode/integrators.py", "dt / 6 * (a + 2 * (b + c) + d)", "dt / 6 * (2 * a + 2 * (b + c))"),
    "E35": ("systems/ode/closed_loop.py", "substeps=self.substeps * factor)", "substeps=self.substeps)"),
    "E36": ("core/compute/keys.py", "int(seed) & 0xFFFFFFFF", '(int(seed) + __import__("time").time_ns()) & 0xFFFFFFFF'),
    "E37": ("core/compute/keys.py", "int(seed) & 0xFFFFFFFF", "0 & 0xFFFFFFFF"),
    "E38": ("evaluation/replay.py", "simulation_key(key, 0 if number is None else number)", "simulation_key(key, 1 if number is None else number + 1)"),
    "E39": ("falsification/_falsify.py", "            if checkpoint:\n                rounds.resume(checkpoint)", "            pass"),
    "E40": ("falsification/table.py", "            self._tail.put(tail_entry(first, batch))\n            return", "            return"),
    "E41": ("core/store/files.py", "    if own != record_checksum(record):", "    if False:"),
    "E42": ("search/cross_entropy.py", "            elite=elite,\n            score=jnp.where", "            elite=state.elite,\n            score=jnp.where"),
    "E43": ("falsification/running.py", "prior=origin == \"prior\"", "prior=True"),
    "E44": ("counterexamples/_shrink.py", "u = start[0] if verified is None else verified[0]", "u = at.u"),
    "E45": ("evaluation/confirmer.py", "fails = np.all(list(failing.values()), axis=0)\n        refuted", "fails = np.ones(len(found), bool)\n        refuted"),
    "E46": ("evaluation/confirmer.py", "fails = np.all(list(failing.values()), axis=0)\n        refuted", "fails = np.zeros(len(found), bool)\n        refuted"),
    "E47": ("addons/estimation/comparison/_compare.py", "_failing(evaluators[name], u, first)", "_failing(evaluators[name], u[::-1], first)"),
    "E48": ("addons/estimation/comparison/_compare.py", "self.failing.append((one[0], other[0]))", "self.failing.append((other[0], one[0]))"),
    "E49": ("addons/estimation/divergence.py", "near = _tilted(values, weights, middle)[1] <= radius", "near = _tilted(values, weights, middle)[1] <= radius / 2"),
    "E50": ("addons/estimation/divergence.py", "return 0.0 if limit <= p else binary_divergence(limit, p)", "return 0.0 if limit <= p else 2 * binary_divergence(limit, p)"),
    "E51": ("addons/verification/sets/whole.py", "(low < max(lower, -FAR)) | (high > min(upper, FAR))", "np.zeros((low + high).shape, bool)"),
    "E52": (
        "addons/verification/branch_and_bound.py",
        "np.add.at(boxes.samples, chosen[own], 1)",
        "np.add.at(boxes.samples, chosen[undecided[chosen]], 1)",
    ),
}  # fmt: skip
"""By identifier of the error: the file, what stands there, and what is planted in its place."""
BY_ERROR = {
    "a row of a recording is lost below its units": (
        "addons/monitoring/csv_tables.py",
        "skip_rows_after_names=int(units)",
        "skip_rows_after_names=2 * int(units)",
    ),
    "a truth value of a recording is read as its opposite": (
        "addons/monitoring/recording.py",
        "    trace = Trace(signals, dt=dt, times=times, notes=notes, units=units)",
        "    signals = {n: ~v if v.dtype == bool else v for n, v in signals.items()}\n    trace = Trace(signals, dt=dt, times=times, notes=notes, units=units)",
    ),
    "a recording always holds": ("addons/monitoring/judging.py", '"holds" if ', '"holds" if True or '),
    "a robustness on a recording is wrong": (
        "mtl/host_values.py",
        "                return -below[0]",
        "                return below[0]",
    ),
    "a monitor takes the least value for the greatest": ("mtl/streams.py", "delay, sign * f.sign, 0.0, a, b)", "delay, -sign * f.sign, 0.0, a, b)"),
    "a monitor forgets the beginning of a window": ("mtl/streams.py", 'return self.op("accumulate", (slot,), delay, sign * f.sign, 0.0, a, b)', 'return self.op("accumulate", (slot,), delay, sign * f.sign, 0.0, b, b)'),
    "a violation is not shown in the trace matrix": (
        "addons/assurance/traceability/evidence.py",
        "    if len(broken):",
        "    if len(broken) > 10**9:",
    ),
    "claims that were edited are believed": (
        "addons/assurance/traceability/evidence.py",
        "    if sealed(data) != data:",
        "    if False:",
    ),
}  # fmt: skip
"""The same by the text of the error."""
PLANTED |= {n: BY_ERROR[hazard.error] for n, hazard in HAZARDS.items() if hazard.error in BY_ERROR}

RUN = "import sys; from verifai_jax.addons.assurance.qualification import qualify; found = qualify(sys.argv[1:]);"
RUN += "print(found); sys.exit(10 if found.passed else 11)"


def plant(number: str, folder: Path) -> subprocess.CompletedProcess:
    """Plant an error in a copy of the package, and run the oracle that should catch it."""
    copied = folder / number / "verifai_jax"
    shutil.copytree(ROOT / "verifai_jax", copied, ignore=shutil.ignore_patterns("__pycache__"))
    file, old, new = PLANTED[number]
    text = (copied / file).read_text()
    assert old in text, (number, file, old)
    (copied / file).write_text(text.replace(old, new))
    options = {"PYTHONPATH": str(copied.parent), "VERIFAI_JAX_CACHE": "off"}
    return subprocess.run(
        [sys.executable, "-c", RUN, HAZARDS[number].oracle],
        cwd=folder, env={**os.environ, **options}, capture_output=True, text=True, check=False,
        timeout=300,
    )  # fmt: skip


def test_every_error_has_an_oracle_and_is_planted():
    assert len(HAZARDS) >= 40
    assert set(PLANTED) == set(HAZARDS)
    assert {hazard.oracle for hazard in HAZARDS.values()} == set(ORACLES)
    for number, (file, old, new) in PLANTED.items():
        assert old in (ROOT / "verifai_jax" / file).read_text(), number
        assert old != new


@pytest.mark.proves
@pytest.mark.parametrize("number", sorted(PLANTED))
# Each starts a process, and compiles what its oracle does.
def test_a_planted_error_is_caught(number, tmp_path):
    done = plant(number, tmp_path)
    assert done.returncode == 11, f"{HAZARDS[number].error}\n{done.stdout}{done.stderr}"


def test_an_oracle_falls_and_is_said_to(monkeypatch, tmp_path):
    def wrong():
        """Check that two is three."""
        raise AssertionError("two is two")

    monkeypatch.setitem(ORACLES, "divergences", wrong)
    found = qualify(["divergences"])
    assert not found.passed
    assert "divergences fell; others were not asked for" in str(found)
    page = found.save(tmp_path).read_text()
    assert "fell: AssertionError: two is two" in page
    assert page.count('class="blank"') == 9
    assert '"package_sha256"' in (tmp_path / "qualification.json").read_text()
    with pytest.raises(ValueError, match="'nothing'"):
        qualify(["nothing"])


def test_what_is_not_exercised_is_listed(monkeypatch):
    every = not_exercised([*ORACLES.values()])
    assert {"vj.mtl.judge", "vj.mtl.watch", "vj.falsify", "vj.estimate", "vj.resume"}.isdisjoint(
        every
    )
    assert {"vj.sweep", "vj.mtl.export_c"} <= set(every)
    root = sys.modules["verifai_jax"]
    monkeypatch.setattr(root, "__all__", [*root.__all__, "divine"])
    monkeypatch.setattr(root, "divine", lambda: None, raising=False)
    assert "vj.divine" in not_exercised([*ORACLES.values()])


@pytest.mark.slow
# All oracles, as a user runs them.
def test_all_oracles_pass_here():
    found = qualify()
    assert found.passed, str(found)
    assert found.complete


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as into:
        for each in sys.argv[1:] or sorted(PLANTED):
            result = plant(each, Path(into))
            fell = [line.strip() for line in result.stdout.splitlines() if "Error" in line]
            state = {11: "caught", 10: "NOT CAUGHT"}.get(
                result.returncode, "BROKE " + result.stderr[-300:]
            )
            print(each, state, *fell, flush=True)
            shutil.rmtree(Path(into) / each)
