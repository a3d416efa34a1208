"""The unit cube, the form of a feature space for searches: cells and name of each coordinate."""

import math
from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


@dataclass(frozen=True)
class Cube:
    """The unit cube `[0, 1]^d` with the uniform prior.

    **Arguments:** for each coordinate
    - `levels`: 0 if it is continuous, or its number `n >= 1` of cells; all points of a cell are
      equivalent.
    - `weights`: the probabilities of its cells, which are their widths; None if they are equal.
    - `ordered`: whether its cells have an order; all of them when left out.
    - `names`: its name, such as `cars[0].x`; no names when left out.

    and `lengths`: which coordinates are lengths of arrays, on which others depend; `signals`: the
    coordinates of each function of time, in the order of its control points; `sequences`: arrays
    whose items can be inserted and removed, each given by the coordinate of its length, the first
    coordinate of its items, the number of coordinates of an item, and the maximum number of items.

    **Raises:** `ValueError` for a negative level, or entries that do not match the levels.
    """

    levels: tuple[int, ...]
    weights: tuple[tuple[float, ...] | None, ...] = ()
    ordered: tuple[bool, ...] = ()
    names: tuple[str, ...] = ()
    lengths: tuple[int, ...] = ()
    signals: tuple[tuple[int, ...], ...] = ()
    sequences: tuple[tuple[int, int, int, int], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", tuple(int(level) for level in self.levels))
        if any(level < 0 for level in self.levels):
            raise ValueError(f"levels must not be negative; got {self.levels}")
        for name, default in (("weights", None), ("ordered", True), ("names", "")):
            given = tuple(getattr(self, name)) or (default,) * self.dim
            if len(given) != self.dim:
                raise ValueError(f"{name} must have {self.dim} entries, as levels; got {given}")
            object.__setattr__(self, name, given)
        for level, weights in zip(self.levels, self.weights, strict=True):
            if weights is not None and not (
                len(weights) == level
                and all(weight > 0 for weight in weights)
                and abs(math.fsum(weights) - 1) < 1e-6
            ):
                raise ValueError(
                    f"{level} cells need {level} positive weights that sum to one; got {weights}"
                )
        if not all(0 <= i < self.dim and self.levels[i] for i in self.lengths):
            raise ValueError(f"lengths must be discrete coordinates; got {self.lengths}")

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return len(self.levels)

    @cached_property
    def continuous(self) -> Int[np.ndarray, " c"]:
        """Indices of the continuous coordinates."""
        return np.flatnonzero(np.array(self.levels, np.int64) == 0)

    @cached_property
    def discrete(self) -> Int[np.ndarray, " k"]:
        """Indices of the discrete coordinates."""
        return np.flatnonzero(np.array(self.levels, np.int64) > 0)

    @cached_property
    def probabilities(self) -> tuple[Float[np.ndarray, " cells"], ...]:
        """The prior of the cells, for each discrete coordinate."""
        return tuple(
            np.full(self.levels[i], 1 / self.levels[i])
            if self.weights[i] is None
            else np.array(self.weights[i], np.float64)
            for i in self.discrete
        )

    def take(self, indices: tuple[int, ...]) -> "Cube":
        """Return the cube with only these coordinates."""
        return Cube(
            levels=tuple(self.levels[i] for i in indices),
            weights=tuple(self.weights[i] for i in indices),
            ordered=tuple(self.ordered[i] for i in indices),
            names=tuple(self.names[i] for i in indices),
            lengths=tuple(j for j, i in enumerate(indices) if i in self.lengths),
            signals=tuple(
                tuple(indices.index(i) for i in signal)
                for signal in self.signals
                if set(signal) <= set(indices)
            ),
        )

    def cells(self, u: Float[Array | np.ndarray, "*n d"]) -> Int[Array | np.ndarray, "*n k"]:
        """Return the cell of each discrete coordinate; NumPy points give NumPy arrays."""
        counts = np.array([self.levels[i] for i in self.discrete], np.int32)
        if isinstance(u, np.ndarray):
            # JAX would compile a program for each number of points.
            points = np.asarray(u, np.float32)[..., self.discrete]
            cells = np.clip((points * counts).astype(np.int32), 0, counts - 1)
            for j, edges in self._edges:
                cells[..., j] = np.searchsorted(edges[1:-1], points[..., j], side="right")
            return cells
        points = u[..., self.discrete]
        found = jnp.clip((points * counts).astype(jnp.int32), 0, counts - 1)
        for j, edges in self._edges:
            index = jnp.searchsorted(edges[1:-1], points[..., j], side="right")
            found = found.at[..., j].set(index.astype(jnp.int32))
        return found

    def centres(self, cells: Int[Array | np.ndarray, "*n k"]) -> Float[Array | np.ndarray, "*n k"]:
        """Return the middles of these cells as coordinates; NumPy cells give NumPy arrays."""
        counts = np.array([self.levels[i] for i in self.discrete], np.float32)
        if isinstance(cells, np.ndarray):
            centres = ((cells + np.float32(0.5)) / counts).astype(np.float32)
            for j, edges in self._edges:
                centres[..., j] = ((edges[1:] + edges[:-1]) / 2)[cells[..., j]]
            return centres
        middles = ((jnp.asarray(cells) + 0.5) / counts).astype(jnp.float32)
        for j, edges in self._edges:
            centre = (edges[1:] + edges[:-1]) / 2
            middles = middles.at[..., j].set(jnp.asarray(centre)[cells[..., j]])
        return middles

    @cached_property
    def _edges(self) -> tuple[tuple[int, Float[np.ndarray, " edges"]], ...]:
        """Where the unequal cells begin and end, by index among the discrete coordinates."""
        return tuple(
            (j, np.concatenate([[0], np.cumsum(self.probabilities[j])]).astype(np.float32))
            for j, i in enumerate(self.discrete)
            if self.weights[i] is not None
        )
