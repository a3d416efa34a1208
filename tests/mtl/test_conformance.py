"""Cases that at least two other monitors and a brute-force oracle agree on."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import boolean, parse, robustness, robustness_signal, satisfied

CASES = json.loads((Path(__file__).parent / "conformance.json").read_text())["cases"]


@pytest.fixture(params=["float32", pytest.param("float64", marks=pytest.mark.thorough)])
def precision(request):
    with jax.enable_x64(request.param == "float64"):
        yield request.param


def trace_of(case, precision):
    signals = {name: np.asarray(v, precision) for name, v in case["signals"].items()}
    return Trace(signals, dt=case["period"])


# Each case is a program of its own; a third of them is enough while one works.
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=case["id"], marks=[pytest.mark.thorough] * bool(i % 3))
        for i, case in enumerate(CASES)
    ],
)
def test_agrees_with_other_monitors(case, precision):
    trace, index = trace_of(case, precision), case["eval_index"]
    tolerance = {"float64": 1e-6, "float32": 1e-4}[precision]
    formula = parse(case["formula"])

    @jax.jit  # One program for everything: compiling is what takes the time.
    def run(signals):
        trace = Trace(signals, dt=case["period"])
        values = {}
        for end in ("hold", "truncate"):
            values[end] = [robustness_signal(formula, trace, end=end)[index]]
            if index == 0:
                values[end].append(robustness(formula, trace, end=end))
        verdicts = [robustness_signal(formula, trace, boolean)[index] > 0]
        if index == 0:
            verdicts.append(satisfied(formula, trace))
        return values, verdicts

    values, verdicts = run(dict(trace.signals))
    for end, expected in (("hold", case["rho"]), ("truncate", case["rho_truncate"])):
        for value in values[end]:
            assert value.dtype == jnp.dtype(precision)
            np.testing.assert_allclose(value, float(expected), rtol=0, atol=tolerance)
    assert all(bool(verdict) == case["satisfied"] for verdict in verdicts)
