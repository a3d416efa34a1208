"""Counterexample-guided data augmentation: does it pay to train on what a network gets wrong?

    result = augment(task, initial=1000, added=200, seeds=5)
    print(result)                           # each arm against none, and against random inputs

For each seed a base network is trained on an initial set, a search fills its error table, and each
arm trains the base further on the initial set and what the arm adds. All arms of a seed share data,
weights, keys and tests, so that their differences are paired.

Sources: Dreossi, Ghosh, Yue, Keutzer, Sangiovanni-Vincentelli and Seshia, Counterexample-guided
data augmentation, IJCAI 2018; Dreossi et al., VerifAI: a toolkit for the formal design and analysis
of artificial intelligence-based systems, CAV 2019.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
from jaxtyping import Array, Float, Key

from verifai_jax._version import __version__
from verifai_jax.augmentation.arms import ARMS, FROM_TABLE, Addition, Base, check_arms
from verifai_jax.augmentation.examples import Examples, Judgement, Workshop, transformed
from verifai_jax.augmentation.keys import (
    CHOICE,
    FURTHER,
    INDEPENDENT,
    INITIAL,
    MEASURES,
    SEARCH,
    TEST,
    TRAINING,
    purpose_key,
)
from verifai_jax.augmentation.outcome import BASE, NOT_FINITE, TRAINED
from verifai_jax.augmentation.result import Augmentation
from verifai_jax.augmentation.storage import (
    decode_frame,
    decode_weights,
    encode_frame,
    encode_weights,
)
from verifai_jax.augmentation.task import (
    MARGIN,
    Features,
    SupervisedTask,
    TaskError,
    Weights,
)
from verifai_jax.core.cache import Arrays, Cache, locked_cache
from verifai_jax.core.checks import check_count, check_fraction
from verifai_jax.core.errors import suggests_options
from verifai_jax.core.precision import reproducible_settings
from verifai_jax.core.progress import ProgressBar
from verifai_jax.core.trace import Trace
from verifai_jax.core.user_errors import explain_user_error
from verifai_jax.falsification import falsify
from verifai_jax.falsification.validation import check_search, needs_gradient
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Portfolio, Search, named
from verifai_jax.systems.base import System

KIND = "augmentation"
"""Kind of the cache."""
_PER_HARD = 40
"""Inputs that are drawn at most for each one of the hard test."""
DEFAULT_ARMS = ("none", "random", "counterexamples")
"""Arms where none are named; `standard` too, where the task has a transformation."""


@suggests_options
@reproducible_settings()
def augment(
    task: SupervisedTask,
    arms: Sequence[str] | str | None = None,
    *,
    initial: int = 1000,
    added: int = 200,
    steps: int = 600,
    further_steps: int = 300,
    search: str | Search = "uniform",
    budget: int | None = None,
    seeds: int = 5,
    seed: int = 0,
    test: int = 4096,
    hard: int = 400,
    confidence: float = 0.95,
    folder: str | Path | None = None,
    progress: bool | None = None,
) -> Augmentation:
    """Compare ways of adding training data, over seeds with paired data, weights and tests.

    The arms, all with the same number of further training steps from the same base network:

    - `none`: nothing is added.
    - `random`: new inputs from the prior.
    - `standard`: initial inputs, transformed by the task's `transform`.
    - `counterexamples`: those of the error table, as the search found them.
    - `table_random`, `table_closest`: counterexamples drawn at random, or the closest to each
      other.
    - `table_pca`, `rules`: new inputs along the principal components of the counterexamples, or
      within the rules of the table, whether the network errs on them or not.
    - `pca_kept`, `rules_kept`: the same, of which only those are added on which the network errs.

    **Arguments:**

    - `task`: what is trained, and how its inputs are rendered.
    - `arms`: names of arms, or `"all"`; by default `none`, `random`, `counterexamples`, and
      `standard` where the task has a transformation.
    - `initial`: inputs of the initial set.
    - `added`: inputs that an arm adds.
    - `steps`, `further_steps`: training steps of the base, and of each arm after it.
    - `search`: of the error table: a name, or a search with its options.
    - `budget`: simulations of the error table; ten times `added` when left out.
    - `seeds`: repetitions, each with data, weights and tests of its own.
    - `seed`: of all of them.
    - `test`: inputs of the uniform test.
    - `hard`: inputs of the hard test, on which an independently trained network errs; 0 for none.
      It is the same for all seeds.
    - `confidence`: of each interval by itself.
    - `folder`: a folder, or a `.sqlite` file, that keeps finished work: the same call goes on where
      it was interrupted, and one with more seeds or arms computes only these.
    - `progress`: show a progress bar; by default on a terminal or in a notebook.

    **Returns:** the result: a table with a row for each arm and seed, and what follows from it. One
    that was interrupted (Ctrl-C) has the finished rows; its `complete` is False.

    **Raises:** before anything is trained, `UnknownNameError` for unknown arms, searches and
    options; `ValueError` for numbers out of range, and for a search that needs gradients that the
    task has not; `TaskError` for a task whose parts do not fit; `CacheError` for a folder that is
    damaged, or of another augmentation; `FolderInUse` where another process writes it.
    """
    if not isinstance(task, SupervisedTask):
        raise TypeError(f"augment needs a SupervisedTask; got {type(task).__name__}")
    chosen = _arms(task, arms)
    for name, value in (("initial", initial), ("added", added), ("steps", steps)):
        check_count(name, value)
    check_count("further_steps", further_steps)
    check_count("seeds", seeds)
    check_count("seed", seed, 0)
    check_count("test", test)
    check_count("hard", hard, 0)
    check_fraction("confidence", confidence)
    budget = 10 * added if budget is None else check_count("budget", budget)
    search = named(search) if isinstance(search, str) else search
    task.check()
    check_search(_searched(task, None, search, None), search)
    plan = _Plan(initial, added, steps, further_steps, search, budget, seed, test, hard)
    with locked_cache(folder, KIND), Cache(folder, KIND) as cache, ProgressBar(progress) as bar:
        cache.claim(_fingerprint(task, plan))
        bar.begin(task.name, seeds * (1 + len(chosen)), "networks")
        study = _Study(task, plan, cache, bar)
        complete = True
        try:
            for number in range(seeds):
                study.run(number, chosen)
        except KeyboardInterrupt:
            complete = False
        result = study.result(chosen, confidence, complete)
    if folder is not None and Path(folder).suffix == "":
        result.save(folder)
    return result


@dataclass(frozen=True, eq=False)
class _Plan:
    """The options that decide the numbers of every arm and seed."""

    initial: int
    added: int
    steps: int
    further_steps: int
    search: Search
    budget: int
    seed: int
    test: int
    hard: int


class _Study:
    """The finished work of a study, and what computes the rest."""

    def __init__(self, task: SupervisedTask, plan: _Plan, cache: Cache, bar: ProgressBar) -> None:
        self.task, self.plan, self.cache, self.bar = task, plan, cache, bar
        self.workshop = Workshop(task)
        self.rows: list[dict[str, Any]] = []
        self.added: list[pd.DataFrame] = []
        self.tables: dict[int, pd.DataFrame] = {}
        self.weights: dict[tuple[str, int], Weights] = {}

    def run(self, number: int, arms: Sequence[str]) -> None:
        """Train the base of a seed and all arms, or read what is finished."""
        seed = _Seed(self, number)
        self._finish(number, BASE, seed.base_entry)
        if any(arm in FROM_TABLE for arm in arms) and self.status(number) == TRAINED:
            self.tables[number] = seed.table
        for arm in arms:
            self._finish(number, arm, lambda arm=arm: seed.arm_entry(arm))

    def status(self, number: int) -> str:
        """Return the status of the base of a seed."""
        return next(r["status"] for r in self.rows if r["seed"] == number and r["arm"] == BASE)

    def _finish(self, number: int, arm: str, compute: Any) -> None:
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
        self.bar.advance(1, f"seed {number}, {arm}: error {100 * row['error']:.3g} %")

    def result(self, arms: Sequence[str], confidence: float, complete: bool) -> Augmentation:
        """Return what is finished."""
        plan, hard = self.plan, self.cache.get("hard")
        added = [rows for rows in self.added if len(rows)] or self.added[:1]
        options = {field.name: getattr(plan, field.name) for field in fields(plan)}
        options["search"] = repr(plan.search)
        options["hard"] = 0 if hard is None else len(decode_frame(hard))
        return Augmentation(
            task=self.task,
            arms=tuple(arms),
            table=pd.DataFrame(self.rows),
            added=pd.concat(added, ignore_index=True) if added else pd.DataFrame(),
            error_tables=self.tables,
            weights=self.weights,
            options=options,
            confidence=confidence,
            complete=complete,
            version=__version__,
        )

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the numbers that are measured."""
        presence = ("precision", "recall") if self.task.has_presence else ()
        hard = ("hard_error",) if self.plan.hard else ()
        return ("error", *presence, *hard, *self.task.measures)

    @cached_property
    def hard(self) -> Examples:
        """Examples on which an independently trained network errs."""

        def compute() -> Arrays:
            return encode_frame(_hard_rows(_Seed(self, INDEPENDENT), self.plan.hard))

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
        """Measure a network; None for one whose predictions are not finite."""
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


