"""The trainings of a sweep, each remembered: policies at the snapshots, learning curves, seconds.

    lessons = Lessons(study, store, watch)
    number = lessons.add(values, seed=0)
    lessons.reach([number, ...], rung=0)             # trained to their first snapshot, or recalled
    lessons.reached(number, 0).policy

Trainings of one structure share a program. As many as there are devices go on together from one
snapshot to the next, so a training that has begun is soon finished, and kept.
"""

import hashlib
import json
import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from verifai_jax.rl.batched_training import BatchedTraining, Configuration, policy_structure
from verifai_jax.rl.policy import Policy
from verifai_jax.sweeps.cache import Store, StoreError, Work
from verifai_jax.sweeps.clock import OutOfTime, Watch
from verifai_jax.sweeps.record import Curve
from verifai_jax.sweeps.study import Study

RECENT = 0.1
"""Share of the updates so far, the last ones, whose returns are the training return."""


@dataclass(frozen=True, eq=False)
class Reached:
    """A training at one of its snapshots.

    - `policy`: on the host; `finite`: whether all its numbers are.
    - `curve`: from the beginning to here; `seconds`: of a core, compilation not counted.
    """

    policy: Policy
    finite: bool
    curve: Curve
    seconds: float

    @property
    def training_return(self) -> float:
        """Mean return of the last tenth of the updates, or else of the last one that has any."""
        known = np.asarray(self.curve.mean_return, np.float64)
        last = known[-max(1, int(np.ceil(RECENT * len(known)))) :]
        some = last[np.isfinite(last)]
        if not len(some):
            some = known[np.isfinite(known)][-1:]
        return float(np.mean(some)) if len(some) else float("nan")


@dataclass(frozen=True, eq=False)
class Lesson:
    """A training that was asked for: its hyper-parameters and seed, or why it cannot be."""

    values: Mapping[str, Any]
    seed: int
    key: str
    snapshots: tuple[int, ...]
    configuration: Configuration | None
    error: str = ""


