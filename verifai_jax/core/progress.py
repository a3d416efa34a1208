"""The progress bar of a run: simulations per second, best robustness, counterexamples, time left.

Drawn by rich on the error stream, on a terminal or in a notebook that has ipywidgets; nothing
elsewhere.
"""

import importlib.util
import sys
from typing import Any


class Progress:
    """A context manager around the loop; `show=None` decides by where the output goes."""

    def __init__(self, name: str, budget: int, show: bool | None = None) -> None:
        self.name, self.budget = name, budget
        self.show = _watched() if show is None else show
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> "Progress":
        if self.show:
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.completed:,.0f}/{task.total:,.0f}  {task.fields[figures]}"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task(self.name, total=self.budget, figures="compiling")
        return self

    def update(self, simulations: int, found: int, best: float) -> None:
        """Tell what is done so far."""
        if self._bar is not None:
            speed = self._bar.tasks[0].speed or 0.0
            figures = f"{speed:,.0f}/s  best {best:.3g}  {found} counterexamples"
            self._bar.update(self._task, completed=simulations, figures=figures)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()


def _watched() -> bool:
    if sys.stderr is not None and sys.stderr.isatty():
        return True
    # In a notebook rich draws through ipywidgets, and without it warns instead.
    return "ipykernel" in sys.modules and importlib.util.find_spec("ipywidgets") is not None
