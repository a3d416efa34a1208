"""Progress of a call: its activity, the finished share, the speed, and the remaining time.

    @shows_progress("comparing")                        # a line for all that `compare` takes
    def compare(baseline, ..., progress: bool | None = None): ...

    with SimulationProgress("cartpole", budget, show=None) as progress:
        progress.update(simulations, counterexamples, best)

Rich draws a line on the error stream, on a terminal or in a notebook that has ipywidgets. In
another notebook a line is written over every second; elsewhere, such as in a pipe, one is written a
minute. A call inside another one takes over its line while it runs.
"""

import contextlib
import functools
import importlib.util
import inspect
import io
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Any, ParamSpec, TypeVar, cast

from verifai_jax.core.messages.text import printable

if TYPE_CHECKING:
    from rich.progress import Progress, Task
    from rich.text import Text
P = ParamSpec("P")
R = TypeVar("R")
EVERY = 60.0
"""Seconds between two lines where nothing is drawn."""
MOMENT = 2.0
"""Minimum seconds of work that is worth resuming; shorter work is simply repeated."""
_ongoing: ContextVar["ProgressBar | None"] = ContextVar("ongoing", default=None)
"""The bar of the verb that was called; the others within it show themselves there."""


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


@dataclass
class _Stage:
    """A part of a computation; a `total` of None is not known."""

    name: str
    total: float | None
    unit: str
    began: float
    done: float = 0.0
    # From the first count on: what is compiled before it would hide the speed.
    first: float = 0.0
    counted: float = 0.0
    figures: str = ""
    task: Any = None

    @property
    def amount(self) -> str:
        """The work that is done: `200/1,000 simulations`."""
        if self.total is None:
            return f"{self.done:z,.0f} {self.unit}" if self.done else ""
        return f"{self.done:z,.0f}/{self.total:z,.0f} {self.unit}"

    def line(self, compiling: str) -> str:
        """Write what is going on in one line."""
        minutes = (time.perf_counter() - self.began) / 60
        parts = [self.amount, compiling or self.figures, f"{minutes:z.1f} min so far"]
        return f"{self.name}: {', '.join(part for part in parts if part)}"


class ProgressBar:
    """A one-line progress bar for the stages of a computation; a context manager around them.

    **Arguments:**
    - `show`: whether to show it; None shows it if the error stream is a terminal or notebook.
    """

    def __init__(self, show: bool | None = None) -> None:
        self.show = show
        self._display: Progress | None = None
        self._stages: list[_Stage] = []
        self._own = 0
        self._shared = False
        self._over = threading.Event()

    def __enter__(self) -> "ProgressBar":
        outer = _ongoing.get()
        if outer and self.show is not False and (outer.show is not False or not self.show):
            # Stages begin on the bar of the verb that this is a part of.
            self._display, self._stages, self._shared = outer._display, outer._stages, True
        elif self.show is not False:
            if self.show or has_viewer():
                self._draw()
            if not has_viewer():
                threading.Thread(target=self._write_lines, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        while self._own:
            self.end()
        self._over.set()
        if self._display is not None and not self._shared:
            self._display.stop()

    def _draw(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
        from rich.text import Text

        class Figures(TextColumn):
            """The figures of a stage, or the present compilation and its duration."""

            def render(self, task: "Task") -> "Text":
                task.fields["shown"] = _compiling() or task.fields["figures"]
                return super().render(task)

        class Time(TimeRemainingColumn):
            """The time left, or the time so far if the total is unknown."""

            def render(self, task: "Task") -> "Text":
                if task.total is None:
                    return Text(f"{task.elapsed or 0.0:z.0f} s", style="progress.remaining")
                return super().render(task)

        self._display = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[amount]}"),
            Figures("{task.fields[shown]}"),
            Time(),
            console=Console(file=cast("IO[str]", _Stream())),
            transient=True,
        )
        self._display.start()

    def _write_lines(self) -> None:
        stream, width = _Stream(), 0
        within = "ipykernel" in sys.modules  # A notebook has one line, which is written over.
        while not self._over.wait(1.0 if within else EVERY):
            for stage in self._stages[-1:]:
                line = printable(stage.line(_compiling()))
                width = max(width, len(line))
                stream.write(f"\r{line:{width}}" if within else f"{line}\n")
                stream.flush()
        if within and width:
            stream.write(f"\r{'':{width}}\r")

    def begin(self, name: str, total: float | None, unit: str) -> None:
        """Begin a stage of `total` units of work, None if unknown; stages may be nested."""
        self._own += 1
        stage = _Stage(name, total, unit, time.perf_counter())
        if self._display is not None:
            self._show_last(False)
            stage.task = self._display.add_task(
                name, total=total, amount=stage.amount, figures="", shown=""
            )
        self._stages.append(stage)

    def end(self) -> None:
        """End the present stage; the enclosing one continues."""
        if self._own:
            self._own -= 1
            stage = self._stages.pop()
            if self._display is not None:
                self._display.remove_task(stage.task)
                self._show_last(True)

    def _show_last(self, visible: bool) -> None:
        if self._display is not None and self._stages:
            self._display.update(self._stages[-1].task, visible=visible)

    def advance(self, amount: float, figures: str = "") -> None:
        """Count `amount` more units as done, and show `figures` next to the bar."""
        if self._own:
            self.set_done(self._stages[-1].done + amount, figures=figures)

    def set_done(self, done: float, total: float | None = None, figures: str = "") -> None:
        """Set the number of finished units, and their total if it has changed."""
        if self._own:
            self._set(self._stages[-1], done, total, figures)

    def count(self, amount: float) -> None:
        """Count finished units of the outermost stage, even inside another stage."""
        if self._stages:
            stage = self._stages[0]
            # A total is what somebody allowed; more than that is done by what is not counted in it.
            self._set(stage, stage.done + amount, None, stage.figures)

    def _set(self, stage: _Stage, done: float, total: float | None, figures: str) -> None:
        stage.done, stage.figures = done, figures
        if not stage.counted:
            stage.first, stage.counted = done, time.perf_counter()
        stage.total = stage.total if total is None else total
        if self._display is not None:
            self._display.update(
                stage.task, completed=done, total=stage.total, amount=stage.amount, figures=figures
            )

    def note(self, text: str) -> None:
        """Write a line above the bar, which remains visible."""
        if self._display is not None:
            self._display.console.print(f"note: {printable(text)}", markup=False, highlight=False)

    @property
    def speed(self) -> float:
        """Units per second in the present stage."""
        if not self._own:
            return 0.0
        stage = self._stages[-1]
        if self._display is not None:
            return next((t.speed or 0.0 for t in self._display.tasks if t.id == stage.task), 0.0)
        return (stage.done - stage.first) / max(time.perf_counter() - stage.counted, 1e-9)