class _Seed:
    """One repetition: its data, base network, error table and test, each made when needed."""

    def __init__(self, study: _Study, number: int) -> None:
        self.study, self.number = study, number
        self.task, self.plan, self.workshop = study.task, study.plan, study.workshop

    def key(self, purpose: int) -> Key[Array, ""]:
        """Return the random key of a purpose, the same for all arms."""
        return purpose_key(self.plan.seed, self.number, purpose)

    @cached_property
    def initial(self) -> Examples:
        """The initial set."""
        space = self.task.training_space or self.task.space
        return self.workshop.render(self.workshop.draw(space, self.key(INITIAL), self.plan.initial))

    @cached_property
    def test(self) -> Examples:
        """The uniform test."""
        return self.workshop.render(
            self.workshop.draw(self.task.space, self.key(TEST), self.plan.test)
        )

    @cached_property
    def base(self) -> Weights:
        """The base network."""
        known = self.study.weights.get((BASE, self.number))
        if known is not None:
            return known
        weights = self.study.train(self.initial, None, self.plan.steps, self.key(TRAINING))
        one = self.initial.take(slice(0, 1))
        self.task.check_network(weights, one.inputs, one.labels)
        return weights

    @cached_property
    def table(self) -> pd.DataFrame:
        """The error table: features, `rho`, `violated`, `status`."""

        def compute() -> Arrays:
            problem = _searched(self.task, self.base, self.plan.search, self.workshop)
            seed = int(jax.random.bits(self.key(SEARCH)) >> 1)
            run = falsify(
                problem, self.plan.search, self.plan.budget,
                seed=seed, confirm=False, progress=False,
            )  # fmt: skip
            if run.stopped == "interrupted":
                # A search ends with what it has; a table that is cut short is no finished work.
                raise KeyboardInterrupt
            names = [*self.task.space.columns, "rho", "violated", "status"]
            return encode_frame(run.table.all.loc[:, names].reset_index(drop=True))

        return decode_frame(self.study.cache.remember(f"seed/{self.number}/table", compute))

    def base_entry(self) -> "_Finished":
        """Train and measure the base."""
        numbers = self.study.measure(self.base, self.test, self.key(MEASURES))
        addition = Addition(_no_rows(self.task))
        return self._finished(numbers, addition, np.zeros(0), self.base)

    def arm_entry(self, arm: str) -> "_Finished":
        """Choose what an arm adds, train and measure it."""
        if self.study.status(self.number) != TRAINED:
            why = "the base network is not finite"
            return self._finished(None, Addition(_no_rows(self.task), 0, why), np.zeros(0), None)
        nothing = _no_rows(self.task).assign(rho=0.0, violated=False, status="ok")
        base = Base(
            task=self.task,
            workshop=self.workshop,
            weights=self.base,
            initial=self.initial,
            table=self.table if arm in FROM_TABLE else nothing,
            added=self.plan.added,
            key=self.key(CHOICE),
        )
        addition = ARMS[arm](base)
        examples = self.workshop.render(addition.rows)
        if addition.transformed:
            examples = transformed(self.task, examples, base.key)
        judged = self.workshop.judge(self.base, examples)
        union = self.initial.join(examples)
        weights = self.study.train(union, self.base, self.plan.further_steps, self.key(FURTHER))
        numbers = self.study.measure(weights, self.test, self.key(MEASURES))
        addition = replace(addition, rows=examples.rows)
        return self._finished(numbers, addition, judged.wrongness, weights)

    def _finished(
        self,
        numbers: dict[str, float] | None,
        addition: Addition,
        wrongness: Float[np.ndarray, " n"],
        weights: Weights | None,
    ) -> "_Finished":
        entry: dict[str, Any] = {
            "status": NOT_FINITE if numbers is None else TRAINED,
            "added": len(addition.rows),
            "wrong_added": float((wrongness > 0).mean()) if len(wrongness) else math.nan,
            "rendered": addition.rendered,
            **(dict.fromkeys(self.study.metrics, math.nan) if numbers is None else numbers),
            "why": addition.why,
        }
        arrays = {name: np.asarray(value) for name, value in entry.items()}
        return _Finished(arrays, addition.rows.assign(wrongness=wrongness), weights)


