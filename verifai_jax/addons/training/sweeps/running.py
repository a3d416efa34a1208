"""The state of a sweep that runs: its configurations, training runs, returns and certificates."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from verifai_jax._version import __version__
from verifai_jax.addons.estimation.certification._certify import certify
from verifai_jax.addons.estimation.certification.certification import Certification
from verifai_jax.addons.estimation.certification.result import Certificate, Certificates
from verifai_jax.addons.estimation.simultaneous_interval import UNSAFE, verdict_kind
from verifai_jax.addons.rl._evaluate import batched_mean_returns
from verifai_jax.addons.training.sweeps import record
from verifai_jax.addons.training.sweeps.clock import CERTIFYING, TRAINING, Clock, OutOfTime
from verifai_jax.addons.training.sweeps.fingerprint import digest
from verifai_jax.addons.training.sweeps.function_runs import FunctionRuns
from verifai_jax.addons.training.sweeps.halving import SAFETY, Halving
from verifai_jax.addons.training.sweeps.hyperparameters import Hyperparameters
from verifai_jax.addons.training.sweeps.population import Population
from verifai_jax.addons.training.sweeps.proposers import WORST, Proposer, objective
from verifai_jax.addons.training.sweeps.rows import Row, columns_and_policies, columns_of
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.trainer import FunctionTrainer
from verifai_jax.addons.training.sweeps.training_runs import TrainingRuns
from verifai_jax.core.compute.executors import Executor
from verifai_jax.core.messages.errors import end_if_interrupted
from verifai_jax.core.store.cache import Cache
from verifai_jax.core.store.log import Arrays
from verifai_jax.core.user_code.callbacks import Callback, notify
from verifai_jax.evaluation.run_on import RunOn

SCREENING = 64
"""Samples of a policy, and simulations of the attack on it, by which a search or halving chooses.