def _compiling() -> str:
    """Say what is being compiled; the module that knows is not imported where nothing was."""
    compilation: Any = sys.modules.get("verifai_jax.core.compute.compilation")
    return "" if compilation is None else compilation.describe_compilation()


def shows_progress(
    doing: str, unit: str = "simulations", *, of_budget: bool = True
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Make a function show its progress in one line.

    Its option `progress` works as in `ProgressBar`; if that is a function, nothing is shown. The
    total is its option `budget`, if it has one. `count_done` counts finished units.

    **Arguments:**
    - `doing`: the word before the name of the first argument: "comparing".
    - `unit`: the name of the units.
    - `of_budget`: whether its option `budget` is the total; false if it covers only one stage.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)
        first = next(iter(signature.parameters))

        @functools.wraps(function)
        def shown(*arguments: P.args, **options: P.kwargs) -> R:
            if _ongoing.get() is not None:
                return function(*arguments, **options)
            try:
                given = signature.bind(*arguments, **options)
            except TypeError:
                return function(*arguments, **options)  # It says itself what does not fit.
            given.apply_defaults()
            bound = given.arguments
            show, budget = bound.get("progress"), bound.get("budget")
            subject = (
                bound[first] if isinstance(bound[first], str) else getattr(bound[first], "name", "")
            )
            with ProgressBar(False if callable(show) else show) as bar:
                total = budget if of_budget and isinstance(budget, int) else None
                bar.begin(f"{doing} {subject}".rstrip(), total, unit)
                token = _ongoing.set(bar)
                try:
                    return function(*arguments, **options)
                finally:
                    _ongoing.reset(token)

        return shown

    return decorate


def count_done(amount: float) -> None:
    """Count this many units as done by the outermost call that shows progress."""
    if (bar := _ongoing.get()) is not None:
        bar.count(amount)


def say_done(done: float, total: float | None = None, figures: str = "") -> None:
    """Set the finished units and the total of the call that shows progress, with figures."""
    if (bar := _ongoing.get()) is not None:
        bar.set_done(done, total, figures)


class SimulationProgress(ProgressBar):
    """The bar of a run: simulations per second, least robustness, counterexamples, time left.

    **Arguments:** those of `ProgressBar.begin` and `ProgressBar`; `budget` simulations in all.
    """

    def __init__(self, name: str, budget: int, show: bool | None = None) -> None:
        super().__init__(show)
        self.name, self.budget = name, budget

    def __enter__(self) -> "SimulationProgress":
        super().__enter__()
        self.begin(self.name, self.budget, "simulations")
        return self

    def update(self, simulations: int, counterexamples: int, best: float) -> None:
        """Show the number of simulations and counterexamples, and the least robustness."""
        figures = f"{self.speed:z,.0f}/s  best {best:z.3g}  {counterexamples} counterexamples"
        self.set_done(simulations, figures=figures)


def write_line(text: str, stream: _Stream | None = None) -> None:
    """Write a line about slow work to the error stream, above the bar if there is one."""
    stream = stream or _Stream()
    stream.write(f"{printable(text)}\n")
    stream.flush()


def has_viewer() -> bool:
    """Return whether the error stream is a terminal or a notebook that can show a bar."""
    if sys.stderr is not None and not sys.stderr.closed and sys.stderr.isatty():
        return True
    # In a notebook rich draws through ipywidgets, and without it warns instead.
    return "ipykernel" in sys.modules and importlib.util.find_spec("ipywidgets") is not None


@contextlib.contextmanager
def goes_on_with(command: str, kept: Callable[[], bool]) -> Iterator[None]:
    """Show after a moment the command that resumes the work, since a killed process cannot.

    **Arguments:**
    - `kept`: a function that returns whether there is anything to resume.
    """
    over = threading.Event()

    def say() -> None:
        while not over.wait(MOMENT):
            if kept():
                write_line(f"note: if this is killed, go on with: {command}")
                return

    threading.Thread(target=say, daemon=True).start()
    try:
        yield
    finally:
        over.set()