class _Finished(NamedTuple):
    """A trained network: its row of the table, what was added, its weights."""

    entry: Arrays
    rows: pd.DataFrame
    weights: Weights | None


def _arms(task: SupervisedTask, arms: Sequence[str] | str | None) -> tuple[str, ...]:
    if arms is None:
        return (*DEFAULT_ARMS, *(("standard",) if task.transform is not None else ()))
    if arms == "all":
        return tuple(arm for arm in ARMS if arm != "standard" or task.transform is not None)
    chosen = (arms,) if isinstance(arms, str) else tuple(arms)
    check_arms(chosen, task)
    return chosen


def _no_rows(task: SupervisedTask) -> pd.DataFrame:
    return pd.DataFrame({name: np.zeros(0) for name in task.space.columns})


def _presence(judged: Judgement) -> dict[str, float]:
    """Return precision and recall; NaN for a precision where nothing is detected, and so on."""
    if judged.present is None or judged.detected is None:
        return {}
    found = float((judged.present & judged.detected).sum())
    detected, present = float(judged.detected.sum()), float(judged.present.sum())
    return {
        "precision": found / detected if detected else math.nan,
        "recall": found / present if present else math.nan,
    }


def _hard_rows(seed: _Seed, count: int) -> pd.DataFrame:
    """Draw features on which the base network of a seed errs, `count` at most."""
    workshop, task = seed.workshop, seed.task
    parts, found, key = [_no_rows(task)], 0, seed.key(TEST)
    for _ in range(_PER_HARD):
        key, now = jax.random.split(key)
        rows = workshop.draw(task.space, now, count)
        rows = rows.loc[workshop.judge(seed.base, workshop.render(rows)).wrong]
        parts, found = [*parts, rows], found + len(rows)
        if found >= count:
            break
    parts = [part for part in parts if len(part)] or parts[:1]
    return pd.concat(parts, ignore_index=True).iloc[:count]


