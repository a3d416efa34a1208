"""The work of an augmentation: seeds, their networks, and the stored results.

study.run(0, ("none", "counterexamples"))               # one seed; what is finished is read
study.result(arms, 0.95, complete=True)
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
from jax.tree_util import PyTreeDef, default_registry
from jaxtyping import Array, Float, Key

from verifai_jax._version import __version__
from verifai_jax.addons.training.augmentation import examples as labelled
from verifai_jax.addons.training.augmentation.arms import ARMS, FROM_TABLE, Addition, Base
from verifai_jax.addons.training.augmentation.examples import Examples, Judgement, Workshop
from verifai_jax.addons.training.augmentation.result import Augmentation
from verifai_jax.addons.training.augmentation.summary import BASE, NOT_FINITE, TRAINED
from verifai_jax.addons.training.augmentation.task import SupervisedTask, TaskError, Weights
from verifai_jax.core.display.progress import ProgressBar
from verifai_jax.core.messages.errors import end_if_interrupted
from verifai_jax.core.store.cache import Cache
from verifai_jax.core.store.files import plain
from verifai_jax.core.store.log import Arrays
from verifai_jax.core.user_code.user_errors import explain_user_error
from verifai_jax.falsification import falsify
from verifai_jax.search import Search

_PER_HARD = 40
"""Maximum number of drawn inputs for each input of the hard test."""


@dataclass(frozen=True, eq=False)
class Plan:
    """The options that determine the numbers of every arm and seed."""

    initial: int
    added: int
    steps: int
    further_steps: int
    search: Search
    budget: int
    seed: int
    test: int
    hard: int


class Study:
    """The finished work of a study, and methods to compute the rest."""

    def __init__(self, task: SupervisedTask, plan: Plan, cache: Cache, bar: ProgressBar) -> None:
        self.task, self.plan, self.cache, self.bar = task, plan, cache, bar
        self.workshop = Workshop(task)
        self.rows: list[dict[str, Any]] = []
        self.added: list[pd.DataFrame] = []
        self.tables: dict[int, pd.DataFrame] = {}
        self.weights: dict[tuple[str, int], Weights] = {}

    def run(self, number: int, arms: Sequence[str]) -> None:
        """Train the base of a seed and all arms, or read finished ones."""
        seed = Seed(self, number)
        self._finish(number, BASE, seed.base_entry)
        if any(arm in FROM_TABLE for arm in arms) and self.status(number) == TRAINED:
            self.tables[number] = seed.table
        for arm in arms:
            self._finish(number, arm, lambda arm=arm: seed.arm_entry(arm))

    def status(self, number: int) -> str:
        """Return the status of the base of a seed."""
        return next(r["status"] for r in self.rows if r["seed"] == number and r["arm"] == BASE)

    def _finish(self, number: int, arm: str, compute: "Callable[[], Finished]") -> None:
        name = f"seed/{number}/{arm}"
        entry, added = self.cache.get(name), self.cache.get(f"{name}/added")
        if entry is None or added is None:
            computed, rows, weights = compute()
            work = {name: computed, f"{name}/added": encode_frame(rows)}
            stored = None if weights is None else encode_weights(weights)
            if stored is not None:
                work[f"{name}/weights"] = stored
            if weights is not None:
                self.weights[arm, number] = weights
            self.cache.put(work)
            entry, added = self.cache.get(name), self.cache.get(f"{name}/added")
        assert entry is not None
        assert added is not None
        stored = self.cache.get(f"{name}/weights")
        if stored is not None:
            self.weights[arm, number] = decode_weights(stored)
        row = {key: value.item() for key, value in entry.items()}
        self.rows.append({"arm": arm, "seed": number, **row})
        self.added.append(decode_frame(added).assign(arm=arm, seed=number))
        self.bar.advance(1, f"seed {number}, {arm}: error {100 * row['error']:z.3g} %")

    def result(self, arms: Sequence[str], confidence: float, complete: bool) -> Augmentation:
        """Return all finished results."""
        plan, hard = self.plan, self.cache.get("hard")
        added = [rows for rows in self.added if len(rows)] or self.added[:1]
        options = {field.name: getattr(plan, field.name) for field in fields(plan)}
        options["search"] = repr(plan.search)
        options["hard"] = 0 if hard is None else len(decode_frame(hard))
        return Augmentation(
            task=self.task, arms=tuple(arms), table=pd.DataFrame(self.rows),
            added=pd.concat(added, ignore_index=True) if added else pd.DataFrame(),
            error_tables=self.tables, weights=self.weights, options=options, confidence=confidence,
            complete=complete, version=__version__,
        )  # fmt: skip

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the measured numbers."""
        presence = ("precision", "recall") if self.task.has_presence else ()
        hard = ("hard_error",) if self.plan.hard else ()
        return ("error", *presence, *hard, *self.task.measures)

    @cached_property
    def hard(self) -> Examples:
        """Examples on which an independently trained network errs."""

        def compute() -> Arrays:
            return encode_frame(_hard_rows(Seed(self, labelled.INDEPENDENT), self.plan.hard))

        return self.workshop.render(decode_frame(self.cache.remember("hard", compute)))

    def train(
        self, examples: Examples, weights: Weights | None, steps: int, key: Key[Array, ""]
    ) -> Weights:
        """Train a network of the task."""
        try:
            return self.task.train(examples.inputs, examples.labels, weights, steps, key)
        except Exception as error:
            why = explain_user_error(error, system=False)
            raise TaskError(f"train of task {self.task.name!r} fails: {why}") from error

    def measure(
        self, weights: Weights, test: Examples, key: Key[Array, ""]
    ) -> dict[str, float] | None:
        """Measure a network; None if its predictions are not finite."""
        judged = self.workshop.judge(weights, test)
        if not judged.finite:
            return None
        numbers = {"error": float(judged.wrong.mean()), **_presence(judged)}
        if self.plan.hard:
            wrong = self.workshop.judge(weights, self.hard).wrong
            numbers["hard_error"] = float(wrong.mean()) if len(wrong) else math.nan
        for name, measure in self.task.measures.items():
            numbers[name] = float(measure(weights, key))
        return numbers


