"""The training runs of a sweep: policies at the checkpoints, learning curves, seconds, all cached.

    number = runs.add(values, seed=0)
    runs.train([number, ...], rung=0)                   # to the first checkpoint, or cached
    runs.checkpoint(number, 0).policy

Runs of one structure share a program. Only as many runs as there are devices train at a time, from
one checkpoint to the next, so that started runs are soon finished and cached.
"""

import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from verifai_jax.addons.clusters.executors import Shipment, gather, ship
from verifai_jax.addons.rl.batched_training import (
    BatchedTraining,
    Configuration,
    policy_structure,
    untrained_policy,
)
from verifai_jax.addons.rl.policy import Policy
from verifai_jax.addons.training.sweeps.clock import Clock, OutOfTime
from verifai_jax.addons.training.sweeps.fingerprint import digest
from verifai_jax.addons.training.sweeps.hyperparameters import Hyperparameters
from verifai_jax.addons.training.sweeps.record import Curve, TrainedPolicy
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.core.compute.executors import Executor
from verifai_jax.core.store.cache import Cache, CacheError
from verifai_jax.core.store.log import Arrays

Lineage = tuple[tuple[int, Mapping[str, Any]], ...]
RECENT = 0.1
"""Share of the updates so far, the last ones, whose mean is the training return."""


@dataclass(frozen=True, eq=False)
class RunCheckpoint:
    """A training run at one of its checkpoints: the policy, on the host; whether all its numbers
    are finite; the learning curve from the start; processor seconds on one core, without
    compilation.
    """

    policy: TrainedPolicy
    finite: bool
    curve: Curve
    seconds: float

    @property
    def training_return(self) -> float:
        """Mean return of the last tenth of the updates, or else of the last one with a return."""
        returns = np.asarray(self.curve.mean_return, np.float64)
        recent = returns[-max(1, int(np.ceil(RECENT * len(returns)))) :]
        recent = recent[np.isfinite(recent)]
        if not len(recent):
            recent = returns[np.isfinite(returns)][-1:]
        return float(np.mean(recent)) if len(recent) else float("nan")


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """One training run of a sweep.

    - `values`, `seed`: the hyper-parameters, plain values, and the training seed.
    - `key`: hash of the hyper-parameters that the algorithm uses; part of the names in the cache.
    - `checkpoints`: environment steps of its rows.
    - `configuration`: task and algorithm with these values; None if they cannot be trained.
    - `lineage`: for a run that went on from others, the number of the first checkpoint that it, and
      each of them, was trained up to with its own hyper-parameters, and these.
    """

    values: Mapping[str, object]
    seed: int
    key: str
    checkpoints: tuple[int, ...]
    configuration: Configuration | None
    lineage: Lineage = ()


