"""Labelled inputs of a task: drawn, rendered, and judged by a network, in blocks of one shape.

    rows = workshop.draw(task.space, key, 200)          # features: a DataFrame
    workshop.judge(weights, workshop.render(rows)).wrongness    # [n]

Blocks have one shape for any number of rows, and weights are arguments, so each function compiles
once for all networks.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Bool, Float, Key, PyTree

from verifai_jax.addons.training.augmentation.task import (
    MARGIN,
    Features,
    SupervisedTask,
    TaskError,
    Weights,
)
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.user_code.user_errors import explain_user_error
from verifai_jax.core.values.trace import Trace
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.systems.base import System

BLOCK = 128
"""Rows that one call of a compiled function works on."""
INITIAL, TRAINING, FURTHER, SEARCH, CHOICE, TEST, MEASURES = range(7)
"""Purposes of random numbers in one repetition."""
INDEPENDENT = 2**31 - 1
"""Number of the repetition of the independent network, higher than that of any seed."""


def purpose_key(seed: int, number: int, purpose: int) -> Key[Array, ""]:
    """Return the random key for a purpose, which is the same for all arms of a repetition.

    **Arguments:**
    - `purpose`: one of the constants of this file.
    """
    repetition = jax.random.fold_in(run_keys(seed)[0], number)
    return jax.random.fold_in(repetition, purpose)


def choice_key(seed: int, number: int) -> Key[Array, ""]:
    """Return the random key with which arms choose and transform inputs."""
    return purpose_key(seed, number, CHOICE)


@dataclass(frozen=True, eq=False)
class Examples:
    """Labelled inputs.

    - `rows`: their features, a DataFrame `[n]` with the columns of the space.
    - `inputs`, `labels`: NumPy arrays, or pytrees of them, with a leading axis `[n]`.
    """

    rows: pd.DataFrame
    inputs: PyTree
    labels: PyTree

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, indices: Any) -> "Examples":
        """Return the examples at these indices, in this order."""
        inputs, labels = jax.tree.map(lambda leaf: leaf[indices], (self.inputs, self.labels))
        return Examples(self.rows.iloc[indices].reset_index(drop=True), inputs, labels)

    def join(self, other: "Examples") -> "Examples":
        """Return these examples followed by others."""
        if not len(other):
            return self
        inputs, labels = jax.tree.map(
            lambda *leaves: np.concatenate(leaves), (self.inputs, self.labels),
            (other.inputs, other.labels),
        )  # fmt: skip
        return Examples(pd.concat([self.rows, other.rows], ignore_index=True), inputs, labels)


@dataclass(frozen=True, eq=False)
class Judgement:
    """A judgement of a network's predictions `[n]`: `wrongness` is positive for a wrong one;
    whether there is something to find, and whether it was found, are None if the task does not
    define them.
    """

    wrongness: Float[np.ndarray, " n"]
    present: Bool[np.ndarray, " n"] | None
    detected: Bool[np.ndarray, " n"] | None

    @property
    def wrong(self) -> Bool[np.ndarray, " n"]:
        """Predictions that are wrong."""
        return self.wrongness > 0

    @property
    def finite(self) -> bool:
        """True if every wrongness is a finite number."""
        return bool(np.isfinite(self.wrongness).all())


class Workshop:
    """Functions that draw, render and judge examples of one task, compiled once.

    **Arguments:**
    - `task`: the task.
    """

    def __init__(self, task: SupervisedTask) -> None:
        self.task = task
        self._draws: dict[int, Any] = {}

    def draw(self, space: FeatureSpace, key: Key[Array, ""], count: int) -> pd.DataFrame:
        """Draw features from the prior of a space, given its constraint.

        **Returns:** a DataFrame `[count]` with the columns of the space.
        """
        if id(space) not in self._draws:
            # The space is kept with its function: its address is then nobody else's.
            self._draws[id(space)] = (space, jax.jit(lambda key: _draw(space, key)))
        function = self._draws[id(space)][1]
        parts, total = [], 0
        while total < count:
            key, now = jax.random.split(key)
            features, accepted = function(now)
            part = pd.DataFrame(space.rows(jax.tree.map(np.asarray, features)))
            part = part.loc[np.asarray(accepted)]
            parts.append(part)
            total += len(part)
        if not parts:
            return pd.DataFrame({name: np.zeros(0) for name in space.columns})
        return pd.concat(parts, ignore_index=True).iloc[:count][list(space.columns)]

    def render(self, rows: pd.DataFrame) -> Examples:
        """Render the inputs of features, and compute their labels.

        The rows are those that were rendered: with the types and precision of features.
        """
        # One row too many where there is none: it tells the shapes.
        some = rows if len(rows) else self.draw(self.task.space, jax.random.key(0), 1)
        columns = {name: some[name].to_numpy() for name in self.task.space.columns}
        features = self.task.space.features_of(columns)
        if self.task.black_box:
            each = [self._render_one(features, i) for i in range(len(some))]
            inputs, labels = jax.tree.map(lambda *leaves: np.stack(leaves), *each)
        else:
            inputs, labels = in_blocks(self._render, features, len(some))
        whole = Examples(pd.DataFrame(self.task.space.rows(features)), inputs, labels)
        return whole if len(rows) else whole.take(slice(0, 0))

    def _render_one(self, features: PyTree, i: int) -> tuple[Any, Any]:
        one = jax.tree.map(lambda leaf: np.asarray(leaf)[i], features)
        return jax.tree.map(np.asarray, (self.task.render(one), self.task.label(one)))

    @cached_property
    def _render(self) -> Any:
        task = self.task

        def both(features: PyTree) -> tuple[Any, Any]:
            return task.render(features), task.label(features)

        return jax.jit(lambda features: jax.lax.map(both, features, batch_size=task.lanes))

    def judge(self, weights: Weights, examples: Examples) -> Judgement:
        """Judge the predictions of a network."""
        n, presence = len(examples), self.task.has_presence
        if not n:
            none = np.zeros(0, bool)
            return Judgement(np.zeros(0), none if presence else None, none if presence else None)
        if self.task.black_box:
            wrongness, present, detected = self._judge_on_host(weights, examples)
        else:
            both = (examples.inputs, examples.labels)
            wrongness, present, detected = in_blocks(lambda b: self._judge(weights, *b), both, n)
        wrongness = np.asarray(wrongness, np.float64)
        if not presence:
            return Judgement(wrongness, None, None)
        return Judgement(wrongness, np.asarray(present, bool), np.asarray(detected, bool))

    @cached_property
    def _judge(self) -> Any:
        task = self.task

        def judge(weights: Weights, inputs: PyTree, labels: PyTree) -> tuple[Any, Any, Any]:
            predictions = task.predict(weights, inputs)
            wrongness = jax.vmap(task.wrongness)(predictions, labels)
            if task.present is None or task.detected is None:
                nothing = jnp.zeros(len(wrongness), bool)
                return wrongness, nothing, nothing
            return wrongness, jax.vmap(task.present)(labels), jax.vmap(task.detected)(predictions)

        return jax.jit(judge)

    def _judge_on_host(self, weights: Weights, examples: Examples) -> tuple[Any, Any, Any]:
        task, rows = self.task, range(len(examples))
        predictions = task.predict(weights, examples.inputs)

        def each(tree: PyTree, i: int) -> PyTree:
            return jax.tree.map(lambda leaf: np.asarray(leaf)[i], tree)

        labels = [each(examples.labels, i) for i in rows]
        found = [each(predictions, i) for i in rows]
        wrongness = [float(task.wrongness(p, y)) for p, y in zip(found, labels, strict=True)]
        if task.present is None or task.detected is None:
            return wrongness, None, None
        return wrongness, [*map(task.present, labels)], [*map(task.detected, found)]


def transformed(task: SupervisedTask, examples: Examples, key: Key[Array, ""]) -> Examples:
    """Return the examples transformed by the task's transformation."""
    transform = task.transform
    if transform is None:
        raise TaskError(f"task {task.name!r} has no transformation")
    before = (examples.inputs, examples.labels)
    if not task.black_box:
        before = jax.tree.map(jnp.asarray, before)
    try:
        inputs, labels = jax.tree.map(np.asarray, tuple(transform(before[0], before[1], key)))
    except Exception as error:
        why = explain_user_error(error, system=False)
        raise TaskError(f"transform of task {task.name!r} fails: {why}") from error
    found = Examples(examples.rows, inputs, labels)
    old, new = (
        jax.tree.map(lambda leaf: np.shape(leaf), (e.inputs, e.labels)) for e in (examples, found)
    )
    if old != new:
        raise TaskError(
            f"transform of task {task.name!r} must keep the shapes of inputs and labels; they "
            f"were {old}, and became {new}"
        )
    return found


