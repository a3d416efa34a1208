"""Hardening of a policy: train, attack, train further on the failures, certify.

    result = harden(study)                              # a Study: trainer, problem, p
    result = harden(Trainer(CartPoleTask(), PPO()), balance_with)
    print(result); result.policy

Sources: Pinto, Davidson, Sukthankar and Gupta, Robust adversarial reinforcement learning, ICML
2017; Dreossi et al., Counterexample-guided data augmentation, IJCAI 2018; Tobin et al., Domain
randomization for transferring deep neural networks, IROS 2017 (the baseline).
"""

import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

from verifai_jax._version import __version__
from verifai_jax.addons.estimation.certification import Certificates, Certification, certify
from verifai_jax.addons.estimation.comparison import Comparison, compare
from verifai_jax.addons.estimation.simultaneous_interval import safe_at
from verifai_jax.addons.rl import PPO, evaluate
from verifai_jax.addons.training.hardening import mixture
from verifai_jax.addons.training.hardening.arms import Arms
from verifai_jax.addons.training.hardening.collecting import Collected, collect
from verifai_jax.addons.training.hardening.mixture import FurtherTraining, HardeningError, Mixture
from verifai_jax.addons.training.hardening.result import BASELINE, HARDENED, Hardening
from verifai_jax.addons.training.sweeps.fingerprint import fingerprint
from verifai_jax.addons.training.sweeps.rows import columns_of
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.trainer import FunctionTrainer, Trainer
from verifai_jax.core.compute.fingerprint import stable_text
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.precision import reproducible_settings
from verifai_jax.core.display.progress import say_done, shows_progress
from verifai_jax.core.messages.checks import check_count, check_fraction, options_of
from verifai_jax.core.messages.errors import end_if_interrupted, suggests_options
from verifai_jax.core.store.cache import Cache, locked_cache
from verifai_jax.features import Categorical
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.silent_mistakes import formula_notes
from verifai_jax.statistics.stopping import Stop

ROUND, FINAL, COMPARED, ATTACK, RETURNS = range(5)
"""Numbers of the purposes for which random numbers are drawn."""
OWN_STEP, OWN_LIMIT = 0.25, 0.75
"""Step and limit by which the share of own episodes grows after a round that loses return."""
TABLE, SHRUNK = 512, 4
"""Number of prior samples in the table of a round, and of counterexamples to shrink."""


@dataclass(frozen=True, eq=False)
class Plan:
    """The options that determine the results of all rounds."""

    rounds: int
    steps: int
    further: FurtherTraining
    p: float
    certification: Certification
    episodes: int
    baseline: bool
    seed: int

    def __post_init__(self) -> None:
        for name in ("rounds", "episodes", "seed"):
            check_count(name, getattr(self, name), 0 if name == "seed" else 1)
        check_fraction("p", self.p)

    def options(self) -> dict[str, Any]:
        """Return all options by name, as plain data."""
        further, certified = dict(vars(self.further)), dict(vars(self.certification))
        certified["attack"] = stable_text(certified["attack"])
        named = {"further_steps": further.pop("steps"), **further, **certified, **vars(self)}
        return {n: o for n, o in named.items() if n not in ("further", "certification", "start")}

    def seed_for(self, purpose: int, stage: int = 0) -> int:
        """Return the seed for a purpose; different purposes get different samples."""
        key = jax.random.fold_in(jax.random.fold_in(run_keys(self.seed)[0], purpose), stage)
        return int(jax.random.bits(key) >> 1)


