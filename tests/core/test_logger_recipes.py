"""The recipes of docs/callbacks.md against stubs of the calls that the services document.

- wandb: `init(project, config)`, `log(data, step)`, `summary`, `finish()`
- mlflow: `start_run(run_name)`, `log_params(params)`, `log_metrics(metrics, step)`
- trackio: `init(project, config)`, `log(metrics, step)`, `finish()`
"""

import contextlib
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

import verifai_jax as vj

PAGE = (Path(__file__).parents[2] / "docs" / "callbacks.md").read_text()
RECIPES = dict(re.findall(r"<!-- needs (\w+) -->\n```python\n(.*?)```", PAGE, re.DOTALL))


class Service:
    """A stub that checks what it is given as the real one would."""

    def __init__(self):
        self.logged, self.open, self.finished = [], False, False
        self.summary = {}

    def init(self, project: str, name: str | None = None, config: dict | None = None):
        assert project
        assert config
        self.open = True

    def log(self, metrics: dict, step: int | None = None):
        assert self.open
        assert type(step) is int
        assert all(type(value) in (int, float) for value in metrics.values())
        self.logged.append((step, metrics))

    def finish(self):
        self.finished = True

    @contextlib.contextmanager
    def start_run(self, run_id: str | None = None, run_name: str | None = None):
        self.open = True
        yield
        self.finished = True

    def log_params(self, params: dict):
        assert self.open

    def log_metrics(self, metrics: dict[str, float], step: int | None = None):
        self.log(metrics, step)


@pytest.mark.thorough
def test_recipes_run_against_the_documented_calls(monkeypatch):
    assert set(RECIPES) == {"wandb", "mlflow", "trackio"}

    def system(f, key):
        return vj.Trace({"x": (f["a"] - f["b"])[None].repeat(3)}, dt=1.0)

    space = {"a": vj.Box(0.0, 1.0), "b": vj.Box(0.0, 1.0)}
    ramp = vj.Problem("ramp", space, system, "always x < 0.9")
    # One search, which need not compile, stands for all.
    quick = ModuleType("vj")
    quick.falsify = lambda problem, **options: vj.falsify(problem, "uniform", batch=64, **options)
    for name, code in RECIPES.items():
        service, module = Service(), ModuleType(name)
        for public in dir(service):
            if not public.startswith("_"):
                setattr(module, public, getattr(service, public))
        monkeypatch.setitem(sys.modules, name, module)
        exec(compile(code, name, "exec"), {"vj": quick, "ramp": ramp})
        assert [step for step, _ in service.logged] == [64, 128, 192, 200]
        assert service.logged[-1][1]["simulations"] == 200
        assert service.finished
