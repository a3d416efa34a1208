"""Behaviour of a trace as numbers: visited cells of signals, and the clause nearest to breaking.

behaviour = Behaviour({"mode": (0, 4, 5), "speed": (0, 40, 4)})
behaviour(trace)                                    # [ids], -1 for what it does not show
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from verifai_jax.core.messages.checks import check_count, is_number
from verifai_jax.core.values.trace import Trace, as_array
from verifai_jax.mtl import Formula
from verifai_jax.mtl.clauses import Goals, goals_of
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.semantics import hard

MAX_CELLS = 512
"""Cells of all signals together at most."""


@dataclass(frozen=True)
class Axis:
    """A signal cut into `cells` cells of equal width; the end cells are unbounded."""

    name: str
    low: float
    high: float
    cells: int

    def cell_of(self, trace: Trace) -> Int[Array, " time"]:
        """Return the cell of each sample; -1 where the signal is not finite."""
        signal = as_array(trace.signals[self.name])
        values = signal.astype(jnp.result_type(float))
        share = (values - self.low) / (self.high - self.low)
        inside = jnp.clip(jnp.nan_to_num(share) * self.cells, 0, self.cells - 1)
        return jnp.where(jnp.isfinite(values), inside.astype(jnp.int32), -1)


@dataclass(frozen=True, init=False)
class Behaviour:
    """A classification of traces by the cells they visit and the clauses nearest to breaking.

    **Arguments:**
    - `cells`: signal -> `(low, high, cells)`: the range and the number of equally wide cells of the
      signal. A cell of the behaviour is one combination of cells of all these signals.
    - `formulas`: the formulas whose clause nearest to breaking also counts; none when left out.
    **Raises:** `ValueError` for a signal without a range, or too many cells of all signals.
    """

    axes: tuple[Axis, ...]
    formulas: tuple[Formula, ...] = ()

    def __init__(
        self, cells: Mapping[str, tuple[float, float, int]], formulas: Iterable[Formula] = ()
    ) -> None:
        axes = []
        for name, entry in cells.items():
            if not isinstance(entry, tuple | list) or len(entry) != 3:
                raise ValueError(
                    f"cells of signal {name!r} must be (low, high, how many); got {entry!r}"
                )
            low, high, count = entry
            if not (is_number(low) and is_number(high) and low < high):
                raise ValueError(f"cells of signal {name!r} need low < high; got {entry!r}")
            check_count(f"the number of cells of signal {name!r}", count)
            axes.append(Axis(name, float(low), float(high), int(count)))
        total = math.prod(axis.cells for axis in axes)
        if total > MAX_CELLS:
            raise ValueError(
                f"the signals {', '.join(cells)} give {total} combinations of cells, and at most "
                f"{MAX_CELLS} are allowed; give fewer cells or fewer signals"
            )
        object.__setattr__(self, "axes", tuple(axes))
        object.__setattr__(self, "formulas", tuple(formulas))

    @property
    def cells(self) -> int:
        """Number of cells of all signals together; 0 without signals."""
        return math.prod(axis.cells for axis in self.axes) if self.axes else 0

    @property
    def goals(self) -> Goals | None:
        """The clauses that are distinguished; None without formulas."""
        return goals_of(self.formulas) if self.formulas else None

    @property
    def size(self) -> int:
        """Number of coverage ids that one trace has."""
        return self.cells + bool(self.formulas)

    @property
    def total(self) -> int:
        """Number of all possible coverage ids: cells first, then clauses."""
        goals = self.goals
        return self.cells + (0 if goals is None else len(goals.goals))

    def cell_name(self, number: int) -> str:
        """Describe a cell, for example `mode 2 to 3, speed 10 to 20`."""
        parts = []
        for axis in reversed(self.axes):
            number, cell = divmod(number, axis.cells)
            width = (axis.high - axis.low) / axis.cells
            begin = axis.low + cell * width
            parts.append(f"{axis.name} {begin:z.4g} to {begin + width:z.4g}")
        return ", ".join(reversed(parts))

    def __call__(self, trace: Trace, end: End = "hold") -> Int[Array, " ids"]:
        """Return the ids of a trace; traced by JAX. A trace without the signals has no cells."""
        trace = trace.hold()
        parts = []
        if self.axes:
            cells = jnp.full(self.cells, -1, jnp.int32)
            if all(axis.name in trace.signals for axis in self.axes):
                joint, there = jnp.zeros(trace.length, jnp.int32), jnp.array(True)
                for axis in self.axes:
                    cell = axis.cell_of(trace)
                    joint, there = joint * axis.cells + jnp.maximum(cell, 0), there & (cell >= 0)
                # Counting visits would cost a pass for each cell; a scatter costs one.
                visited = jnp.zeros(self.cells, bool).at[joint].max(there)
                cells = jnp.where(visited, np.arange(self.cells, dtype=np.int32), -1)
            parts.append(cells)
        goals = self.goals
        if goals is not None:
            values = goals.values(trace, hard, end)
            nearest = jnp.argmin(jnp.max(values, axis=1)).astype(jnp.int32)
            parts.append((self.cells + nearest)[None])
        return jnp.concatenate(parts) if parts else jnp.zeros(0, jnp.int32)
