"""What a user's code does wrong is told in words, with the line of the user's own file."""

import json
import math
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.messages.errors import MissingExtra, require
from verifai_jax.core.user_code.user_errors import explain_user_error, format_user_error, user_line

SPACE = vj.FeatureSpace(
    {
        "mass": vj.Box(0, 1),
        "car": vj.Struct({"speed": vj.Box(0, 1)}),
        "wind": vj.Signal(vj.Box(-1, 1), 4),
    }
)
HERE = Path(__file__)
LINES = HERE.read_text().splitlines()


def number_of(code):
    return next(n for n, line in enumerate(LINES, start=1) if code in line)


def constant(x):
    return vj.Trace({"x": x * jnp.ones(3)}, dt=0.1)


class State(NamedTuple):
    place: float = 0.0


def misspelt(f, key):
    return constant(f["mas"])


def misspelt_part(f, key):
    return constant(f["car"]["sped"])


def read_as_an_attribute(f, key):
    return constant(f.mass)


def own_dictionary(f, key):
    gains = {"proportional": 1.0}
    return constant(gains["proportion"])


def own_tuple(f, key):
    return constant(State().plac)


def branches(f, key):
    if f["mass"] > 0.5:
        return constant(1.0)
    return constant(0.0)


def converts(f, key):
    return constant(float(f["mass"]))


def uses_math(f, key):
    return constant(math.sin(f["mass"]))


def counts(f, key):
    return constant(sum(range(int(f["mass"]))))


def counts_a_traced_integer(f, key):
    return constant(sum(range(f["mass"].astype(jnp.int32))))


def uses_numpy(f, key):
    return constant(np.sin(f["mass"]))


def indexes_a_list(f, key):
    return constant([1.0, 2.0][f["mass"].astype(int)])


def selects(f, key):
    values = f["mass"] * jnp.arange(3.0)
    return constant(values[values > 1].sum())


def signal_as_a_number(f, key):
    return constant(2.0 * f["wind"])


def signal_in_jax(f, key):
    return constant(jnp.sin(f["wind"]))


def signal_in_numpy(f, key):
    return constant(np.sin(f["wind"]))


def signal_indexed(f, key):
    return constant(f["wind"][0])


def length_of_an_array(f, key):
    return constant(jnp.zeros(f["mass"].astype(int)).sum())


def piece_of_an_array(f, key):
    return constant(jnp.ones(9)[: f["mass"].astype(int)].sum())


def key_of_a_dictionary(f, key):
    return constant({0: 1.0}[f["mass"]])


def writes_a_text(f, key):
    return constant(float(f"{f['mass']:.2f}"))


def writes_into_numpy(f, key):
    values = np.zeros(3)
    values[0] = f["mass"]
    return constant(values.sum())


def list_as_a_signal(f, key):
    return vj.Trace({"x": [f["mass"], 1.0]}, dt=0.1)


def function_as_a_signal(f, key):
    return vj.Trace({"x": f["wind"]}, dt=0.1)


def period_that_varies(f, key):
    return vj.Trace({"x": jnp.ones(3)}, dt=f["mass"])


def loops(f, key):
    summed = jax.lax.scan(lambda c, _: (jnp.sum(c), c), jnp.ones(3), None, 5)[0]
    return constant(summed * f["mass"])


CALLED = "call it with a time in seconds"
WRONG = [
    (misspelt, '["mas"]', "there is no feature 'mas'; did you mean 'mass'? The features are"),
    (misspelt_part, '["sped"]', "`f['car']` has no 'sped'; did you mean 'speed'? It has speed"),
    (read_as_an_attribute, "f.mass)", "'mass' is read by ['mass'], not by .mass"),
    (own_dictionary, '["proportion"]', "`gains` has no 'proportion'; did you mean 'proportional'?"),
    (own_tuple, "State().plac", "there is no 'plac'; did you mean 'place'?"),
    (branches, 'if f["mass"] > 0.5', "jnp.where(condition, one, other)"),
    (branches, 'if f["mass"] > 0.5', "vj.blackbox"),
    (converts, 'float(f["mass"])', "Leave out float()"),
    (uses_math, "math.sin(", "jnp instead of math"),
    (counts, "int(f[", "jax.lax.fori_loop"),
    (counts_a_traced_integer, "jnp.int32", "jax.lax.fori_loop"),
    (uses_numpy, 'np.sin(f["mass"])', "jnp in place of np"),
    (indexes_a_list, "[1.0, 2.0]", "jnp.array(the_list)"),
    (selects, "values > 1", "jnp.where(condition, values, other)"),
    (signal_as_a_number, '2.0 * f["wind"]', CALLED),
    (signal_in_jax, 'jnp.sin(f["wind"])', CALLED),
    (signal_in_numpy, 'np.sin(f["wind"])', CALLED),
    (signal_indexed, '["wind"][0]', CALLED),
    (length_of_an_array, "jnp.zeros(f", "jnp.where(jnp.arange(maximum) < length"),
    (piece_of_an_array, "jnp.ones(9)[", "jax.lax.dynamic_slice"),
    (key_of_a_dictionary, "{0: 1.0}[", "Index a jnp.array"),
    (writes_a_text, ":.2f", "jax.debug.print"),
    (writes_into_numpy, "values[0] = ", "jnp in place of np"),
    (list_as_a_signal, '[f["mass"], 1.0]', "join them with jnp.stack"),
    (function_as_a_signal, '{"x": f["wind"]}', "call it with the sample times"),
    (period_that_varies, 'dt=f["mass"]', "dt must be a plain number"),
    (loops, "lax.scan(", "carry input and carry output must have equal types"),
]