class Seed:
    """One repetition: its data, base network, error table and test, made when needed."""

    def __init__(self, study: Study, number: int) -> None:
        self.study, self.number = study, number
        self.task, self.plan, self.workshop = study.task, study.plan, study.workshop

    def key(self, purpose: int) -> Key[Array, ""]:
        """Return the random key for a purpose, which is the same for all arms."""
        return labelled.purpose_key(self.plan.seed, self.number, purpose)

    @cached_property
    def initial(self) -> Examples:
        """The initial set."""
        space = self.task.training_space or self.task.space
        return self.workshop.render(
            self.workshop.draw(space, self.key(labelled.INITIAL), self.plan.initial)
        )

    @cached_property
    def test(self) -> Examples:
        """The uniform test."""
        return self.workshop.render(
            self.workshop.draw(self.task.space, self.key(labelled.TEST), self.plan.test)
        )

    @cached_property
    def base(self) -> Weights:
        """The base network."""
        known = self.study.weights.get((BASE, self.number))
        if known is not None:
            return known
        weights = self.study.train(self.initial, None, self.plan.steps, self.key(labelled.TRAINING))
        one = self.initial.take(slice(0, 1))
        self.task.check_network(weights, one.inputs, one.labels)
        return weights

    @cached_property
    def table(self) -> pd.DataFrame:
        """The error table: features, `rho`, `violated`, `status`."""

        def compute() -> Arrays:
            search, workshop = self.plan.search, self.workshop
            problem = labelled.searched_problem(self.task, self.base, search, workshop)
            seed, budget = int(jax.random.bits(self.key(labelled.SEARCH)) >> 1), self.plan.budget
            run = falsify(problem, search, budget, seed=seed, confirm=False, progress=False)
            end_if_interrupted(run.stopped)
            names = [*self.task.space.columns, "rho", "violated", "status"]
            return encode_frame(run.table.all.loc[:, names].reset_index(drop=True))

        return decode_frame(self.study.cache.remember(f"seed/{self.number}/table", compute))

    def base_entry(self) -> "Finished":
        """Train and measure the base."""
        numbers = self.study.measure(self.base, self.test, self.key(labelled.MEASURES))
        addition = Addition(_no_rows(self.task))
        return self._finished(numbers, addition, np.zeros(0), self.base)

    def arm_entry(self, arm: str) -> "Finished":
        """Choose the inputs that an arm adds, then train and measure it."""
        if self.study.status(self.number) != TRAINED:
            why = "the base network is not finite"
            return self._finished(None, Addition(_no_rows(self.task), 0, why), np.zeros(0), None)
        nothing = _no_rows(self.task).assign(rho=0.0, violated=False, status="ok")
        base = Base(
            task=self.task, workshop=self.workshop, weights=self.base, initial=self.initial,
            table=self.table if arm in FROM_TABLE else nothing, added=self.plan.added,
            key=self.key(labelled.CHOICE),
        )  # fmt: skip
        addition = ARMS[arm](base)
        examples = self.workshop.render(addition.rows)
        if addition.transformed:
            examples = labelled.transformed(self.task, examples, base.key)
        judged = self.workshop.judge(self.base, examples)
        union = self.initial.join(examples)
        weights = self.study.train(
            union, self.base, self.plan.further_steps, self.key(labelled.FURTHER)
        )
        numbers = self.study.measure(weights, self.test, self.key(labelled.MEASURES))
        addition = replace(addition, rows=examples.rows)
        return self._finished(numbers, addition, judged.wrongness, weights)

    def _finished(
        self, numbers: dict[str, float] | None, addition: Addition,
        wrongness: Float[np.ndarray, " n"], weights: Weights | None,
    ) -> "Finished":  # fmt: skip
        entry: dict[str, Any] = {
            "status": NOT_FINITE if numbers is None else TRAINED, "added": len(addition.rows),
            "wrong_added": float((wrongness > 0).mean()) if len(wrongness) else math.nan,
            "rendered": addition.rendered,
            **(dict.fromkeys(self.study.metrics, math.nan) if numbers is None else numbers),
            "why": addition.why,
        }  # fmt: skip
        arrays = {name: np.asarray(value) for name, value in entry.items()}
        return Finished(arrays, addition.rows.assign(wrongness=wrongness), weights)