@suggests_options
@reproducible_settings()
@shows_progress("hardening")
def harden(
    study: Study | Trainer | object, problem: Callable[[Any], Problem] | None = None, *,
    hyperparameters: Mapping[str, object] | None = None, rounds: int = 8, steps: int | None = None,
    further: FurtherTraining | None = None, p: float | None = None,
    certification: Certification | None = None, episodes: int = 256, baseline: bool = False,
    seed: int = 0, stop: Stop | None = None, folder: str | Path | None = None,
    even_if_changed: bool = False, progress: bool | None = None,
) -> Hardening:  # fmt: skip
    """Train a policy, then train it further on its failures until it is certified.

    The first training uses the task's own episodes. Then each round attacks and certifies the
    policy, confirms and shrinks its failures, and continues the training with a mixture of
    episodes: the task's own, episodes from the prior of the problem's features, and episodes near
    failures. The result is the policy that fails least among those whose return is within
    `tolerance` of the first one's. If a paired comparison shows that it fails more often than the
    first policy, the first is returned.

    No certificate uses samples from the training: each has its own seed. The last certificate
    covers the policies before and after together, and is made after the choice.

    **Arguments:**
    - `study`: a `Study`, a `Trainer`, or a task, which `PPO` trains. A task needs a method
      `start(key, features) -> state` that starts an episode with the problem's features; tasks of
      `ode_task` have it. A training function gets the argument `starts`, a list from which each
      episode takes one entry at random: features, or `None` for an episode of the task's own. In
      the first training all entries are `None`.
    - `problem`: a function from a policy to the problem of its closed loop; by default the study's.
    - `hyperparameters`: a dictionary of the trainer's hyper-parameters.
    - `rounds`: the maximum number of rounds of attack and further training.
    - `steps`: environment steps of the first training; by default the trainer's.
    - `further`: the training of a round: its length, and where its episodes begin.
    - `p`: failure probability below which the policy is safe; by default the study's, or 0.01.
    - `certification`: the attack and the samples of each certificate; its confidence is that of
      the intervals before and after together.
    - `episodes`: number of the task's own episodes that measure returns, the same for all policies.
    - `baseline`: whether to train a second arm with plain domain randomisation: the same seed, own
      episodes and environment steps, but episodes from the prior instead of failures.
    - `stop`: the seconds after which no round begins.
    - `folder`: the folder of finished work; the same call continues an interrupted hardening.
    - all other arguments: as in `falsify` and `resume`.
    **Returns:** the result. Ctrl-C ends the call; with `folder` it may be repeated.
    **Raises:** before anything is trained, `HardeningError` for a task that cannot start with the
    features; `ValueError` for numbers out of range; the errors of `Trainer.configuration`;
    `CacheError` for a folder of another hardening; `FolderInUse` if another process writes there.
    """
    how = options_of("harden", FurtherTraining, further)
    usual = Certification(attack_simulations=512)
    certified = options_of("harden", Certification, certification or usual)
    max_seconds = options_of("harden", Stop, stop, "seconds").seconds
    made = _as_study(study, problem, p)
    trainer, values = made.trainer, dict(hyperparameters or {})
    first_steps = check_count("steps", trainer.steps if steps is None else steps)
    how = replace(how, steps=max(1, first_steps // 8) if how.steps is None else how.steps)
    p = made.p if p is None else p
    plan = Plan(rounds, first_steps, how, p, certified, episodes, baseline, seed)
    untrained = made.untrained_problem()
    untrained.check()
    with locked_cache(folder, "hardening") as cache:
        options = {name: stable_text(each) for name, each in plan.options().items()}
        options["hyperparameters"] = stable_text(sorted(values.items()))
        cache.claim(fingerprint(made, options), untrained.sources(), even_if_changed)
        result = Work(made, plan, values, untrained, cache).run(max_seconds)
    if folder is not None:
        with cache.writing(folder):
            result.save(folder)
    return result


@dataclass(eq=False)
class Work:
    """The rounds of a hardening; finished parts are read from the cache."""

    study: Study
    plan: Plan
    values: Mapping[str, object]
    untrained: Problem
    cache: Cache

    def __post_init__(self) -> None:
        study, plan, untrained = self.study, self.plan, self.untrained
        self.arms_named = (HARDENED, BASELINE) if plan.baseline else (HARDENED,)
        each, rounds = plan.further.steps or 0, range(plan.rounds + 1)
        self.stages = [plan.steps + stage * each for stage in rounds]
        trainer, space, mixed = study.trainer, untrained.space, None
        self.task = trainer.nominal
        if not isinstance(trainer, FunctionTrainer):
            configured = trainer.configuration(self.values, plan.seed)
            configured.check()
            self.task = configured.task if trainer.nominal is None else trainer.nominal
            mixed = mixture.mixture_of(configured.task, untrained, plan.further.start)
        known = study, self.values, self.stages, plan.seed, self.cache, self.arms_named
        self.arms = Arms(*known, mixed)
        self.points, self.radii = np.zeros((0, space.dim), np.float32), np.zeros(0)
        self.own = dict.fromkeys(self.arms_named, plan.further.own)
        self.rows: list[dict[str, Any]] = []
        self.added: list[pd.DataFrame] = []
        self.policies: dict[tuple[str, int], Any] = {}
        self.returns: dict[tuple[str, int], np.ndarray] = {}

    def run(self, max_seconds: float | None) -> Hardening:
        """Run rounds until the policy is certified or the budget ends."""
        began, plan, stopped = time.perf_counter(), self.plan, "budget"
        for stage in range(plan.rounds + 1):
            # The verbs of a round count their simulations in the same line.
            say_done(0, figures=f"round {stage} of {plan.rounds}")
            certificates = self._stage(stage)
            late = max_seconds is not None and time.perf_counter() - began > max_seconds
            if certificates[0].verdict == safe_at(plan.p) and self._keeps_return(HARDENED, stage):
                stopped = "certified"
            elif late and stage < plan.rounds:
                stopped = "max_seconds"
            if stopped != "budget" or stage == plan.rounds:
                break
            self._collect(stage, certificates)
        return self._result(stopped, began)

    def _stage(self, stage: int) -> Certificates:
        """Train up to a stage, attack and certify, and measure returns."""
        plan, began = self.plan, time.perf_counter()
        policies = self.arms.policies(stage)
        certificates = self._certify(policies, plan.certification, plan.seed_for(ROUND, stage))
        for number, (arm, policy) in enumerate(zip(self.arms_named, policies, strict=True)):
            self.policies[arm, stage] = policy
            self.returns[arm, stage] = self._returns(number, stage, policy)
            one, certificate = columns_of(certificates[number]), certificates[number]
            del one["worst_robustness"]
            row = {"round": stage, "arm": arm, "steps": self.stages[stage], **one}
            row |= {"attack_failures": certificate.attack_failures, "cost": certificate.cost}
            row |= {"return": float(self.returns[arm, stage].mean()), "added": 0}
            self.rows.append({**row, "seconds": time.perf_counter() - began})
        return certificates

    def _certify(
        self, policies: Sequence[Any], certification: Certification, seed: int
    ) -> Certificates:
        certificates = certify(
            self.study.problem, policies, p=self.plan.p, certification=certification, seed=seed,
            tie=self.plan.p, progress=False, remember=self.cache.remember,
        )  # fmt: skip
        end_if_interrupted(certificates.stopped)
        return certificates

    def _collect(self, stage: int, certificates: Certificates) -> None:
        """Add the failures of a stage's hardened policy to the episodes of the next stage."""
        plan, space = self.plan, self.untrained.space

        def compute() -> dict[str, np.ndarray]:
            found = collect(
                self.study.problem(self.policies[HARDENED, stage]),
                certificates.counterexamples(0), self.points,
                seed=plan.seed_for(ATTACK, stage), added=plan.further.added, table=TABLE,
                shrunk=SHRUNK,
            )  # fmt: skip
            return {name: np.asarray(value) for name, value in found._asdict().items()}

        known: dict[str, Any] = self.cache.remember(f"collected/{stage}", compute)
        found = Collected(**known)
        self.points, self.radii = (
            np.concatenate([one[found.kept], new])[-mixture.CAPACITY :]
            for one, new in ((self.points, found.points), (self.radii, found.radii))
        )
        row = self.rows[-len(self.arms_named)]
        row["added"], row["cost"] = len(found.points), row["cost"] + int(found.simulations)
        if len(found.points):
            columns = space.rows(space.features_at(found.points))
            self.added.append(pd.DataFrame(columns).assign(round=stage, source=found.sources))
        rate, mixtures = certificates[0].rate.estimate if certificates[0].rate else 0.0, []
        for arm, count in zip(self.arms_named, (len(self.points), 0), strict=False):
            change = -OWN_STEP if self._keeps_return(arm, stage) else OWN_STEP
            own = self.own[arm] = max(plan.further.own, min(self.own[arm] + change, OWN_LIMIT))
            # The more of the prior fails, the more of its episodes begin at failures anyway.
            wanted = plan.further.failing * (1 - own) / max(1 - plan.further.own, 1e-9)
            failing = min(max((wanted - (1 - own) * rate) / max(1 - rate, 1e-9), 0.0), wanted)
            shares = (own, 1 - own - failing, failing)
            mixtures.append(Mixture.of(space, shares, self.points[:count], self.radii[:count]))
        self.arms.mix(stage + 1, mixtures)

    def _returns(self, number: int, stage: int, policy: Any) -> np.ndarray:
        if self.task is None:
            return np.array([self.arms.training_return(number, stage)])
        seed, episodes = self.plan.seed_for(RETURNS), self.plan.episodes
        return np.asarray(evaluate(self.task, policy, seed=seed, episodes=episodes), np.float64)

    def _keeps_return(self, arm: str, stage: int) -> bool:
        before, now = (float(self.returns[arm, at].mean()) for at in (0, stage))
        return not now < before - self.plan.further.tolerance * abs(before)

    def _choice(self, arm: str) -> int:
        """Return the stage that fails least among those that keep the return, else the first."""
        rows = [row for row in self.rows if row["arm"] == arm]
        kept = [row for row in rows if self._keeps_return(arm, row["round"])]
        best = min(kept, key=lambda r: (r["failure_rate"], r["attack_failures"], -r["return"]))
        return best["round"]

    def _result(self, stopped: str, began: float) -> Hardening:
        """Choose a policy, certify it and the first on fresh samples, and compare both in pairs."""
        plan, notes = self.plan, [*formula_notes(self.untrained)]
        sampled = plan.certification
        chosen = {arm: self._choice(arm) for arm in self.arms_named}
        comparison: Comparison | None = None
        if at := chosen[HARDENED]:
            comparison = compare(
                *(self.study.problem(self.policies[HARDENED, stage]) for stage in (0, at)),
                confidence=sampled.confidence, budget=16 * sampled.samples,
                seed=plan.seed_for(COMPARED), undisturbed=False, progress=False,
            )  # fmt: skip
            end_if_interrupted(comparison.stopped)
            if comparison.regression:
                notes.append(
                    f"the paired comparison shows that the policy of round {at} fails more often, "
                    "so that the first one is returned"
                )
                chosen[HARDENED] = 0
        start = self.policies[HARDENED, 0]
        finalists = [start, *(self.policies[arm, at] for arm, at in chosen.items())]
        more = {"samples": 4 * sampled.samples, "budget": None, "attack_simulations": 0}
        final = self._certify(finalists, replace(sampled, **more), plan.seed_for(FINAL))
        returns = {arm: self.returns[arm, at] for arm, at in chosen.items()}
        return Hardening(
            problem=self.untrained.name, table=pd.DataFrame(self.rows),
            added=pd.concat(self.added, ignore_index=True) if self.added else pd.DataFrame(),
            start=start, policy=finalists[1], policies=self.policies, chosen=chosen,
            certificates=final, comparison=comparison,
            returns={"start": self.returns[HARDENED, 0], **returns},
            stopped=stopped, seconds=time.perf_counter() - began, options=plan.options(),
            notes=tuple(notes), version=__version__,
        )  # fmt: skip


def _as_study(given: object, problem: Callable[[Any], Problem] | None, p: float | None) -> Study:
    if isinstance(given, Study):
        if problem is not None:
            raise ValueError("a Study has its own problem; leave out problem=")
        study = given
    elif problem is None:
        raise HardeningError(
            "harden needs problem=, a function from a policy to the Problem of its closed loop"
        )
    else:
        trainer = given if isinstance(given, Trainer) else Trainer(given, PPO())
        space = {"steps": Categorical(trainer.steps)}
        study = Study(trainer.name, space, trainer, problem, p=0.01 if p is None else p)
    trainer = study.trainer
    if isinstance(trainer, FunctionTrainer):
        if "starts" not in inspect.signature(trainer.train).parameters:
            raise HardeningError(
                f"harden says where the episodes of a training begin: give {trainer.name} an "
                "argument starts, a list of features, with None for an episode of its own"
            )
        trainer.check(study.space)
    return study
