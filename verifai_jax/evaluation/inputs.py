"""The inputs of a simulation, as an engine takes them: how they become features and a system.

    CubePoints(problem)                                 # points of the unit cube
    CubePoints(problem, given=True)                     # or features that somebody gave
    TableRows(refiner, formats)                         # features of a table, at a finer step
    WithParameters(problem, size, system_of)            # points, and parameters that all share

An engine compiles one program for each kind of inputs; everything else about it is the same.
"""

import abc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from verifai_jax.core.lifting import lifting
from verifai_jax.problem.problem import Problem


class Inputs(abc.ABC):
    """The inputs of one row, and those that all rows share; both are pytrees that JAX traces."""

    row_form: PyTree
    """Shapes and types of one row, as `jax.ShapeDtypeStruct`s."""
    shared_form: PyTree = ()
    """The same of what all rows share."""
    dim: int = 0
    """Coordinates by which the robustness may be differentiated."""
    keeps_features: bool = False
    """Whether the simulated features are part of the results."""
    streaming: bool = False
    """Whether the monitor may travel with the rollout, where the system allows it."""
    purpose: str = "the simulation"
    """What is simulated, for people who wait until it is compiled."""

    @abc.abstractmethod
    def coordinates(self, row: PyTree, shared: PyTree, precision: str) -> Float[Array, " dim"]:
        """Return what the robustness is differentiated by, in this precision."""

    @abc.abstractmethod
    def simulated(
        self, coordinates: Float[Array, " dim"], row: PyTree, shared: PyTree
    ) -> tuple[PyTree, Callable[..., Any]]:
        """Return the features and the system to simulate."""


class CubePoints(Inputs):
    """Points of the unit cube of a problem's feature space.

    **Arguments:**

    - `problem`: that says the space.
    - `given`: whether rows are those of `given_rows`: points, followed by the real numbers of
      features that somebody gave, which are simulated as they are; NaN for those of the point.
    - `precision`: of what is given.
    """

    keeps_features = True
    streaming = True

    def __init__(self, problem: Problem, given: bool = False, precision: str = "float32") -> None:
        self.problem, self.given = problem, given
        self.dim = problem.space.dim
        size = self.dim + (problem.space.width if given else 0)
        dtype = jnp.dtype(precision if given else "float32")
        self.row_form = jax.ShapeDtypeStruct((size,), dtype)

    def coordinates(self, row: PyTree, shared: PyTree, precision: str) -> Float[Array, " dim"]:
        return row[: self.dim].astype(precision)

    def simulated(
        self, coordinates: Float[Array, " dim"], row: PyTree, shared: PyTree
    ) -> tuple[PyTree, Callable[..., Any]]:
        space = self.problem.space
        with lifting():
            if self.given:
                features = space.unflatten_given(coordinates, row[self.dim :])
            else:
                features = space.unflatten(coordinates)
        return features, self.problem.system


class TableRows(Inputs):
    """Features as a table holds them, simulated by a system that depends on a shared number.

    **Arguments:**

    - `form`: the features of one row, as `jax.ShapeDtypeStruct`s in the engine's precision.
    - `system_at`: the system for the shared number, a `factor` of refinement.
    """

    purpose = "closer replays"

    def __init__(self, form: PyTree, system_at: Callable[[Any], Callable[..., Any]]) -> None:
        self.row_form, self.system_at = form, system_at
        self.shared_form = jax.ShapeDtypeStruct((), jnp.int32)

    def coordinates(self, row: PyTree, shared: PyTree, precision: str) -> Float[Array, " dim"]:
        return jnp.zeros(0, precision)

    def simulated(
        self, coordinates: Float[Array, " dim"], row: PyTree, shared: PyTree
    ) -> tuple[PyTree, Callable[..., Any]]:
        return row, self.system_at(shared)


class WithParameters(Inputs):
    """Points of the unit cube, and a vector of parameters of the system that all rows share.

    The coordinates are the parameters, followed by the point.

    **Arguments:**

    - `problem`: its space and formulas.
    - `size`: how many parameters.
    - `system_of`: the system of a vector of parameters.
    """

    def __init__(
        self, problem: Problem, size: int, system_of: Callable[[Array], Callable[..., Any]]
    ) -> None:
        self.problem, self.size, self.system_of = problem, size, system_of
        self.dim = size + problem.space.dim
        self.row_form = jax.ShapeDtypeStruct((problem.space.dim,), jnp.float32)
        self.shared_form = jax.ShapeDtypeStruct((size,), jnp.float32)

    def coordinates(self, row: PyTree, shared: PyTree, precision: str) -> Float[Array, " dim"]:
        return jnp.concatenate([shared.astype(precision), row.astype(precision)])

    def simulated(
        self, coordinates: Float[Array, " dim"], row: PyTree, shared: PyTree
    ) -> tuple[PyTree, Callable[..., Any]]:
        theta, u = coordinates[: self.size], coordinates[self.size :]
        with lifting():
            features = self.problem.space.unflatten(u)
        return features, self.system_of(theta)