def _searched(
    task: SupervisedTask, weights: Weights | None, search: Search, workshop: Workshop | None
) -> Problem:
    """Return the problem that a search works on.

    Without gradients one program serves the networks of all seeds, with their weights as arguments;
    with gradients each network has its own.
    """
    slopes = needs_gradient(search) or isinstance(search, Portfolio)
    if workshop is None or (slopes and not task.black_box):
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


def _fingerprint(task: SupervisedTask, plan: _Plan) -> dict[str, Any]:
    """Describe what decides the numbers of every arm and seed; code by its name only."""
    functions = ("render", "label", "train", "predict", "wrongness", "transform")
    return {
        "task": task.name,
        "space": _features(task.space),
        "training_space": None if task.training_space is None else _features(task.training_space),
        "constrained": [
            space is not None and space.where is not None
            for space in (task.space, task.training_space)
        ],
        "functions": {name: _name(getattr(task, name)) for name in functions},
        "measures": list(task.measures),
        "presence": task.has_presence,
        "options": {f.name: _text(getattr(plan, f.name)) for f in fields(plan)},
        "version": __version__,
    }


def _features(space: FeatureSpace) -> dict[str, str]:
    return {name: _text(domain) for name, domain in space.domains.items()}


def _name(function: Any) -> str | None:
    return None if function is None else getattr(function, "__qualname__", type(function).__name__)


def _text(value: object) -> str:
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))
