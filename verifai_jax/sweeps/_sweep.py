"""Train many configurations and rank what they learn by its safety.

    found = sweep(study, search="halton", configurations=32)
    found = sweep(study, search="bayes", configurations=64, store="sweeps/mine")   # resumable

A sweep is a deterministic function of pieces of work that are remembered one by one: a training up
to a snapshot, the return of a policy, a part of a certification. Killed at any moment and called
again with the same store, it finds what was finished, computes the rest, and gives the same table.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from verifai_jax._version import __version__
from verifai_jax.certification.attack import usable_search
from verifai_jax.core.errors import suggests_options
from verifai_jax.rl._evaluate import EPISODES, batched_mean_returns
from verifai_jax.search import Search
from verifai_jax.sweeps.cache import Store
from verifai_jax.sweeps.clock import CERTIFYING, TRAINING, OutOfTime, Watch
from verifai_jax.sweeps.fingerprint import describe
from verifai_jax.sweeps.halving import SAFETY, Halving
from verifai_jax.sweeps.proposers import WORST, Asker, Values, asker_for, badness
from verifai_jax.sweeps.record import NONFINITE, STOPPED, TRAINED, SweepRecord
from verifai_jax.sweeps.result import Sweep
from verifai_jax.sweeps.rows import Row, tabulated
from verifai_jax.sweeps.safety import QUICK, Judged, Judgement, certify_policies
from verifai_jax.sweeps.study import Study
from verifai_jax.sweeps.training_runs import Lessons, Reached, digest
from verifai_jax.sweeps.validation import check_asked

_BARREN = 64
"""Rounds of a search without a new configuration, after which there are no more."""
_FOR_TRAINING = 2 / 3
"""Share of `max_seconds` after which no training begins, so that there is time to certify."""


@suggests_options
def sweep(
    study: Study,
    search: Any = "halton",
    configurations: int = 32,
    *,
    seed: int = 0,
    samples: int = 512,
    confidence: float = 0.95,
    budget: int | None = None,
    attack: str | Search = "cross_entropy",
    attack_simulations: int = 256,
    halving: Halving | None = None,
    batch: int | None = None,
    episodes: int = EPISODES,
    store: str | Path | None = None,
    max_seconds: float | None = None,
    progress: bool | None = True,
    note: Mapping[str, Any] | None = None,
) -> Sweep:
    """Train configurations of a study's hyper-parameters and certify the policies they learn.

    A row of the result is a policy: a configuration, trained with one seed, at one snapshot. The
    same seed gives the same table on one machine. Interrupted (Ctrl-C), it returns what it has.

    **Arguments:**

    - `study`: what to sweep.
    - `search`: over the hyper-parameters: a name, a `Search`, `"optuna:tpe"`, or an
      `OptunaSampler`. One that learns goes in rounds and is told how often the policies fail, then
      how nearly, then what they earn.
    - `configurations`: how many, at most; each is trained once for each of the study's seeds.
    - `seed`: of the search and of the samples; training seeds are the study's.
    - `samples`, `confidence`, `budget`: of the certification: samples of each policy at least,
      confidence of all verdicts together, and samples in all; see `certify`.
    - `attack`, `attack_simulations`: the search that tries to make each policy fail first, and its
      simulations of each policy; the failures that it finds enter no rate.
    - `halving`: stop all but the best at each snapshot.
    - `batch`: configurations in a round of a search that learns.
    - `episodes`: over which the nominal return is a mean.
    - `store`: a folder or a `.sqlite` file that remembers finished work; with the store of the same
      sweep it goes on.
    - `max_seconds`: after two thirds of which no training begins, and after which nothing does.
    - `progress`: False draws no bars.
    - `note`: plain data that the store keeps beside the work.

    **Raises:** before anything trains, what `Study.check` does; `ValueError` for options out of
    range and for a search that needs gradients; `UnknownNameError` for an unknown search or option;
    `StoreError` for a store that is damaged, foreign, or of another sweep.
    """
    check_asked(
        study,
        configurations=configurations,
        seed=seed,
        samples=samples,
        confidence=confidence,
        budget=budget,
        attack_simulations=attack_simulations,
        halving=halving,
        batch=batch,
        episodes=episodes,
        max_seconds=max_seconds,
    )
    study.check()
    usable_search(study.untrained_problem(), attack)
    asker = asker_for(search, study.space, configurations=configurations, seed=seed, batch=batch)
    options = {
        "search": asker.described(),
        "seed": seed,
        "samples": samples,
        "confidence": confidence,
        "budget": budget,
        "attack": attack if isinstance(attack, str) else repr(attack),
        "attack_simulations": attack_simulations,
        "halving": None if halving is None else {"reduction": halving.reduction, "by": halving.by},
        "episodes": episodes,
    }
    if asker.learns:
        # What it proposes depends on both.
        options |= {"configurations": configurations, "batch": asker.batch}
    with Store(store) as memory, Watch(study.name, max_seconds, progress) as watch:
        memory.belongs(describe(study, options))
        if note is not None:
            memory.note("command", dict(note))
        options |= {"configurations": configurations, "p": study.p}
        options["curve"] = None if study.curve_formula is None else str(study.curve_formula)
        sweeping = _Sweeping(study, options, memory, watch, halving, attack)
        return Sweep(sweeping.run(asker), study)


@dataclass(eq=False)
class _Configuration:
    """One set of hyper-parameters: its trainings, and at which snapshot halving stopped it."""

    values: Values
    lessons: tuple[int, ...]
    stopped: int | None = None


@dataclass(eq=False)
class _Sweeping:
    """A sweep on its way."""

    study: Study
    options: dict[str, Any]
    store: Store
    watch: Watch
    halving: Halving | None
    attack: str | Search
    lessons: Lessons = field(init=False)
    found: list[_Configuration] = field(default_factory=list)
    known: dict[str, int] = field(default_factory=dict)
    returns: dict[tuple[int, int], float] = field(default_factory=dict)
    earned: tuple[float, float] | None = None
    judged: dict[tuple[int, int], Judged] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.lessons = Lessons(self.study, self.store, self.watch)

    def run(self, asker: Asker) -> SweepRecord:
        """All stages, or as many as there is time for."""
        complete, certificates = True, None
        try:
            try:
                total = self.options["configurations"] * len(self.study.training_seeds)
                steps = total * self.study.trainer.steps
                with self.watch.stage(TRAINING, steps, "steps", _FOR_TRAINING):
                    self._train_all(asker)
            except OutOfTime:
                complete = False
            certificates = self._certify()
            complete &= getattr(certificates, "stopped", "") != "interrupted"
        except (KeyboardInterrupt, OutOfTime):
            complete = False
        return self._record(certificates, complete)

    # Training

    def _train_all(self, asker: Asker) -> None:
        barren = 0
        while len(self.found) < self.options["configurations"] and barren < _BARREN:
            proposed = asker.ask(self.options["configurations"] - len(self.found))
            if not proposed:
                return
            fresh = self._added(proposed)
            barren = 0 if fresh else barren + 1
            if fresh:
                self._train(fresh)
            if asker.learns:
                asker.tell(self._badness_of(proposed))

    def _added(self, proposed: Sequence[Values]) -> list[int]:
        """Numbers of the configurations that are new."""
        fresh = []
        for values in proposed:
            name = digest(values)
            if name in self.known:
                continue
            self.known[name] = len(self.found)
            fresh.append(len(self.found))
            lessons = tuple(self.lessons.add(values, s) for s in self.study.training_seeds)
            self.found.append(_Configuration(dict(values), lessons))
        return fresh

    def _train(self, numbers: Sequence[int]) -> None:
        lessons = self._lessons_of(numbers)
        last = len(self.study.snapshots_of(self.study.trainer.steps)) - 1
        if self.halving is None:
            self.lessons.reach(lessons, max(map(self.lessons.rungs, lessons)) - 1)
            self._measure(lessons)
            return
        for rung in range(last + 1):
            self.lessons.reach(self._lessons_of(numbers), rung, further=rung < last)
            self._measure(self._lessons_of(numbers))
            if rung < last:
                bad = self._judged_by(self.halving.by, numbers, rung)
                kept = self.halving.kept(bad)
                for number in set(bad) - set(kept):
                    self.found[number].stopped = rung
                    self.lessons.forget(self.found[number].lessons)
                numbers = kept

    def _lessons_of(self, numbers: Sequence[int]) -> list[int]:
        return [lesson for number in numbers for lesson in self.found[number].lessons]

    def _measure(self, lessons: Sequence[int]) -> None:
        """The nominal returns of all snapshots of these trainings that have none yet."""
        missing: list[tuple[int, int]] = []
        for lesson in lessons:
            for rung in range(self.lessons.rungs(lesson)):
                reached = self.lessons.reached(lesson, rung)
                if reached is None or not reached.finite or (lesson, rung) in self.returns:
                    continue
                work = self.store.get(self._return_name(lesson, rung))
                if work is None:
                    missing.append((lesson, rung))
                else:
                    self.returns[lesson, rung] = float(work["return"])
        policies = [self._policy(place) for place in missing]
        task = self.study.trainer.measured_on
        for some, values in batched_mean_returns(task, policies, episodes=self.options["episodes"]):
            work = {}
            for i, value in zip(some, values, strict=True):
                self.returns[missing[i]] = float(value)
                work[self._return_name(*missing[i])] = {"return": np.float64(value)}
            self.store.put(work)
            self.watch.check()

    def _return_name(self, lesson: int, rung: int) -> str:
        return f"return/{self.lessons.name(lesson, rung)}"

    def _policy(self, place: tuple[int, int]) -> Any:
        reached = self.lessons.reached(*place)
        assert reached is not None
        return reached.policy

    # What searches and halving go by

    def _judged_by(self, by: str, numbers: Sequence[int], rung: int) -> dict[int, float]:
        """How bad configurations are at a snapshot, for halving."""
        if by == SAFETY:
            bad = self._quick({n: self._places_of(n, rung) for n in numbers})
            return {n: float("nan") if b is None else b for n, b in bad.items()}
        found = {}
        for number in numbers:
            places = self._places_of(number, rung)
            returns = [self.returns.get(place, np.nan) for place in places]
            found[number] = -float(np.mean(returns)) if places else float("nan")
        return found

    def _badness_of(self, proposed: Sequence[Values]) -> list[float | None]:
        """How bad the proposed configurations turned out, at the end of their training."""
        numbers = [self.known[digest(values)] for values in proposed]
        places = {}
        for number in dict.fromkeys(numbers):
            rung = self.found[number].stopped
            places[number] = self._places_of(number, 10**9 if rung is None else rung)
        bad = self._quick(places)
        return [bad[number] for number in numbers]

    def _places_of(self, number: int, rung: int) -> list[tuple[int, int]]:
        """A configuration's trainings at a snapshot, or at their last."""
        lessons = self.found[number].lessons
        return [(n, min(rung, self.lessons.rungs(n) - 1)) for n in lessons]

    def _quick(self, places: dict[int, list[tuple[int, int]]]) -> dict[int, float | None]:
        """How bad configurations are, from few simulations: to choose by, never to certify."""
        finite = [
            place
            for found in places.values()
            for place in found
            if (r := self.lessons.reached(*place)) is not None and r.finite
        ]
        returns = [self.returns[place] for place in finite]
        if self.earned is None and returns:
            self.earned = min(returns), max(returns)
        samples = min(QUICK, self.options["samples"])
        judged: dict[tuple[int, int], Judged] = {}
        if finite:
            # Other samples than those of the certificates.
            seed = int(np.random.SeedSequence([self.options["seed"], 1]).generate_state(1)[0])
            policies = [self._policy(place) for place in finite]
            quick = self._certified(
                policies,
                samples=samples,
                budget=samples * len(policies),
                seed=seed,
                attack_simulations=min(QUICK, self.options["attack_simulations"]),
                progress=None,
            )
            if getattr(quick.certificates, "stopped", "") == "interrupted":
                # Nobody should choose by half of what there is to know.
                raise KeyboardInterrupt
            judged = dict(zip(finite, quick.policies, strict=True))
        bad: dict[int, float | None] = {}
        for number, found in places.items():
            values = [self._bad(place, judged.get(place)) for place in found]
            refused = any(place[0] in self.lessons.errors for place in found)
            bad[number] = None if refused else float(np.mean(values))
        return bad

    def _bad(self, place: tuple[int, int], judged: Judged | None) -> float:
        if judged is None or self.earned is None:
            return WORST
        found = badness(judged.rate, judged.worst, self.returns[place], self.earned)
        return WORST if found is None else found

    # Certification

    def _certify(self) -> Any:
        """Certify the finite policies of all rows."""
        places = [
            (lesson, rung)
            for lesson in self._lessons_of(range(len(self.found)))
            for rung in range(self.lessons.rungs(lesson))
            if (r := self.lessons.reached(lesson, rung)) is not None and r.finite
        ]
        if not places:
            return None
        total = len(places) * self.options["samples"]
        with self.watch.stage(CERTIFYING, total, "simulations"):
            # Training may have been out of time before returns were measured.
            self._measure(list(dict.fromkeys(lesson for lesson, _ in places)))
            made = self._certified(
                [self._policy(place) for place in places],
                samples=self.options["samples"],
                budget=self.options["budget"],
                seed=self.options["seed"],
                attack_simulations=self.options["attack_simulations"],
                progress=self.watch.told,
            )
        self.judged = dict(zip(places, made.policies, strict=True))
        return made.certificates

    def _certified(self, policies: list[Any], **how: Any) -> Judgement:
        def remember(name: str, compute: Callable[[], dict[str, np.ndarray]]) -> Any:
            try:
                self.watch.check()
            except OutOfTime:
                # As if somebody had stopped it: then the certification says what it knows.
                raise KeyboardInterrupt from None
            return self.store.remember(f"certify/{name}", compute)

        return certify_policies(
            self.study.problem,
            policies,
            p=self.study.p,
            confidence=self.options["confidence"],
            attack=self.attack,
            remember=remember,
            **how,
        )

    # The record

    def _record(self, certificates: Any, complete: bool) -> SweepRecord:
        rows: list[Row] = []
        certified: dict[tuple[int, int], int] = {}
        for number, configuration in enumerate(self.found):
            for lesson in configuration.lessons:
                for row in self._rows(number, configuration, lesson):
                    if row.place in self.judged:
                        certified[row.place] = len(rows)
                    rows.append(row)
        table = tabulated(rows, self.study)
        return SweepRecord(
            study=self.study.name,
            seed=self.options["seed"],
            hyperparameters=tuple(self.study.space.columns),
            certificates=certificates,
            certified=tuple(certified[place] for place in self.judged),
            options=self.options,
            version=__version__,
            seconds=dict(self.watch.seconds),
            complete=complete,
            **table,
        )

    def _rows(self, number: int, configuration: _Configuration, lesson: int) -> list[Row]:
        asked = self.lessons.lessons[lesson]
        found: list[Row] = []
        for rung, steps in enumerate(asked.snapshots):
            reached: Reached | None = self.lessons.reached(lesson, rung)
            if reached is None:
                continue
            status = TRAINED if configuration.stopped != rung else STOPPED
            found.append(
                Row(
                    configuration=number,
                    seed=asked.seed,
                    steps=steps,
                    values=configuration.values,
                    status=status if reached.finite else NONFINITE,
                    place=(lesson, rung),
                    reached=reached,
                    nominal_return=self.returns.get((lesson, rung), float("nan")),
                    judged=self.judged.get((lesson, rung)),
                )
            )
        if lesson in self.lessons.errors:
            found.append(
                Row(
                    configuration=number,
                    seed=asked.seed,
                    steps=asked.snapshots[-1],
                    values=configuration.values,
                    status=f"error: {self.lessons.errors[lesson]}",
                    place=(lesson, -1),
                )
            )
        return found
