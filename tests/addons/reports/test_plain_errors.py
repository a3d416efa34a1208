"""Errors as sentences, for people who read no tracebacks."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import verifai_jax as vj
from verifai_jax.addons.reports._plain_errors import sentence

ROOT = Path(__file__).parents[3]
PROGRAM = """
import verifai_jax as vj
vj.plain_errors({on})
def go():
    {call}
go()
"""


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("on", "call", "lines", "first", "last"),
    [
        (True, 'vj.parse("always |x| < 1")', 4, "FormulaSyntaxError: expected a signal", "line 5:"),
        (False, 'vj.parse("always |x| < 1")', 0, "Traceback", ""),
        (True, "1 / 0", 0, "Traceback", "ZeroDivisionError"),
    ],
)
def test_a_program_ends_with_the_sentence(tmp_path, on, call, lines, first, last):
    file = tmp_path / "program.py"
    file.write_text(PROGRAM.format(on=on, call=call))
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, file], env=env, capture_output=True, text=True)
    said = done.stderr.splitlines()
    assert done.returncode == 1
    assert said[0].startswith(first)
    assert last in said[-1]
    assert not lines or len(said) == lines


def test_a_notebook_is_told_which_errors_to_show_so(monkeypatch, capsys):
    calls = []

    class Shell:
        def set_custom_exc(self, kinds, handler):
            calls.append((kinds, handler))

        def showtraceback(self, error, tb_offset):
            calls.append(error[0])

    module = type(sys)("IPython")
    vars(module)["get_ipython"] = Shell
    monkeypatch.setitem(sys.modules, "IPython", module)
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    vj.plain_errors()
    (kinds, handler) = calls.pop()
    for wrong in (lambda: vj.parse("x <"), lambda: {}["missing"]):
        try:
            wrong()
        except kinds as error:
            handler(Shell(), type(error), error, error.__traceback__)
    assert capsys.readouterr().err.startswith("FormulaSyntaxError: expected a signal or a number")
    assert calls == [KeyError]
    vj.plain_errors(False)
    assert calls.pop() == ((), None)
    assert sys.excepthook is sys.__excepthook__


def test_notes_of_an_error_are_shown():
    with pytest.raises(vj.FormulaSyntaxError) as caught:
        vj.parse("x <")
    caught.value.add_note("see the grammar")
    assert "see the grammar" in str(sentence(caught.value))