class TrainingRuns:
    """All training runs of a sweep, numbered in the order in which they were added.

    They are stored in the cache at each checkpoint. The clock times and stops them, and the workers
    of an executor train, if there is one.
    """

    def __init__(
        self, study: Study, cache: Cache, clock: Clock, executor: Executor | None = None
    ) -> None:
        self.study, self.cache, self.clock = study, cache, clock
        self._executor = executor
        self._shipment: Shipment[Study] | None = None if executor is None else ship(study, executor)
        self.runs: list[TrainingRun] = []
        self.errors: dict[int, str] = {}
        self.changes: dict[tuple[int, int], Any] = {}
        """What changes in a run from before a checkpoint on: a configuration of the same structure,
        or what a training function gets as `starts`."""
        self._checkpoints: dict[tuple[int, int], RunCheckpoint] = {}
        self._policy_structures: dict[Hashable, Any] = {}
        self._compiled: set[Hashable] = set()
        self._batches: dict[int, tuple[BatchedTraining, int]] = {}

    def add(self, values: Hyperparameters, seed: int) -> int:
        """Add a training run; values that cannot be trained become an error of this run.

        **Returns:** its number.
        """
        trainer = self.study.trainer
        key = digest({n: values[n] for n in sorted(trainer.used_hyperparameters(values))})
        try:
            configuration = trainer.configuration(values, seed)
            configuration.check()
            steps = configuration.steps
        except (ValueError, TypeError) as problem:
            configuration, steps = None, trainer.steps
            self.errors[len(self.runs)] = _one_line(problem)
        checkpoints = self.study.checkpoints_of(steps)
        self.runs.append(TrainingRun(dict(values), seed, key, checkpoints, configuration))
        return len(self.runs) - 1

    def fork(self, number: int, rung: int, values: Hyperparameters) -> int:
        """Add a run that goes on from a checkpoint of another, with other hyper-parameters.

        **Returns:** its number.
        """
        self._assign_batches()
        run, child = self.runs[number], len(self.runs)
        lineage = (*(run.lineage or ((0, run.values),)), (rung + 1, dict(values)))
        configuration = self.study.trainer.configuration(values, run.seed)
        key = digest({"from": run.key, "at": run.checkpoints[rung], "values": dict(values)})
        own = {"values": dict(values), "key": key, "configuration": configuration}
        self.runs.append(replace(run, **own, lineage=lineage))
        for at in range(rung + 1):
            if (known := self._checkpoints.get((number, at))) is not None:
                self._checkpoints[child, at] = known
        for at, earlier in lineage:
            self.changes[child, at] = self.study.trainer.configuration(earlier, run.seed)
        batch, index = self._batches[number]
        self._batches[child] = batch, batch.fork(index)
        return child

    def own_rungs(self, number: int) -> range:
        """Return the numbers of the checkpoints of a run that are not those of an earlier one."""
        lineage = self.runs[number].lineage
        return range(lineage[-1][0] if lineage else 0, self.rungs(number))

    def rungs(self, number: int) -> int:
        """Return the number of checkpoints of a run."""
        return len(self.runs[number].checkpoints)

    def checkpoint(self, number: int, rung: int) -> RunCheckpoint | None:
        """Return a run at a checkpoint; None if it has not trained that far."""
        return self._checkpoints.get((number, rung))

    def structure(self, number: int) -> Hashable:
        """Return a key that is equal for runs whose policies have one form and share a program."""
        configuration = self.runs[number].configuration
        assert configuration is not None
        return policy_structure(configuration)

    def train(self, numbers: Sequence[int], rung: int, *, further: bool = False) -> None:
        """Train runs up to a checkpoint, or up to their last one if they have fewer.

        **Arguments:**
        - `numbers`: the runs.
        - `rung`: number of the checkpoint, from 0 on.
        - `further`: whether to keep their states, because some will continue from there.
        **Raises:** `OutOfTime` if the time of the stage is over.
        """
        self._assign_batches()
        waiting: dict[Hashable, list[int]] = {}
        for number in numbers:
            if number in self.errors:
                continue
            last = min(rung, self.rungs(number) - 1)
            for at in range(last + 1):
                self._recall(number, at)
            if self._has_all(number, last):
                self.clock.advance(self._steps(number, last))
            else:
                key = (id(self._batches[number][0]), self.structure(number))
                waiting.setdefault(key, []).append(number)
        if self._executor is not None:
            self._train_on_workers(list(waiting.values()), rung)
            return
        for group in waiting.values():
            # Of one length, so that devices finish together.
            group.sort(key=lambda n: (self.runs[n].checkpoints[-1], n))
            batch = self._batches[group[0]][0]
            size = len(batch.devices) * batch.per_device
            for start in range(0, len(group), size):
                self._train_group(group[start : start + size], rung, further)

    def forget(self, numbers: Sequence[int]) -> None:
        """Delete the states of runs that do not continue."""
        for number in numbers:
            if number in self._batches:
                batch, index = self._batches[number]
                batch.discard(index)

    def _assign_batches(self) -> None:
        """Put the runs of a new round into one batch, in which they stay until they are done."""
        fresh = [n for n in range(len(self.runs)) if n not in self._batches]
        trainable = [(n, c) for n in fresh if (c := self.runs[n].configuration) is not None]
        if trainable:
            batch = BatchedTraining([configuration for _, configuration in trainable])
            self._batches.update({n: (batch, index) for index, (n, _) in enumerate(trainable)})

    def _train_on_workers(self, groups: list[list[int]], rung: int) -> None:
        """Train runs on the workers of the executor, each from its beginning; caches each."""
        assert self._executor is not None
        blocks = []
        for group in groups:
            size = self._batches[group[0]][0].per_device
            blocks += [group[start : start + size] for start in range(0, len(group), size)]
        futures = []
        for block in blocks:
            work = []
            for number in block:
                run = self.runs[number]
                lineage = run.lineage or ((0, run.values),)
                work.append((lineage, run.seed, run.checkpoints[: rung + 1]))
            futures.append(self._executor.submit(train_block, self._shipment, work))

        def ended(index: int, results: list[list[Arrays] | str]) -> None:
            for number, result in zip(blocks[index], results, strict=True):
                if isinstance(result, str):
                    self.errors[number] = result
                    continue
                self.cache.put({self.cache_name(number, at): a for at, a in enumerate(result)})
                for at, arrays in enumerate(result):
                    if (number, at) not in self._checkpoints:
                        self._set_checkpoint(number, at, arrays)
                        self.clock.advance(self._steps(number, at) - self._steps(number, at - 1))
            self.clock.check()

        gather(futures, ended)

    def _train_group(self, numbers: list[int], rung: int, further: bool) -> None:
        """Train runs that share a program from checkpoint to checkpoint, caching each."""
        structure = self.structure(numbers[0])
        self.clock.advance(0, "" if structure in self._compiled else "compiling")
        self._compiled.add(structure)
        try:
            self._advance(numbers, rung)
        except (OutOfTime, MemoryError, CacheError):
            raise
        except Exception as error:
            self.forget(numbers)
            if len(numbers) > 1:
                # Alone, the run that causes the error shows.
                for number in numbers:
                    self._train_group([number], rung, further)
                return
            self.errors[numbers[0]] = _one_line(error)
            return
        ended = [n for n in numbers if not further or rung >= self.rungs(n) - 1]
        self.forget(ended)

    def _advance(self, numbers: list[int], rung: int) -> None:
        batch = self._batches[numbers[0]][0]
        number_of = {self._batches[n][1]: n for n in numbers}
        for at in range(rung + 1):
            here = [n for n in numbers if at < self.rungs(n)]
            for n in here:
                if (n, at) in self.changes:
                    batch.change(self._batches[n][1], self.changes[n, at])
            # A training that was cut off is repeated from its beginning, with the same changes.
            here = [n for n in here if self.changes or (n, at) not in self._checkpoints]
            targets = {self._batches[n][1]: self.runs[n].checkpoints[at] for n in here}
            began, busy = time.perf_counter(), 0.0
            for index in batch.advance(targets):
                number = number_of[index]
                if (number, at) in self._checkpoints:
                    continue
                policy, curve = batch.policy(index), Curve(*batch.curve(index))
                arrays = _encode(policy, curve, batch.seconds(index))
                self.cache.put({self.cache_name(number, at): arrays})
                self._set_checkpoint(number, at, arrays)
                before = self._checkpoints.get((number, at - 1))
                share = batch.seconds(index) - (before.seconds if before else 0.0)
                busy += share / len(batch.devices)
                self.clock.advance(self._steps(number, at) - self._steps(number, at - 1))
            self.clock.count_compilation(time.perf_counter() - began - busy)
            self.clock.check()

    def _has_all(self, number: int, rung: int) -> bool:
        """Return whether all checkpoints are known up to one; a damaged cache may lack any."""
        return all((number, at) in self._checkpoints for at in range(rung + 1))

    def _recall(self, number: int, rung: int) -> None:
        if (number, rung) in self._checkpoints:
            return
        arrays = self.cache.get(self.cache_name(number, rung))
        if arrays is not None:
            self._set_checkpoint(number, rung, arrays)

    def _set_checkpoint(self, number: int, rung: int, arrays: Arrays) -> None:
        leaves = [arrays[f"leaf{i}"] for i in range(int(arrays["leaves"]))]
        policy = jax.tree.unflatten(self._policy_structure(number), leaves)
        finite = all(bool(np.all(np.isfinite(leaf))) for leaf in leaves)
        curve = Curve(arrays["steps"], arrays["mean_return"])
        seconds = float(arrays["seconds"])
        self._checkpoints[number, rung] = RunCheckpoint(policy, finite, curve, seconds)

    def _policy_structure(self, number: int) -> Any:
        """Return the tree structure of a run's policy; nothing compiles."""
        structure = self.structure(number)
        if structure not in self._policy_structures:
            configuration = self.runs[number].configuration
            assert configuration is not None
            shapes = untrained_policy(configuration.algorithm, configuration.task)
            self._policy_structures[structure] = jax.tree.structure(shapes)
        return self._policy_structures[structure]

    def cache_name(self, number: int, rung: int) -> str:
        """Return the name of a run at a checkpoint in the cache."""
        run = self.runs[number]
        total, at = run.checkpoints[-1], run.checkpoints[rung]
        return f"train/{run.key}/seed {run.seed}/{at} of {total}"

    def _steps(self, number: int, rung: int) -> int:
        return self.runs[number].checkpoints[rung] if rung >= 0 else 0


