"""Studies that a report adds to a run: failures with pictures, explanation, shrinking, analysis.

studies = study(run, traces=24)
studies.failures[0].replay                      # the worst one, simulated again
studies.left_out                                # what was not done, and why
"""

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from verifai_jax.addons.analysis import Analysis, analyze
from verifai_jax.addons.reports.view import rows_to_trace, trace_data
from verifai_jax.core.display.extensions import extension
from verifai_jax.core.display.figure import Figure
from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.counterexamples import Explained, Shrunk, explain, shrink
from verifai_jax.evaluation.replay import Replay
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.falsification.run import Run
from verifai_jax.pictures.animation import animate

Result = TypeVar("Result")
MAX_FAILURES = 5
"""Failures that are shown one by one."""
TRACES = 24
"""Rows that are simulated beforehand, unless that takes long."""
TRACES_OF_A_BLACK_BOX = 5
"""Rows that are simulated beforehand where a simulation may take long."""
STUDIED = 2000
"""Simulations that explaining and shrinking take at most."""
PATIENCE = 60.0
"""Seconds of so many simulations above which a black box takes long."""
WORST = "The worst failure could not"
"""What is said of a study of it that raised, at first."""
MODES = "The ways of failing could not be found"
"""What is said where the search for them raised."""
LARGEST_ANIMATION = 1_500_000
"""Bytes of an animation at most."""


@runtime_checkable
class ModesSection(Protocol):
    """Modes of failure, as `vj.modes` finds them, in a report."""

    def section(self, about: Any) -> Any:
        """Return their section."""
        ...

    def claims(self) -> list[tuple[str, tuple[str, ...], tuple[str, ...]]]:
        """Return sentence, evidence and assumptions of their claims."""
        ...


@dataclass(frozen=True)
class Failure:
    """A failure shown in a report: `number` in the report, `row`, `why` it is shown, `replay`.

    The replay is None for a run that was loaded without its problem.
    """

    number: int
    row: int
    why: str
    replay: Replay | None = None


@dataclass(frozen=True)
class Studies:
    """The studies of a run for its report.

    - `failures`: a few failures, the worst first; `traces`: data of simulated rows by number.
    - `animation` (a GIF), `explained`, `shrunk`: those of the worst failure, if possible.
    - `analysis`, `modes`: of the table, and those of failure, if they were asked for.
    - `left_out`: whole sentences on what was not done, and why.
    - `findings`: sentences on rows that did not reproduce their numbers.
    """

    failures: tuple[Failure, ...]
    traces: dict[int, dict[str, Any]]
    animation: bytes | None
    explained: Explained | None
    shrunk: Shrunk | None
    analysis: Analysis
    modes: ModesSection | None = None
    left_out: tuple[str, ...] = field(default=())
    findings: tuple[str, ...] = ()


def study(
    run: Run, traces: int | None = None, studies: bool | None = None, modes: int | None = None
) -> Studies:
    """Study a run for its report, as `write_report` says; run and seed decide the result."""
    left_out, findings, data = list[str](), list[str](), {}
    found, problem = analyze(run), run.problem
    rows = _failures_to_show(run, found)
    if problem is None:
        left_out.append(
            "The run was read without its problem, so that nothing was simulated again: there are "
            "no traces, no explanation and no shrunk form."
        )
        failures = [Failure(i + 1, row, why) for i, (row, why) in enumerate(rows)]
        return Studies(tuple(failures), {}, None, None, None, found, left_out=tuple(left_out))
    slow = problem.black_box and STUDIED * run.run_seconds > PATIENCE * run.simulations
    if traces is None:
        traces = TRACES_OF_A_BLACK_BOX if slow else TRACES
    failures = []

    def replayed(row: int) -> Replay:
        again = run.replay(row)
        findings.extend([again.finding] if again.finding else [])
        return again

    for i, (row, why) in enumerate(rows):
        again = replayed(row) if i < max(traces, 1) else None
        failures.append(Failure(i + 1, row, why, again))
        if again is not None and i < traces:
            data[row] = trace_data(again, f"row {row}: failure {i + 1}")
    for row, label in rows_to_trace(run, traces, [row for row, _ in rows]).items():
        if row not in data:
            data[row] = trace_data(replayed(row), label)
    worst = failures[0].replay if failures else None
    animation = None if worst is None else _animated(worst, left_out)
    explained = shrunk = None
    if failures and (studies if studies is not None else not slow):
        row = failures[0].row
        explained = _attempt(f"{WORST} be explained", lambda: explain(run, row), left_out)
        shrunk = _attempt(f"{WORST} be shrunk", lambda: shrink(run, row), left_out)
    elif failures:
        long = "since simulations of this black box take long; studies=True does both"
        why = long if studies is None else "as was asked"
        left_out.append(f"The worst failure was not explained and not shrunk, {why}.")
    directions = None if modes is None else _attempt(MODES, lambda: _modes(run, modes), left_out)
    return Studies(
        tuple(failures), data, animation, explained, shrunk, found, directions, tuple(left_out),
        tuple(findings),
    )  # fmt: skip


def _modes(run: Run, budget: int) -> ModesSection:
    assert run.problem is not None
    return extension("verifai_jax.reports", "modes")(
        run.problem, budget, seed=run.seed, precision=run.precision,
        run_on=RunOn(backend=run.backend), progress=False,
    )  # fmt: skip


def _failures_to_show(run: Run, found: Analysis) -> list[tuple[int, str]]:
    failing = run.table.counterexamples
    if not len(failing):
        return []
    numbers = failing.index.to_numpy()
    by_rho = numbers[np.argsort(failing["rho"].to_numpy(), kind="stable")].tolist()
    chosen = {by_rho[0]: "the worst"}
    for number, row in enumerate(found.representatives):
        if row in failing.index:
            chosen.setdefault(row, f"it stands for kind {number + 1} of the failures")
    if len(chosen) < MAX_FAILURES:
        chosen.setdefault(by_rho[-1], "the one nearest to the bound")
    for row in by_rho[:MAX_FAILURES]:
        chosen.setdefault(row, "among the worst")
    return list(chosen.items())[:MAX_FAILURES]


def _animated(replay: Replay, left_out: list[str]) -> bytes | None:
    filmed = replay.problem.system.filmed(replay)
    if replay.problem.draw is None and (filmed is None or not filmed.draws):
        return None
    animation = _attempt(f"{WORST} be animated", lambda: animate(replay), left_out)
    if animation is not None and len(animation.gif) > LARGEST_ANIMATION:
        left_out.append(
            f"The animation of the worst failure has {len(animation.gif):,} bytes, more than a "
            f"report holds ({LARGEST_ANIMATION:,}); verifai-jax replay writes it to a file."
        )
        return None
    return None if animation is None else animation.gif


def _attempt(what: str, work: Callable[[], Result], left_out: list[str]) -> Result | None:
    """Return what a study finds; where it cannot be made, the report says why and goes on."""
    try:
        return work()
    except Exception as error:  # A drawing or a system of somebody else may raise anything.
        left_out.append(f"{what}: {one_line(format_error(error))}.")
        return None


def png(figure: Figure) -> bytes:
    """Return a figure as PNG with 128 colours; equal figures give equal bytes."""
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    picture = Image.open(buffer).convert("RGB").quantize(colors=128, dither=Image.Dither.NONE)
    # Nothing of the library's version or of the day is written next to the picture.
    small = io.BytesIO()
    picture.save(small, format="png", optimize=True)
    return small.getvalue()
