"""Signals that are held from each sample to the next are drawn as steps."""

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.pictures.replay import is_held


def plant(**options):
    return vj.ode(
        lambda time, state, control, f: {"x": control["u"] + f["wind"](time)},
        lambda f, key: {"x": f["x0"]},
        controller=lambda time, state, f: {"u": -state["x"]},
        dt=0.1, duration=1.0, **options,
    )  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize(("hold", "drawn"), [("constant", "steps-post"), ("linear", "default")])
@pytest.mark.parametrize("period", [0.1, 0.2])
def test_controls_and_held_inputs_are_steps(hold, drawn, period):
    space = {"x0": vj.Box(0.2, 1.0), "wind": vj.Signal(vj.Box(-1, 1), 3, hold=hold)}
    problem = vj.Problem("held", space, plant(control_period=period), "always x < 0.5")
    run = vj.falsify(problem, "uniform", 2, progress=False, confirm=False)
    panels = {axes.get_ylabel(): axes.lines[0] for axes in run.replay(0).plot().axes}
    styles = {name: line.get_drawstyle() for name, line in panels.items()}
    assert styles == {"x": "default", "u": "steps-post", "wind (input)": drawn}


def test_what_keeps_its_values_is_recognised():
    time = np.arange(12)
    assert is_held(np.repeat(time[:6] % 4, 2).astype(float))
    assert is_held(time > 5)
    assert not is_held(np.sin(time))
    assert not is_held(np.zeros(12))
    # At rest, and then moving.
    assert not is_held(np.maximum(time - 8.0, 0))