class Lessons:
    """All trainings of a sweep; numbers are in the order in which they were added."""

    def __init__(self, study: Study, store: Store, watch: Watch) -> None:
        self.study, self.store, self.watch = study, store, watch
        self.lessons: list[Lesson] = []
        self.errors: dict[int, str] = {}
        self._reached: dict[tuple[int, int], Reached] = {}
        self._forms: dict[Hashable, Any] = {}
        self._trained: set[Hashable] = set()
        self._homes: dict[int, tuple[BatchedTraining, int]] = {}

    def add(self, values: Mapping[str, Any], seed: int) -> int:
        """Ask for a training; one that cannot be is an error of its own, the others go on."""
        trainer = self.study.trainer
        key = digest({n: values[n] for n in sorted(trainer.uses(values))})
        configuration, error = None, ""
        try:
            configuration = trainer.configuration(values, seed)
            configuration.check()
            steps = configuration.steps
        except (ValueError, TypeError) as problem:
            configuration, error, steps = None, _told(problem), trainer.steps
        snapshots = self.study.snapshots_of(steps)
        self.lessons.append(Lesson(dict(values), seed, key, snapshots, configuration, error))
        number = len(self.lessons) - 1
        if error:
            self.errors[number] = error
        return number

    def rungs(self, number: int) -> int:
        """How many snapshots a training has."""
        return len(self.lessons[number].snapshots)

    def reached(self, number: int, rung: int) -> Reached | None:
        """A training at a snapshot; None where it has not got there."""
        return self._reached.get((number, rung))

    def structure(self, number: int) -> Hashable:
        """What is equal for trainings whose policies have one form and share a program."""
        configuration = self.lessons[number].configuration
        assert configuration is not None
        return policy_structure(configuration)

    def reach(self, numbers: Sequence[int], rung: int, *, further: bool = False) -> None:
        """Take these trainings to a snapshot, or to their last if they have fewer.

        - `further`: keep their state, because some will go on from there.
        """
        self._prepare()
        waiting: dict[Hashable, list[int]] = {}
        for number in numbers:
            if number in self.errors:
                continue
            last = min(rung, self.rungs(number) - 1)
            for at in range(last + 1):
                self._recall(number, at)
            if (number, last) in self._reached:
                self.watch.advance(self._cost(number, last))
            else:
                place = (id(self._homes[number][0]), self.structure(number))
                waiting.setdefault(place, []).append(number)
        for group in waiting.values():
            # Of one length, so that devices finish together.
            group.sort(key=lambda n: (self.lessons[n].snapshots[-1], n))
            home = self._homes[group[0]][0]
            size = len(home.devices) * home.per_device
            for start in range(0, len(group), size):
                self._portion(group[start : start + size], rung, further)

    def forget(self, numbers: Sequence[int]) -> None:
        """Let go of the states of trainings that do not go on."""
        for number in numbers:
            if number in self._homes:
                home, place = self._homes[number]
                home.discard(place)

    def _prepare(self) -> None:
        """Give the trainings of a new round a home, in which they stay until they are done."""
        fresh = [n for n in range(len(self.lessons)) if n not in self._homes]
        found = [(n, c) for n in fresh if (c := self.lessons[n].configuration) is not None]
        if found:
            home = BatchedTraining([configuration for _, configuration in found])
            self._homes.update({n: (home, place) for place, (n, _) in enumerate(found)})

    def _portion(self, numbers: list[int], rung: int, further: bool) -> None:
        """Train those of one portion from snapshot to snapshot, keeping each as it is reached."""
        structure = self.structure(numbers[0])
        self.watch.advance(0, "" if structure in self._trained else "compiling")
        self._trained.add(structure)
        try:
            self._advance(numbers, rung)
        except (OutOfTime, MemoryError, StoreError):
            raise
        except Exception as error:
            self.forget(numbers)
            if len(numbers) > 1:
                # One of them may be to blame.
                for number in numbers:
                    self._portion([number], rung, further)
                return
            self.errors[numbers[0]] = _told(error)
            return
        ended = [n for n in numbers if not further or rung >= self.rungs(n) - 1]
        self.forget(ended)

    def _advance(self, numbers: list[int], rung: int) -> None:
        home = self._homes[numbers[0]][0]
        of = {self._homes[n][1]: n for n in numbers}
        for at in range(rung + 1):
            here = [n for n in numbers if at < self.rungs(n) and (n, at) not in self._reached]
            targets = {self._homes[n][1]: self.lessons[n].snapshots[at] for n in here}
            began, busy = time.perf_counter(), 0.0
            for place in home.advance(targets):
                number = of[place]
                policy, curve = home.policy(place), Curve(*home.curve(place))
                work = _kept(policy, curve, home.seconds(place))
                self.store.put({self.name(number, at): work})
                self._keep(number, at, work)
                before = self._reached.get((number, at - 1))
                share = home.seconds(place) - (before.seconds if before else 0.0)
                busy += share / len(home.devices)
                self.watch.advance(self._cost(number, at) - self._cost(number, at - 1))
            self.watch.compiled(time.perf_counter() - began - busy)
            self.watch.check()

    def _recall(self, number: int, rung: int) -> None:
        if (number, rung) in self._reached:
            return
        work = self.store.get(self.name(number, rung))
        if work is not None:
            self._keep(number, rung, work)

    def _keep(self, number: int, rung: int, work: Work) -> None:
        leaves = [work[f"leaf{i}"] for i in range(int(work["leaves"]))]
        policy = jax.tree.unflatten(self._form(number), leaves)
        finite = all(bool(np.all(np.isfinite(leaf))) for leaf in leaves)
        curve = Curve(work["steps"], work["mean_return"])
        self._reached[number, rung] = Reached(policy, finite, curve, float(work["seconds"]))

    def _form(self, number: int) -> Any:
        """How the numbers of a policy belong together; nothing compiles."""
        structure = self.structure(number)
        if structure not in self._forms:
            configuration = self.lessons[number].configuration
            assert configuration is not None
            algorithm, task = configuration.algorithm, configuration.task

            def first(key: Any) -> Policy:
                return algorithm.policy(task, algorithm.init(task, key, 1))

            key = jax.eval_shape(lambda: jax.random.key(0))
            self._forms[structure] = jax.tree.structure(jax.eval_shape(first, key))
        return self._forms[structure]

    def name(self, number: int, rung: int) -> str:
        """What a training at a snapshot is called in the store."""
        lesson = self.lessons[number]
        total, at = lesson.snapshots[-1], lesson.snapshots[rung]
        return f"train/{lesson.key}/seed {lesson.seed}/{at} of {total}"

    def _cost(self, number: int, rung: int) -> int:
        return self.lessons[number].snapshots[rung] if rung >= 0 else 0


def digest(value: Mapping[str, Any]) -> str:
    """A short name for plain data."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=repr).encode()).hexdigest()[:20]


def _kept(policy: Policy, curve: Curve, seconds: float) -> Work:
    leaves = jax.tree.leaves(policy)
    return {
        "leaves": np.int64(len(leaves)),
        **{f"leaf{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)},
        "steps": np.asarray(curve.steps, np.int64),
        "mean_return": np.asarray(curve.mean_return, np.float32),
        "seconds": np.float64(seconds),
    }  # pyright: ignore[reportReturnType]


def _told(error: Exception) -> str:
    """An error in one line."""
    text = str(error).strip().split("\n")[0] or type(error).__name__
    named = isinstance(error, ValueError) and "\n" not in str(error).strip()
    return text if named else f"{type(error).__name__}: {text}"
