"""One repeated simulation, with its trace.

replay(problem, row, key, number).trace             # the trace of a row of a table
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Key

from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.keys import simulation_key
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook, picture_html
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.text import format_features
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.evaluation.verdicts import boolean_semantics, trace_verdict, violations
from verifai_jax.mtl import Explanation, explain
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Replay(InNotebook):
    """One simulation that was repeated, with its trace.

    `rho` is the robustness of each formula by name; NaN unless `status` is OK. `key` is the random
    key of the simulation. `duration` is the time in seconds that it would have lasted without an
    early end, over which Signals extend; None for a single sample. `engine` names another engine of
    the system if that simulated it, which happens if it needs no compilation and reproduces the
    number of the row.
    """

    _internal = frozenset(("changed", "finding"))
    problem: Problem
    row: int | None
    features: dict[str, Any]
    trace: Trace
    rho: dict[str, float]
    status: Status
    key: Key[Array, ""] | None = None
    duration: float | None = None
    changed: str = ""
    finding: str = ""
    engine: str = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on doubts that the replay reproduces its row; often none."""
        return tuple(text for text in (self.changed, self.finding) if text)

    @property
    def violated(self) -> bool:
        """True if the simulation ended properly and breaks a formula."""
        rho = np.array([list(self.rho.values())])
        status = np.array([int(self.status)])
        holds = lambda: np.asarray(boolean_semantics(self.problem, self.trace))[None]  # noqa: E731
        return bool(violations(rho, status, holds)[0])

    @property
    def worst(self) -> str:
        """Name of the formula with the least robustness."""
        return min(self.rho, key=lambda name: float(np.nan_to_num(self.rho[name], nan=np.inf)))

    def explain(self) -> Explanation:
        """Explain the worst formula: the deciding predicate, its time and the path to it.

        **Raises:** `ValueError` for a simulation without a verdict.
        """
        if self.status != Status.OK:
            raise ValueError(f"no verdict to explain: the simulation is {self.status.name.lower()}")
        formula = self.problem.formulas[self.worst]
        return explain(formula, self.trace, end=self.problem.end)

    def columns(self) -> dict[str, Any]:
        """Return the features by column, as in a row of a table."""
        one = jax.tree.map(lambda leaf: np.asarray(leaf)[None], self.features)
        return {name: column[0] for name, column in self.problem.space.rows(one).items()}

    def describe_features(self) -> str:
        """Write the features in one line; control points of signals are named by their time."""
        labels = self.problem.space.labels(self.duration)
        return format_features(self.columns(), labels)

    def __repr__(self) -> str:
        which = "" if self.row is None else f"row {self.row} of "
        return f"Replay({which}{self.problem.name!r}, {self._verdict()})"

    def __str__(self) -> str:
        which = "a simulation" if self.row is None else f"row {self.row}"
        lines = [*self.warnings, f"{which} of {self.problem.name}: {self._verdict()}"]
        if len(self.rho) > 1 and self.status == Status.OK:
            lines += [f"  {name:<12} robustness {rho:z.4g}" for name, rho in self.rho.items()]
        lines.append(f"  {'features':<12} {self.describe_features()}")
        lines += [f"  {'engine':<12} {self.engine}"] if self.engine else []
        span, *signals = str(self.trace).splitlines()
        return "\n".join([*lines, f"  {span}", *(f"  {line}" for line in signals)])

    def _notebook_parts(self) -> Iterator[str]:
        yield picture_html(self.plot())

    def _verdict(self) -> str:
        if self.status != Status.OK:
            return f"no verdict, {self.status.name.lower()}"
        verb = "violates" if self.violated else "keeps"
        return f"{verb} the property, robustness {min(self.rho.values()):z.4g}"

    def plot(self, path: str | Path | None = None, signals: Sequence[str] | None = None) -> Any:
        """Draw signals with the bounds of all formulas and the deciding instant; return a figure.

        **Arguments:**
        - `path`: file to which the picture is written, if given.
        - `signals`: signals, and features that are Signals, to draw; by default a selection.
        **Raises:** `UnknownNameError` for a signal that does not exist.
        """
        return lazy_import("verifai_jax.pictures.replay", "plot_replay")(self, path, signals)

    def animate(
        self, path: str | Path | None = None, *, camera: str | None = None,
        size: Sequence[int] | None = None, fps: float | None = None,
    ) -> Any:  # fmt: skip
        """Draw the simulation, or else its signals, as an animated GIF, which notebooks display.

        **Arguments:**
        - `path`: a file to write as well; none when left out.
        - `camera`: name of a camera of a MuJoCo model; by default the one that shows the motion
          best.
        - `size`: width and height of a frame in pixels.
        - `fps`: frames per second; chosen automatically when left out.
        **Raises:** `ValueError` for a camera without a MuJoCo model; `UnknownNameError` for a
        camera that the model lacks.
        """
        draw = lazy_import("verifai_jax.pictures.animation", "animate")
        return draw(self, path, camera=camera, size=size, fps=fps)


@shows_progress("replaying a simulation of", "simulations")
def replay(
    problem: Problem, row: "Mapping[str, Any] | pd.Series", key: Key[Array, ""],
    number: int | None = None, precision: str = "float32",
) -> Replay:  # fmt: skip
    """Simulate the features of `row` again with the random key of simulation `number`.

    **Raises:** `ValueError` for a precision other than float32 and float64.
    """
    key = simulation_key(key, 0 if number is None else number)
    with in_precision(precision):
        features = problem.space.from_row(row)
        # Kept with the problem: as a static argument it would never be freed.
        judge = problem.programs.get(JUDGES, "", lambda: jax.jit(partial(_judged, problem)))
        if problem.black_box:
            trace = problem.system(features, key)
            read = lazy_import("verifai_jax.evaluation.host_engine", "on_host_clock")(trace)
            _, rho, status = judge(read)
        else:
            precise = jax.tree.map(lambda leaf: _cast(leaf, precision), features)
            trace, rho, status = judge(precise, key)
            read = trace
        return Replay(
            problem=problem,
            row=number,
            features=features,
            trace=trace.trim(),
            rho=dict(zip(problem.formulas, (np.asarray(rho) + 0.0).tolist(), strict=True)),
            status=Status(int(status)),
            key=key,
            # Of the whole trace: what an early end leaves of it is shorter.
            duration=float(read.clock()[-1] - read.clock()[0]) or None,
        )


JUDGES: Slot[str, Any] = Slot("verdicts of replays")


def _judged(problem: Problem, given: Any, key: Key[Array, ""] | None = None) -> tuple[Any, ...]:
    """Return a trace, simulated from features if there is a key, with its verdict."""
    trace = given if key is None else problem.system(given, key)
    return trace, *trace_verdict(problem, trace)


def _cast(leaf: ArrayLike, precision: str) -> Array:
    if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact):
        return jax.device_put(np.asarray(leaf).astype(precision))
    return jnp.asarray(leaf)