def _draw(space: FeatureSpace, key: Key[Array, ""]) -> tuple[PyTree, Bool[Array, " n"]]:
    features = jax.vmap(space.unflatten)(jax.random.uniform(key, (BLOCK, space.dim)))
    return features, jax.vmap(space.accepts)(features)


def in_blocks(function: Any, tree: PyTree, n: int) -> PyTree:
    """Apply a function of rows to `n > 0` rows, in blocks of one shape; return NumPy arrays."""
    parts = []
    for first in range(0, n, BLOCK):
        count = min(BLOCK, n - first)

        def block(leaf: Any, first: int = first, count: int = count) -> np.ndarray:
            part = np.asarray(leaf)[first : first + count]
            missing = BLOCK - count
            return np.concatenate([part, np.repeat(part[-1:], missing, axis=0)])

        found = function(jax.tree.map(block, tree))
        parts.append(jax.tree.map(lambda leaf, count=count: np.asarray(leaf)[:count], found))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def searched_problem(
    task: SupervisedTask, weights: Weights | None, search: Search, workshop: Workshop | None
) -> Problem:
    """Return the problem in which a search looks for inputs on which a network errs.

    Without gradients one program serves the networks of all seeds, with their weights as arguments;
    with gradients each network has its own program.
    """
    if workshop is None or (search.wants.derivatives and not task.black_box):
        return task.problem(weights)
    return Problem(task.name, task.space, _Judged(workshop, weights), f"{MARGIN} >= 0")


class _Judged(System):
    """A network as a system of batches, judged by compiled functions that all networks share."""

    black_box = True

    def __init__(self, workshop: Workshop, weights: Weights) -> None:
        self.workshop, self.weights = workshop, weights

    def simulate_batch(self, features: Features, keys: Key[Array, " n"]) -> Trace:
        rows = pd.DataFrame(self.workshop.task.space.rows(features))
        wrongness = self.workshop.judge(self.weights, self.workshop.render(rows)).wrongness
        return Trace({MARGIN: -np.asarray(wrongness, np.float32)[:, None]}, dt=1.0)