@pytest.mark.parametrize(("system", "code", "words"), WRONG)
def test_a_system_that_cannot_be_traced(system, code, words):
    problem = vj.Problem("p", SPACE, system, "always x < 2")
    with unchecked(), pytest.raises(vj.ProblemError) as raised:
        problem.check()
    message = str(raised.value)
    start = LINES[number_of(f"def {system.__name__}(") :]
    line = number_of(f"def {system.__name__}(") + 1 + [code in text for text in start].index(True)
    assert (
        f"test_user_errors.py, line {line}, in {system.__name__} (`{LINES[line - 1].strip()}`)"
        in message
    )
    assert words in message
    assert "\n" not in message
    assert len(message) < 700


def test_a_system_without_a_key():
    def forgetful(f):
        return constant(f["mass"])

    message = r"called with \(features, key\) \(tests.*test_user_errors.py, line \d+\)$"
    with pytest.raises(vj.ProblemError, match=message):
        vj.Problem("p", SPACE, forgetful, "always x < 2").check()


def test_the_parts_of_a_closed_loop():
    def start(f, key):
        return {"x": f["mass"]}

    def move(t, s, u, f):
        return {"x": s["y"]}

    def widen(t, s, u, f):
        return {"x": jnp.ones(3)}

    def count(t, s, m, f):
        return m, m + 0.5

    def stay(t, s, u, f):
        return {"x": 0.0}

    clock = {"dt": 0.1, "steps": 2}
    counting = {"controller": count, "controller_memory": 0}
    for loop, words in (
        (vj.ode(move, start, **clock), "`s` has no 'y'. It has x"),
        (vj.ode(widen, start, **clock), r"must have shape \[\], got \[3\] \(.*test_user_errors.py"),
        (vj.ode(stay, start, **counting, **clock), "begin with a real number, such as 0.0"),
    ):
        with pytest.raises(vj.ProblemError, match=words):
            vj.Problem("p", SPACE, loop, "always x < 2").check()


def test_a_black_box_says_where_it_raised():
    def simulate(features):
        raise RuntimeError("no road\n" + 100 * "and no map ")

    with unchecked():
        problem = vj.Problem("p", SPACE, vj.blackbox(simulate), "always x < 2")
        message = vj.falsify(problem, "uniform", 2).table.all["message"][0]
    line = number_of('raise RuntimeError("no road')
    assert message.startswith("RuntimeError: no road and no map")
    assert message.endswith(f"test_user_errors.py, line {line}, in simulate)")
    assert "\n" not in message
    assert len(message) < 500


def test_an_error_of_a_library_has_no_line_of_the_user():
    with pytest.raises(json.JSONDecodeError) as raised:
        json.loads("{")
    inner = raised.value.with_traceback(raised.value.__traceback__.tb_next)
    assert user_line(inner) is None
    assert format_user_error(inner).startswith("JSONDecodeError: Expecting property name")


def test_without_the_text_of_the_code():
    made: dict = {}
    exec(compile("def system(f, key):\n    return f['mas']\n", "<string>", "exec"), made)
    problem = vj.Problem("p", {"mass": vj.Box(0, 1)}, made["system"], "always x < 2")
    with pytest.raises(vj.ProblemError, match="there is no feature 'mas'; did you mean 'mass'"):
        problem.check()


def test_a_package_that_is_there_and_cannot_be_imported_says_why(tmp_path, monkeypatch):
    (tmp_path / "lacks_a_library.py").write_text("raise ImportError('libxcb.so.1: not found')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingExtra, match=r"lacks_a_library is installed but .*: libxcb.so.1"):
        require("lacks_a_library", "scenic")


def test_what_a_callback_raised_is_told_in_its_own_words():
    # Raised for real, it would be told once more by JAX as the process ends.
    text = (
        "INTERNAL: CpuCallback error calling callback: Traceback (most recent call last):\n"
        '  File "jax/_src/callback.py", line 71, in __call__\n'
        '  File "sim.py", line 12, in road\n'
        "ValueError: no road here"
    )
    error = jax.errors.JaxRuntimeError(text)
    assert explain_user_error(error) == "ValueError: no road here (sim.py, line 12)"
    assert "INTERNAL" in explain_user_error(jax.errors.JaxRuntimeError("INTERNAL: out of memory"))
