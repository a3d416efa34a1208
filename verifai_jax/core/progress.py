"""Progress bars: how much is done, how fast, and how much time is left.

    with SimulationProgress("cartpole", budget, show=None) as progress:
        progress.update(simulations, counterexamples, best)

Rich draws them on the error stream, on a terminal or in a notebook that has ipywidgets; elsewhere
nothing is drawn.
"""

import contextlib
import importlib.util
import io
import sys
from typing import IO, TYPE_CHECKING, Any, cast

from verifai_jax.core.text import printable

if TYPE_CHECKING:
    from rich.progress import Progress, Task, TaskID
    from rich.text import Text


class _Stream:
    """The error stream, to which writing never fails: a run outlives the terminal that shows it."""

    def __init__(self) -> None:
        # Within another bar it stands in for the stream itself.
        self._stream = getattr(sys.stderr, "rich_proxied_file", sys.stderr) or io.StringIO()

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class ProgressBar:
    """One bar, for one stage of a computation at a time; a context manager around all of them.

    **Arguments:**

    - `show`: whether to draw; None decides by where the error stream goes.
    """

    def __init__(self, show: bool | None = None) -> None:
        self.show = has_viewer() if show is None else show
        self._display: Progress | None = None
        self._stage: TaskID | None = None

    def __enter__(self) -> "ProgressBar":
        if self.show:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            from verifai_jax.core.compilation import describe_compilation

            class Figures(TextColumn):
                """The figures of a stage, or what is being compiled and for how long so far."""

                def render(self, task: "Task") -> "Text":
                    task.fields["shown"] = describe_compilation() or task.fields["figures"]
                    return super().render(task)

            self._display = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.completed:,.0f}/{task.total:,.0f} {task.fields[unit]}"),
                Figures("{task.fields[shown]}"),
                TimeRemainingColumn(),
                console=Console(file=cast("IO[str]", _Stream())),
                transient=True,
            )
            self._display.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._display is not None:
            self._display.stop()

    def begin(self, name: str, total: float, unit: str) -> None:
        """Begin a stage of `total` units of work."""
        if self._display is not None:
            self._stage = self._display.add_task(name, total=total, unit=unit, figures="")

    def end(self) -> None:
        """End the present stage."""
        if self._display is not None and self._stage is not None:
            self._display.remove_task(self._stage)
        self._stage = None

    def advance(self, amount: float, figures: str = "") -> None:
        """Count `amount` more units as done, and show `figures` beside the bar."""
        if self._display is not None and self._stage is not None:
            self._display.update(self._stage, advance=amount, figures=figures)

    def update(self, done: float, total: float | None = None, figures: str = "") -> None:
        """Set the units that are done, and their total where it has changed."""
        if self._display is not None and self._stage is not None:
            self._display.update(self._stage, completed=done, total=total, figures=figures)

    def note(self, text: str) -> None:
        """Write a line above the bar, which stays."""
        if self._display is not None:
            self._display.console.print(f"note: {printable(text)}", markup=False, highlight=False)

    @property
    def speed(self) -> float:
        """Units per second of the present stage."""
        if self._display is None:
            return 0.0
        return next((t.speed or 0.0 for t in self._display.tasks if t.id == self._stage), 0.0)


class SimulationProgress:
    """The bar of a run: simulations per second, least robustness, counterexamples, time left.

    **Arguments:**

    - `name`: text in front of the bar.
    - `budget`: simulations in all.
    - `show`: whether to draw; None decides by where the error stream goes.
    """

    def __init__(self, name: str, budget: int, show: bool | None = None) -> None:
        self.name, self.budget = name, budget
        self.bar = ProgressBar(show)

    def __enter__(self) -> "SimulationProgress":
        self.bar.__enter__()
        self.bar.begin(self.name, self.budget, "simulations")
        return self

    def __exit__(self, *reason: object) -> None:
        self.bar.__exit__(*reason)

    def note(self, text: str) -> None:
        """Write a line above the bar, which stays."""
        self.bar.note(text)

    def update(self, simulations: int, counterexamples: int, best: float) -> None:
        """Show the simulations made, the counterexamples among them and the least robustness."""
        figures = f"{self.bar.speed:z,.0f}/s  best {best:z.3g}  {counterexamples} counterexamples"
        self.bar.update(simulations, figures=figures)


def has_viewer() -> bool:
    """Return whether the error stream is a terminal or a notebook that can draw a bar."""
    if sys.stderr is not None and not sys.stderr.closed and sys.stderr.isatty():
        return True
    # In a notebook rich draws through ipywidgets, and without it warns instead.
    return "ipykernel" in sys.modules and importlib.util.find_spec("ipywidgets") is not None