class Finished(NamedTuple):
    """A trained network: its row of the table, the added inputs, its weights."""

    entry: Arrays
    rows: pd.DataFrame
    weights: Weights | None


def _no_rows(task: SupervisedTask) -> pd.DataFrame:
    return pd.DataFrame({name: np.zeros(0) for name in task.space.columns})


def _presence(judged: Judgement) -> dict[str, float]:
    """Return precision and recall; NaN for a ratio with the denominator 0."""
    if judged.present is None or judged.detected is None:
        return {}
    found = float((judged.present & judged.detected).sum())
    detected, present = float(judged.detected.sum()), float(judged.present.sum())
    return {
        "precision": found / detected if detected else math.nan,
        "recall": found / present if present else math.nan,
    }


def _hard_rows(seed: Seed, count: int) -> pd.DataFrame:
    """Draw features on which the base network of a seed errs, `count` at most."""
    workshop, task = seed.workshop, seed.task
    parts, found, key = [_no_rows(task)], 0, seed.key(labelled.TEST)
    for _ in range(_PER_HARD):
        key, now = jax.random.split(key)
        rows = workshop.draw(task.space, now, count)
        rows = rows.loc[workshop.judge(seed.base, workshop.render(rows)).wrong]
        parts, found = [*parts, rows], found + len(rows)
        if found >= count:
            break
    parts = [part for part in parts if len(part)] or parts[:1]
    return pd.concat(parts, ignore_index=True).iloc[:count]


_ORDER = "columns"
"""Array with the names of a table's columns, in their order."""
_STRUCTURE = "structure"
"""Array with the structure of weights, as a protocol buffer."""
_ARRAYS = jax.Array | np.ndarray | np.generic


def encode_frame(frame: pd.DataFrame) -> Arrays:
    """Encode a table; choices of several types become JSON."""
    arrays: Arrays = {_ORDER: np.array([str(name) for name in frame.columns], np.str_)}
    for name in frame.columns:
        values = frame[name].to_numpy()
        if values.dtype.kind in "biuf":
            arrays[f"plain/{name}"] = values
        else:
            arrays[f"json/{name}"] = np.array([json.dumps(plain(v)) for v in values], np.str_)
    return arrays


def decode_frame(arrays: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """Decode a table."""
    columns: dict[str, Any] = {}
    for name in arrays[_ORDER].tolist():
        if f"plain/{name}" in arrays:
            columns[name] = arrays[f"plain/{name}"]
        else:
            entries = [json.loads(text) for text in arrays[f"json/{name}"].tolist()]
            columns[name] = pd.Series(entries, dtype=object)
    return pd.DataFrame(columns)


def encode_weights(weights: Weights) -> Arrays | None:
    """Encode weights; None unless they are arrays in dictionaries, lists and tuples."""
    leaves, structure = jax.tree.flatten(weights)
    arrays = [np.asarray(each) for each in leaves if isinstance(each, _ARRAYS)]
    if len(arrays) < len(leaves) or any(array.dtype.kind not in "biuf" for array in arrays):
        return None
    try:
        stored = np.frombuffer(structure.serialize_using_proto(), np.uint8)
    except ValueError:
        return None
    return {_STRUCTURE: stored, **{str(i): array for i, array in enumerate(arrays)}}


def decode_weights(arrays: Mapping[str, np.ndarray]) -> Weights:
    """Decode weights; arrays become arrays of JAX."""
    structure = PyTreeDef.deserialize_using_proto(default_registry, arrays[_STRUCTURE].tobytes())
    leaves = [jax.numpy.asarray(arrays[str(i)]) for i in range(structure.num_leaves)]
    return jax.tree.unflatten(structure, leaves)