Certificates take fresh samples."""
TEST = 256
"""Samples of the test that ends a training with `Halving(until_safe=True)`."""
_MAX_BARREN = 64
"""Rounds of a search without a new configuration before proposals end."""
FOR_TRAINING = 2 / 3
"""Share of the seconds after which no training begins, to leave time to certify."""
_LAST = 10**9
"""Number of a checkpoint beyond the last one of every training."""


def runs_of(
    study: Study, cache: Cache, clock: Clock, executor: Executor | None = None
) -> TrainingRuns:
    """Return the training runs of a study, by its algorithms or its function."""
    kind = FunctionRuns if isinstance(study.trainer, FunctionTrainer) else TrainingRuns
    return kind(study, cache, clock, executor)


@dataclass(eq=False)
class _Configuration:
    """One configuration: values, training runs, and the checkpoint at which halving stopped it.

    - `passed`: whether it was stopped as its policies passed the test of `until_safe`.
    """

    values: Hyperparameters
    runs: tuple[int, ...]
    stopped: int | None = None
    passed: bool = False


@dataclass(eq=False)
class RunningSweep:
    """The state of a sweep: its configurations, training runs, returns and safety.

    An entry is a pair of numbers: a training run, and one of its checkpoints. `parents` are, for
    those that went on from others, the number of that configuration and that of the checkpoint.
    """

    study: Study
    options: dict[str, Any]
    cache: Cache
    clock: Clock
    halving: Halving | None
    certified: Certification
    callbacks: tuple[Callback, ...] = ()
    calls: int = 0
    executor: Executor | None = None
    sources: Sequence[Mapping[str, Any]] = ()
    population: Population | None = None
    runs: TrainingRuns = field(init=False)
    parents: dict[int, tuple[int, int]] = field(default_factory=dict)
    configurations: list[_Configuration] = field(default_factory=list)
    numbers: dict[str, int] = field(default_factory=dict)
    returns: dict[tuple[int, int], float] = field(default_factory=dict)
    return_range: tuple[float, float] | None = None
    safety: dict[tuple[int, int], Certificate] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.runs = runs_of(self.study, self.cache, self.clock, self.executor)

    def run(self, proposer: Proposer) -> record.SweepRecord:
        """Train and certify, or as much of it as time allows."""
        complete, certificates = True, None
        try:
            try:
                total = self.options["configurations"] * len(self.study.training_seeds)
                steps = total * self.study.trainer.steps
                with self.clock.stage(TRAINING, steps, "steps", FOR_TRAINING):
                    self._train_all(proposer)
            except OutOfTime:
                complete = False
            certificates = self._certify()
            complete &= certificates is None or certificates.stopped != "interrupted"
        except (KeyboardInterrupt, OutOfTime):
            complete = False
        return self._record(certificates, complete)

    # Training

    def _train_all(self, proposer: Proposer) -> None:
        wanted, barren = self.options["configurations"], 0
        while len(self.configurations) < wanted and barren < _MAX_BARREN:
            proposals = proposer.propose(wanted - len(self.configurations))
            if not proposals:
                return
            fresh = self._add(proposals)
            barren = 0 if fresh else barren + 1
            if fresh:
                self._train(fresh)
            if proposer.learns:
                proposer.observe(self._objectives(proposals))

    def _add(self, proposals: Sequence[Hyperparameters]) -> list[int]:
        """Add the configurations that are new; return their numbers."""
        fresh = []
        for values in proposals:
            name = digest(values)
            if name in self.numbers:
                continue
            self.numbers[name] = len(self.configurations)
            fresh.append(len(self.configurations))
            runs = tuple(self.runs.add(values, seed) for seed in self.study.training_seeds)
            self.configurations.append(_Configuration(dict(values), runs))
        return fresh

    def _train(self, numbers: Sequence[int]) -> None:
        runs = self._runs_of(numbers)
        last = len(self.study.checkpoints_of(self.study.trainer.steps)) - 1
        halving, population, members = self.halving, self.population, len(numbers)
        if halving is None and population is None:
            self.runs.train(runs, max(map(self.runs.rungs, runs)) - 1)
            self._measure_returns(runs)
            return
        compares = population is not None or (halving is not None and halving.reduction > 1)
        for rung in range(last + 1):
            self.runs.train(self._runs_of(numbers), rung, further=rung < last)
            if compares:
                self._measure_returns(self._runs_of(numbers))
            if rung < last:
                selected, added = [*numbers], list[int]()
                if halving is not None:
                    selected = self._going_on(numbers, rung, last, halving)
                if halving is not None and halving.reduction > 1:
                    selected = halving.select(self._values_at(halving.by, selected, rung))
                if population is not None:
                    selected, added = self._succession(population, selected, members, rung)
                for number in set(numbers) - set(selected):
                    self.configurations[number].stopped = rung
                    self.runs.forget(self.configurations[number].runs)
                numbers = [*selected, *added]
        self._measure_returns(self._runs_of(range(len(self.configurations))))

    def _succession(
        self, population: Population, numbers: Sequence[int], members: int, rung: int
    ) -> tuple[list[int], list[int]]:
        """Return the configurations that stay, and new ones that go on from the best of these."""
        # A function of the decisions before, so that a resumed sweep decides the same.
        rng = np.random.default_rng([self.options["seed"], 4, rung, len(self.configurations)])
        pairs = population.pairs(self._values_at(population.by, numbers, rung), members, rng)
        space, trainer, added = self.study.space, self.study.trainer, []
        for _, parent in pairs:
            origin, number = self.configurations[parent], len(self.configurations)
            values = population.changed(origin.values, space, trainer, rng)
            runs = tuple(self.runs.fork(run, rung, values) for run in origin.runs)
            self.configurations.append(_Configuration(values, runs))
            self.parents[number] = parent, rung
            added.append(number)
        ended = {number for number, _ in pairs}
        return [number for number in numbers if number not in ended], added

    def _going_on(
        self, numbers: Sequence[int], rung: int, rungs: int, halving: Halving
    ) -> list[int]:
        """Return the configurations that do not pass the test, and are not shown to be unsafe."""
        groups = {number: {*self._entries_of(number, rung)} for number in numbers}
        finite = [entry for group in groups.values() for entry in group if self._is_finite(entry)]
        passing, p, confidence = finite, self.study.p, self.certified.confidence
        for samples in (SCREENING, TEST) if halving.until_safe else ():
            # Most that do not pass show it by the first samples.
            found = self._quick_certificates(passing, [3, rung], p, confidence, samples, 0)
            fails = {entry: columns_of(one)["failures"] for entry, one in found.items()}
            passing = [entry for entry in passing if fails[entry] <= TEST * p / 2]
        for number, group in groups.items():
            self.configurations[number].passed = halving.until_safe and group <= {*passing}
        if halving.p is not None and finite:
            # All rungs together have the confidence of the sweep; each has samples of its own.
            confidence = 1 - (1 - confidence) / rungs
            found = self._quick_certificates(finite, [2, rung], halving.p, confidence)
            unsafe = {entry for entry, one in found.items() if verdict_kind(one.verdict) == UNSAFE}
            ended = {n for n, group in groups.items() if not group & {*finite} - unsafe}
            numbers = [number for number in numbers if number not in ended]
        return [number for number in numbers if not self.configurations[number].passed]

    def _quick_certificates(
        self, entries: Sequence[tuple[int, int]], stream: Sequence[int], p: float,
        confidence: float, samples: int = SCREENING, attack: int = SCREENING,
    ) -> dict[tuple[int, int], Certificate]:  # fmt: skip
        """Certify policies by few simulations, to choose among configurations."""
        if not entries:
            return {}
        # Other samples than those of the certificates.
        words = np.random.SeedSequence([self.options["seed"], *stream]).generate_state(1)
        samples = min(samples, self.options["samples"])
        screening = replace(
            self.certified, samples=samples, budget=samples * len(entries), confidence=confidence,
            attack_simulations=min(attack, self.options["attack_simulations"]),
        )  # fmt: skip
        policies = [self._policy(entry) for entry in entries]
        certificates = self._certify_policies(policies, screening, int(words[0]), p, progress=None)
        # A half-finished screening would change the proposals of a resumed sweep.
        end_if_interrupted(certificates.stopped)
        return dict(zip(entries, certificates.rows, strict=True))

    def _runs_of(self, numbers: Sequence[int]) -> list[int]:
        return [run for number in numbers for run in self.configurations[number].runs]

    def _measure_returns(self, runs: Sequence[int]) -> None:
        """Measure the nominal returns of all checkpoints of training runs that have none yet."""
        missing: list[tuple[int, int]] = []
        before = len(self.returns)
        for run in runs:
            for rung in self.runs.own_rungs(run):
                if not self._is_finite((run, rung)) or (run, rung) in self.returns:
                    continue
                arrays = self.cache.get(self._return_name(run, rung))
                if arrays is None:
                    missing.append((run, rung))
                else:
                    self.returns[run, rung] = float(arrays["return"])
        policies = [self._policy(entry) for entry in missing]
        task = self.study.trainer.evaluation_task
        if task is None:
            measured: Any = [(list(range(len(missing))), self._training_returns(missing))]
        else:
            measured = batched_mean_returns(task, policies, episodes=self.options["episodes"])
        for some, values in measured:
            entries: dict[str, Arrays] = {}
            for i, value in zip(some, values, strict=True):
                self.returns[missing[i]] = float(value)
                entries[self._return_name(*missing[i])] = {"return": np.asarray(value, np.float64)}
            self.cache.put(entries)
            self.clock.check()
        for entry in list(self.returns)[before:]:
            self._notify(entry, {"nominal_return": self.returns[entry]})

    def _training_returns(self, entries: Sequence[tuple[int, int]]) -> list[float]:
        checkpoints = [self.runs.checkpoint(*entry) for entry in entries]
        return [each.training_return for each in checkpoints if each is not None]

    def _notify(self, entry: tuple[int, int], values: Mapping[str, float]) -> None:
        """Call the callbacks with numbers of a policy."""
        run, rung = entry
        training, checkpoint = self.runs.runs[run], self.runs.checkpoint(run, rung)
        assert checkpoint is not None
        number = next(n for n, one in enumerate(self.configurations) if run in one.runs)
        self.calls += 1
        about = {
            "configuration": number, "training_seed": training.seed,
            "environment_steps": training.checkpoints[rung],
            "training_return": checkpoint.training_return,
        }  # fmt: skip
        notify(self.callbacks, self.calls, {**about, **values})

    def _return_name(self, run: int, rung: int) -> str:
        return f"return/{self.runs.cache_name(run, rung)}"

    def _is_finite(self, entry: tuple[int, int]) -> bool:
        checkpoint = self.runs.checkpoint(*entry)
        return checkpoint is not None and checkpoint.finite

    def _policy(self, entry: tuple[int, int]) -> record.TrainedPolicy:
        checkpoint = self.runs.checkpoint(*entry)
        assert checkpoint is not None
        return checkpoint.policy

    # Objectives of searches and of halving

    def _values_at(self, by: str, numbers: Sequence[int], rung: int) -> dict[int, float]:
        """Return the objectives of configurations at a checkpoint; NaN where one is unknown."""
        if by == SAFETY:
            values = self._screen({n: self._entries_of(n, rung) for n in numbers})
            return {n: float("nan") if value is None else value for n, value in values.items()}
        objectives = {}
        for number in numbers:
            entries = self._entries_of(number, rung)
            returns = [self.returns.get(entry, np.nan) for entry in entries]
            objectives[number] = -float(np.mean(returns)) if entries else float("nan")
        return objectives

    def _objectives(self, proposals: Sequence[Hyperparameters]) -> list[float | None]:
        """Return the objectives of proposals at the end of their training; None if unknown."""
        numbers = [self.numbers[digest(values)] for values in proposals]
        entries = {}
        for number in dict.fromkeys(numbers):
            rung = self.configurations[number].stopped
            entries[number] = self._entries_of(number, _LAST if rung is None else rung)
        values = self._screen(entries)
        return [values[number] for number in numbers]

    def _entries_of(self, number: int, rung: int) -> list[tuple[int, int]]:
        """Return the entries of a configuration's runs at a checkpoint, or at their last."""
        runs = self.configurations[number].runs
        return [(n, min(rung, self.runs.rungs(n) - 1)) for n in runs]

    def _screen(self, entries: dict[int, list[tuple[int, int]]]) -> dict[int, float | None]:
        """Estimate objectives of configurations by few simulations, never to certify."""
        finite = [entry for group in entries.values() for entry in group if self._is_finite(entry)]
        returns = [self.returns[entry] for entry in finite]
        if self.return_range is None and returns:
            self.return_range = min(returns), max(returns)
        safety = self._quick_certificates(finite, [1], self.study.p, self.certified.confidence)
        objectives: dict[int, float | None] = {}
        for number, group in entries.items():
            values = [self._objective(entry, safety.get(entry)) for entry in group]
            failed = any(entry[0] in self.runs.errors for entry in group)
            objectives[number] = None if failed else float(np.mean(values))
        return objectives

    def _objective(self, entry: tuple[int, int], safety: Certificate | None) -> float:
        if safety is None or self.return_range is None:
            return WORST
        rate, worst = columns_of(safety)["failure_rate"], safety.worst_robustness
        value = objective(rate, worst, self.returns[entry], self.return_range)
        return WORST if value is None else value

    # Certification

    def _certify(self) -> Certificates | None:
        """Certify the finite policies of all rows; None without any."""
        entries = [
            (run, rung)
            for run in self._runs_of(range(len(self.configurations)))
            for rung in self.runs.own_rungs(run)
            if self._is_finite((run, rung))
        ]
        if self.halving is not None and self.halving.until_safe:
            entries = list({run: (run, rung) for run, rung in entries}.values())
        if not entries:
            return None
        total = len(entries) * self.options["samples"]
        with self.clock.stage(CERTIFYING, total, "simulations"):
            # Training may have been out of time before returns were measured.
            self._measure_returns(list(dict.fromkeys(run for run, _ in entries)))
            policies = [self._policy(entry) for entry in entries]
            certificates = self._certify_policies(
                policies, self.certified, self.options["seed"], self.study.p,
                progress=self.clock.show,
            )  # fmt: skip
        self.safety = dict(zip(entries, certificates.rows, strict=True))
        for entry, safety in self.safety.items():
            numbers = columns_of(safety)
            del numbers["failure_rate"], numbers["verdict"]
            self._notify(entry, {"nominal_return": self.returns[entry], **numbers})
        return certificates

    def _certify_policies(
        self, policies: Sequence[record.TrainedPolicy], certification: Certification, seed: int,
        p: float, progress: Callable[[int, int, str], None] | None,
    ) -> Certificates:  # fmt: skip
        def remember(name: str, compute: Callable[[], Arrays]) -> Arrays:
            try:
                self.clock.check()
            except OutOfTime:
                # The certification answers an interruption by its finished part.
                raise KeyboardInterrupt from None
            return self.cache.remember(f"certify/{name}", compute)

        return certify(
            self.study.problem, policies, p=p, certification=certification, seed=seed,
            only_safe=True, remember=remember, run_on=RunOn(executor=self.executor),
            progress=progress,
        )  # fmt: skip

    # The record

    def _record(self, certificates: Certificates | None, complete: bool) -> record.SweepRecord:
        rows: list[Row] = []
        certified: dict[tuple[int, int], int] = {}
        for number, configuration in enumerate(self.configurations):
            for run in configuration.runs:
                for row in self._rows(number, configuration, run):
                    if row.entry in self.safety:
                        certified[row.entry] = len(rows)
                    rows.append(row)
        if self.population is not None:
            steps = self.study.checkpoints_of(self.study.trainer.steps)
            parents = {str(n): [one, steps[at]] for n, (one, at) in self.parents.items()}
            self.options["parents"] = parents
        return record.SweepRecord(
            study=self.study.name, seed=self.options["seed"],
            hyperparameters=tuple(self.study.space.columns), certificates=certificates,
            certified=tuple(certified[entry] for entry in self.safety), options=self.options,
            version=__version__, seconds=dict(self.clock.seconds), complete=complete,
            sources=tuple(self.sources), **columns_and_policies(rows, self.study),
        )  # fmt: skip

    def _rows(self, number: int, configuration: _Configuration, run: int) -> list[Row]:
        training, rows = self.runs.runs[run], []
        cells = {**configuration.values, "configuration": number, "seed": training.seed}
        for rung in self.runs.own_rungs(run):
            checkpoint, entry = self.runs.checkpoint(run, rung), (run, rung)
            if checkpoint is None:
                continue
            ended = configuration.stopped == rung and not configuration.passed
            status = record.STOPPED if ended else record.TRAINED
            status = status if checkpoint.finite else record.NONFINITE
            own = {"nominal_return": self.returns.get(entry, np.nan), "status": status}
            known = checkpoint, self.safety.get(entry)
            rows.append(Row({**cells, "steps": training.checkpoints[rung], **own}, entry, *known))
        if run in self.runs.errors:
            status = record.error_status(self.runs.errors[run])
            own = {"steps": training.checkpoints[-1], "nominal_return": np.nan, "status": status}
            rows.append(Row({**cells, **own}, (run, -1)))
        return rows
