"""Requirements of a set: contradictions, duplicates, implications, and units that differ."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from verifai_jax import mtl
from verifai_jax.addons.monitoring.across import across
from verifai_jax.addons.monitoring.commands.formula import lint
from verifai_jax.addons.monitoring.demands import Demands
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.host_values import HostValues

PAIRS = {
    ("always speed < 30", "always speed > 35"): "contradiction by proof",
    ("always x < 3", "eventually[0, 5] x > 4"): "contradiction by proof",
    ("always (x > 1 & y > 1)", "always x + y < 2"): "contradiction by proof",
    ("always x == 1", "always x > 1"): "contradiction by proof",
    ("always (a > 1 -> b < 0)", "always (a > 2 -> b > 1)"): "contradiction by proof",
    ("always speed < 30", "always speed <= 30"): "implied by proof",
    ("always x < 0.3", "always 3 * x <= 0.9"): "implied by proof",
    ("always[0, 9] x > 2", "eventually[1, 3] x > 1"): "implied by proof",
    ("eventually[0, 5] x > 4", "eventually[0, 9] x > 3"): "implied by proof",
    ("always abs(x) <= 2", "always (x <= 2 & x >= -2)"): "duplicate by proof",
    ("always !(x > 3)", "always x <= 3"): "duplicate by proof",
    ("always 2 * (x - 1) < 4", "always x < 3"): "duplicate by proof",
    ("always (a > 0 -> eventually[0, 2] b > 0)", "always (a > 0 -> eventually[0, 5] b > 0)"):
        "implied by search",
    ("(once[0, 2] x > 0) until y > 0", "eventually y > 0"): "implied by search",
    ("always (a > 1 -> b < 0)", "always (a < 0 -> b > 1)"): "",
    ("always[0, 5] x < 1", "always[6, 9] x > 2"): "",
    ("always[0, 5) x < 1", "always[5, 9] x > 2"): "",
    ("always x < 3", "always y < x"): "",
    ("always x < 3", "always z < 5"): "",
    ("always x < 3", "eventually[0, 5] x > 2"): "",
    ("eventually[0, 5] x > 4", "eventually[0, 5] x < 3"): "",
}  # fmt: skip


@pytest.mark.parametrize("pair", PAIRS, ids=" and ".join)
def test_pairs_are_told_with_how_it_is_known(pair):
    found, left = across({f"R{k}": mtl.parse(text) for k, text in enumerate(pair)})
    said = [f"{f.kind} by {'proof' if '(by proof)' in f.sentence else 'search'}" for f in found]
    assert (said, left) == ([PAIRS[pair]] if PAIRS[pair] else [], 0)


def test_conditional_contradictions_name_the_conditions():
    texts = ("always (wet > 0 -> v < 10)", "always (late > 0 -> v > 12)")
    found, _ = across({f"R{k}": mtl.parse(text) for k, text in enumerate(texts)})
    assert found[0].sentence.startswith(
        "together with R0 it asks for v < 10 and v > 12 at once where wet > 0 and late > 0"
    )


def random_requirement(rng, lefts):
    def predicate():
        left = rng.choice(lefts)
        return f"{left} {rng.choice(['<', '<=', '>', '>=', '=='])} {rng.integers(-2, 3)}"

    a, b = sorted(int(k) for k in rng.integers(0, 3, 2))
    inner = rng.choice(["({})", "({})", "({} & {})", "({} | {})", "({} -> {})"])
    window = f"{rng.choice(['always', 'eventually'])}[{a},{b}]"
    return mtl.parse(f"{window} {inner.format(predicate(), predicate())}")


def proofs_hold(seeds, lefts=("x", "x", "abs(x)", "-x", "x + y", "2 * x - y")):
    proved = 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        f, g = (random_requirement(rng, lefts) for _ in range(2))
        one, other = Demands.of(f), Demands.of(g)
        # Few levels make all cases come, also equality.
        signals = {name: rng.integers(-6, 7, (3, 1000)) / 2 for name in "xy"}
        values = HostValues(signals, 1.0, lanes=1)
        a, b = (values.truth(each)[0] > 0 for each in (f, g))
        clash = one.clash(other)
        if clash is not None and not clash[3]:
            proved += 1
            assert not (a & b).any(), (seed, f, g)
        if one.implies(other):
            proved += 1
            assert not (a & ~b).any(), (seed, f, g)
    return proved


def test_no_trace_contradicts_a_proof():
    assert proofs_hold(range(100), ["x"]) > 2


@pytest.mark.slow
def test_no_trace_contradicts_many_proofs():
    assert proofs_hold(range(60, 2000)) > 60


def test_a_set_is_checked_in_the_units_of_its_signals():
    recordings = [
        Trace({"speed": np.linspace(0, 30, 9)}, dt=1.0, units={"speed": unit})
        for unit in ("km/h", "m/s")
    ]
    texts = {"R1": "always speed < 30 km/h", "R2": "always speed > 35 m/s"}
    found = mtl.lint(texts, recordings)
    assert [f.kind for f in found] == ["never holds", "units", "contradiction"][-len(found) :]
    assert "speed is in km/h in recording 1 and m/s in recording 2" in str(found)


def test_many_pairs_are_told_to_be_compared_by_proof_alone():
    formulas = {f"R{k}": mtl.parse(f"F[0,{k + 1}] (x > {k} & y > 1)") for k in range(4)}
    assert across(formulas, searched=2)[1] == 4
    assert (
        "3 pairs of formulas were compared by proof alone"
        in mtl.lint("always x > 1").__class__((), (), 0, (), 3).summary()
    )


def test_the_command_reads_several_files(tmp_path):
    for name, text in (("a", "always speed < 30"), ("b", "always speed > 35")):
        (tmp_path / f"{name}.toml").write_text(
            f'[[requirement]]\nid = "limit"\nformula = "{text}"\n'
        )
    files = [str(tmp_path / "a.toml"), str(tmp_path / "b.toml")]
    result = CliRunner().invoke(lint, [*files, "--json", "--fail-on", "finding"])
    found = json.loads(result.stdout)
    assert result.exit_code == 1
    assert [f["kind"] for f in found["findings"]] == ["contradiction"]
    assert found["findings"][0]["requirement"].startswith("limit (")
