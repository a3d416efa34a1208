"""A process that falsifies many problems keeps nothing of those that are gone."""

import ast
import collections
import gc
import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import pytest

import verifai_jax as vj
from verifai_jax.core.compute.compilation import KEPT, jit_each
from verifai_jax.core.values.trace import Trace


def problem(number, steps=40):
    def rates(time, state, control, features):
        rate = state["rate"]
        return {"angle": rate, "rate": -jnp.sin(state["angle"]) - (0.1 + 0.01 * number) * rate}

    system = vj.ode(
        rates,
        lambda features, key: {"angle": features["x0"], "rate": 0.0 * features["x0"]},
        dt=0.05,
        duration=0.05 * steps,
        signals=lambda time, state, control, features: {"angle": state["angle"]},
    )
    return vj.Problem("swing", {"x0": vj.Box(-1, 1)}, system, f"always (angle < 0.5{number:03d})")


def ours():
    """Count the living objects of this package by class, which belong to single problems."""
    gc.collect()
    names = (type(each).__qualname__ for each in gc.get_objects()
             if str(type(each).__module__).startswith("verifai_jax."))  # fmt: skip
    owned = {"Problem", "Engine", "RowProgram", "Compilation", "Evaluator", "NativeProgram", "Run"}
    return collections.Counter(name for name in names if name in owned)


@pytest.mark.slow
def test_problems_and_their_programs_are_freed():
    def run(number):
        vj.falsify(problem(number, 5), "uniform", 20, progress=False, confirm=False)

    run(0)
    before = ours()  # The programs of the search are those of the next problems.
    for number in range(1, 4):
        run(number)
    assert ours() - before == collections.Counter()


@pytest.mark.slow
def test_formulas_that_were_judged_are_bounded():
    trace = Trace({"x": jnp.zeros(3)}, dt=0.1)
    calls = []

    @jit_each()
    def traced(value, x):
        calls.append(value)
        return value * x

    for value in [*range(2 * KEPT), 2 * KEPT - 1, 0]:
        assert traced(value, 2.0) == 2 * value
    # The last ones are kept, the first one is not.
    assert calls == [*range(2 * KEPT), 0]
    assert vj.robustness("always (x < 1)", trace) == 1


SOAK = """
import gc, sys
sys.path.insert(0, sys.argv[1])
from test_memory import problem, vj

def resident():
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 2**20

for number in range(123):
    vj.falsify(problem(number), "uniform", 100, progress=False)
    if number == 39:  # Programs of the last ones are kept.
        few = resident()
print(few, resident())
"""


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="there is no /proc")
def test_many_problems_need_little_more_memory_than_forty(tmp_path):
    environment = {**os.environ, "VERIFAI_JAX_CACHE": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", SOAK, os.path.dirname(__file__)], env=environment,
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    few, many = map(float, done.stdout.split())
    assert many - few < 20


@pytest.mark.slow
def test_no_function_of_a_module_keeps_all_its_static_arguments():
    for file in Path(vj.__file__).parent.rglob("*.py"):
        for node in ast.parse(file.read_text()).body:
            decorators = getattr(node, "decorator_list", [])
            for each in decorators:
                assert "static_arg" not in ast.unparse(each), f"{file}:{each.lineno}: use jit_each"