def train_block(
    shipment: Shipment[Study], work: Sequence[tuple[Lineage, int, tuple[int, ...]]]
) -> list[list[Arrays] | str]:
    """Train runs, given by lineage, seed and checkpoints, together from the start; called by a
    worker.

    **Returns:** for each run the arrays of its checkpoints, or its error in one line.
    """
    trainer = shipment.thing.trainer
    found: list[list[Arrays] | str] = []
    try:
        first = [trainer.configuration(lineage[0][1], seed) for lineage, seed, _ in work]
        batch, arrays = BatchedTraining(first), [list[Arrays]() for _ in work]
        for at in range(max(len(checkpoints) for _, _, checkpoints in work)):
            for i, (lineage, seed, _) in enumerate(work):
                if at in dict(lineage):
                    batch.change(i, trainer.configuration(dict(lineage)[at], seed))
            steps = {i: each[at] for i, (_, _, each) in enumerate(work) if at < len(each)}
            for i in batch.advance(steps):
                arrays[i].append(_encode(batch.policy(i), Curve(*batch.curve(i)), batch.seconds(i)))
        found += arrays
    except MemoryError:
        raise
    except Exception as error:
        if len(work) == 1:
            return [_one_line(error)]
        # Alone, the run that causes the error shows.
        for each in work:
            found += train_block(shipment, [each])
    return found


def _encode(policy: Policy, curve: Curve, seconds: float) -> Arrays:
    leaves = jax.tree.leaves(policy)
    return {
        "leaves": np.asarray(len(leaves), np.int64),
        **{f"leaf{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)},
        "steps": np.asarray(curve.steps, np.int64),
        "mean_return": np.asarray(curve.mean_return, np.float32),
        "seconds": np.asarray(seconds, np.float64),
    }


def _one_line(error: Exception) -> str:
    """Write an error in one line, with its type unless it is a plain `ValueError`."""
    text = str(error).strip().split("\n")[0] or type(error).__name__
    plain = isinstance(error, ValueError) and "\n" not in str(error).strip()
    return text if plain else f"{type(error).__name__}: {text}"
