"""Certified-safe configurations per processor hour, beside Optuna with rejax and Monte Carlo.

    python benchmarks/safe_sweeps.py cartpole --configurations 32 --seeds 0 1 2
    python benchmarks/safe_sweeps.py mountain_car lane_keeping --sides ours rejax
    python benchmarks/safe_sweeps.py reacher inverted_pendulum      # physics of MJX and of Brax
    python benchmarks/safe_sweeps.py cartpole --check 100000        # counts ten certificates again

Each side gets the same space of hyper-parameters, maximum number of steps, network and number of
configurations. The sides are

- `ours`: `vj.sweep` with a narrow cross-entropy search, where a training ends at the first of seven
  checkpoints that passes a test, and the last policy of each training is certified;
- `halton`: `vj.sweep` with its defaults: Halton points, and all trainings go to their end;
- `learning`: the search of `ours`, and all trainings go to their end;
- `halving`: successive halving of Halton points, of which the safest two thirds go on at each of
  the seven checkpoints, and with the test of `ours`;
- `population`: population-based training from the same points, at the same checkpoints with the
  same test; the safest quarter takes the places of the worst;
- `rejax`: Optuna's TPE proposes for the best nominal return, rejax trains with hyper-parameters as
  arguments of one program, and each policy is simulated in one program at independent samples, as
  many as show it to be safe if none fails or one in four hundred does, with Clopper-Pearson bounds
  that hold together (Bonferroni). It needs `pip install optuna rejax gymnax`, and is left out in
  words without them;
- `stable_baselines`: the same with PPO of stable-baselines3, whose environments step together in a
  program of JAX. It needs `pip install optuna stable-baselines3 gymnax`.

Times are of this process's processors. Each side runs once before, with four configurations and
other seeds, so that programs are compiled; what that took is printed apart. `first` is the
processor time until the first configuration was trained that is safe in the end, on average over
the order of the configurations, with the certificates of all up to there. Where trainings end at a
test, `passed` is the time until the first one passed that is safe in the end, as it was.
"""

import argparse
import collections
import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import verifai_jax as vj
from benchmarks.hardening import lane_with
from envs.cartpole_task import CartPoleTask
from envs.lane_keeping import LaneKeepingTask
from envs.mountain_car import MountainCarTask
from envs.reacher import reacher_task
from specs.cartpole import balance_with
from specs.mountain_car import climb_with, trained_on
from specs.reacher import reach_with
from verifai_jax.addons.estimation.intervals import upper_bound
from verifai_jax.addons.rl import PPO, Continuous, Discrete, Policy, brax_task, evaluate
from verifai_jax.addons.training.sweeps.running import RunningSweep
from verifai_jax.addons.training.sweeps.training_runs import TrainingRuns
from verifai_jax.search.cross_entropy import CrossEntropy

HIDDEN = (64, 64)
CONFIDENCE, P = 0.95, 0.01
OPTIMISER = {
    "learning_rate": vj.LogUniform(3e-4, 1e-2),
    "discount": vj.Box(0.95, 0.999),
    "gae_lambda": vj.Box(0.9, 1.0),
    "clip": vj.Box(0.1, 0.4),
    "entropy": vj.Box(0.0, 0.02),
}
THEIR_NAMES = {"discount": "gamma", "clip": "clip_eps", "entropy": "ent_coef"}


@dataclasses.dataclass(frozen=True)
class Case:
    """A task to train on, the one that returns are measured on, and the closed loop to certify: its
    failure probability is to be below `p`.
    """

    task: Any
    nominal: Any
    problem: Callable[[Any], vj.Problem]
    steps: int
    ranges: dict[str, Any]
    settings: dict[str, Any]
    p: float = P

    def study(self, checkpoints: int = 0) -> vj.Study:
        """Return the study of our side, with so many checkpoints before the end."""
        ppo = PPO(anneal=False, hidden=HIDDEN, value_hidden=HIDDEN, **self.settings)
        return vj.Study(
            "safe_sweeps",
            space=OPTIMISER | self.ranges,
            trainer=vj.Trainer(self.task, ppo, steps=self.steps, nominal=self.nominal),
            problem=self.problem,
            p=self.p,
            checkpoints=[self.steps * i // (checkpoints + 1) for i in range(1, checkpoints + 1)],
        )


def upright_with(policy: Policy) -> vj.Problem:
    """Return the problem of Brax' inverted pendulum for a policy: 4 s upright near the middle."""
    system = vj.brax(
        PENDULUM.env,
        policy.act,
        duration=4.0,
        features={"mass": "link.inertia.mass[pole]"},
        initial={"angle": "q[hinge]", "cart": "q[slider]", "speed": "qd[hinge]"},
        signals={"cart": 0, "angle": 1},
    )
    space = {
        "angle": vj.Box(-0.15, 0.15),  # rad
        "cart": vj.Box(-0.5, 0.5),  # m
        "speed": vj.Box(-0.5, 0.5),  # rad/s
        "mass": vj.Box(2.0, 10.0),  # kg
    }
    formula = "(always abs(angle) <= 0.2) & always abs(cart) <= 1"
    return vj.Problem("upright", space, system, formula)


REACHER = reacher_task(varied=True)
PENDULUM = brax_task("inverted_pendulum", backend="generalized", time_limit=200)
CASES = {
    "cartpole": Case(
        CartPoleTask(length_range=0.0, x0_range=0.05),
        CartPoleTask(),
        balance_with,
        32_768,
        {"length_range": vj.Box(0.0, 2.0), "x0_range": vj.Box(0.05, 1.0)},
        {},
    ),
    "mountain_car": Case(
        trained_on(10.0),
        MountainCarTask(),
        climb_with,
        131_072,
        {"potential": vj.Box(1.0, 100.0)},
        {"environments": 16, "normalise": True},
    ),
    "lane_keeping": Case(
        LaneKeepingTask(varied=True), LaneKeepingTask(varied=True), lane_with, 131_072, {}, {}
    ),
    "reacher": Case(
        REACHER,
        REACHER,
        reach_with,
        393_216,
        {},
        {"environments": 32, "horizon": 64, "minibatches": 8, "normalise": True},
        p=0.05,
    ),
    "inverted_pendulum": Case(
        PENDULUM, PENDULUM, upright_with, 131_072, {}, {"environments": 16, "normalise": True}
    ),
}


@dataclasses.dataclass
class Outcome:
    """What a side found, and the processor seconds of its stages."""

    safe: list[bool]
    seconds: dict[str, float]
    policies: list[Any]
    first: float
    passed: float = math.nan
    nominal: float = math.nan

    def with_return(self, case: Case) -> "Outcome":
        """Return it with the mean nominal return of its safe policies, in uncounted time."""
        found = [p for p, good in zip(self.policies, self.safe, strict=True) if good]
        returns = [float(evaluate(case.nominal, policy, episodes=20).mean()) for policy in found]
        return dataclasses.replace(self, nominal=float(np.mean(returns)) if returns else math.nan)


NARROW = CrossEntropy(min_elite=4, widening=1.0)
EARLY = vj.Halving(reduction=1, until_safe=True)
THIRDS = vj.Halving(reduction=1.5, by="safety", until_safe=True)
SIDES: dict[str, tuple[Any, vj.Halving | None, int]] = {
    "ours": (NARROW, EARLY, 7),
    "halton": ("halton", None, 0),
    "learning": (NARROW, None, 0),
    "halving": ("halton", THIRDS, 7),
    "population": (vj.Population(by="safety"), EARLY, 7),
}
"""Search, halving, and checkpoints before the end of each side of ours."""
STAGES = {
    "training": (TrainingRuns, "train"),
    "returns": (RunningSweep, "_measure_returns"),
    "tests": (RunningSweep, "_going_on"),
    "search": (RunningSweep, "_screen"),
    "certifying": (RunningSweep, "_certify"),
}
spent: dict[str, float] = collections.defaultdict(float)
passed: dict[int, float] = {}
"""When each configuration of our sweep passed its test, in processor seconds."""


def count_time(stage: str) -> None:
    """Count the processor time of a stage of our sweeps from now on."""
    owner, name = STAGES[stage]
    method = getattr(owner, name)

    @functools.wraps(method)
    def timed(*arguments: Any, **options: Any) -> Any:
        began = time.process_time()
        try:
            return method(*arguments, **options)
        finally:
            spent[stage] += time.process_time() - began
            for number, each in enumerate(arguments[0].configurations if stage == "tests" else ()):
                if each.passed:
                    passed.setdefault(number, time.process_time())

    setattr(owner, name, timed)


def our_side(
    study: vj.Study, configurations: int, seed: int, *, search: Any, halving: Any
) -> Outcome:
    """Sweep with this package."""
    spent.clear()
    passed.clear()
    before = time.process_time()
    result = vj.sweep(
        study, search, configurations=configurations, seed=seed, halving=halving,
        batch=max(1, configurations // 2) if search is NARROW else None,
    )  # fmt: skip
    total = time.process_time() - before
    seconds = {**spent, "other": total - sum(spent.values())}
    table = result.table
    last = table.loc[table.groupby("configuration")["steps"].idxmax()]
    safe = last["verdict"].str.startswith("safe").tolist()
    when = [passed[n] - before for n in last["configuration"][safe] if n in passed]
    policies = [result.policy(i) for i in last.index]
    return Outcome(safe, seconds, policies, until_first(safe, total), min(when, default=math.nan))


def until_first(safe: list[bool], total: float) -> float:
    """Return the expected cost until the first safe configuration, in a random order."""
    found = sum(safe)
    return total * (len(safe) + 1) / (found + 1) / len(safe) if found else math.inf


def environment_of(case: Case) -> Any:
    """Return the task as an environment of gymnax' form, whose parameters are the task."""
    from gymnax.environments import spaces  # pyright: ignore[reportMissingImports]

    class Environment:
        default_params = parameters_of(case.task)

        def action_space(self, task: Any) -> Any:
            kind = case.task.action
            if isinstance(kind, Discrete):
                return spaces.Discrete(kind.n)
            return spaces.Box(kind.low, kind.high, (kind.size,))

        def observation_space(self, task: Any) -> Any:
            size = jax.eval_shape(
                lambda k: case.task.observe(case.task.reset(k)), jax.random.key(0)
            )
            return spaces.Box(-jnp.inf, jnp.inf, size.shape)

        def reset(self, key: Any, parameters: Any) -> Any:
            task = parameters or case.task
            state = task.reset(key)
            return task.observe(state), (state, jnp.int32(0))

        def step(self, key: Any, state: Any, action: Any, parameters: Any) -> Any:
            before, age = state
            task = parameters or case.task
            step_key, reset_key = jax.random.split(key)
            after, reward, over = task.step(step_key, before, action)
            over = over | (age + 1 >= task.time_limit)
            fresh = self.reset(reset_key, parameters)
            both = (task.observe(after), (after, age + 1))
            chosen = jax.tree.map(lambda new, old: jnp.where(over, new, old), fresh, both)
            return *chosen, jnp.asarray(reward, jnp.float32), over, {}

    return Environment()


def parameters_of(task: Any) -> Any:
    """Return a task whose fields are numbers, which are arguments of a program; else nothing."""
    return () if jax.tree.leaves(task) == [task] else task


class OptunaSide:
    """Optuna, another trainer, and Monte Carlo."""

    def __init__(self, case: Case) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.case, self.optuna = case, optuna
        self.simulate = jax.jit(
            lambda policy, points: jax.vmap(case.problem(policy).objective())(points)
        )

    def trained(self, task: Any, values: dict[str, float], seed: int) -> Policy:
        """Return the policy that a training on a task with hyper-parameters ends with."""
        raise NotImplementedError

    def run(self, configurations: int, seed: int) -> Outcome:
        """Propose, train, and certify each policy."""
        sampler = self.optuna.samplers.TPESampler(seed=seed)
        study = self.optuna.create_study(direction="maximize", sampler=sampler)
        seconds = {"training": 0.0, "certifying": 0.0}
        policies = []
        began = time.process_time()
        for number in range(configurations):
            trial = study.ask()
            values = {}
            for name, domain in (OPTIMISER | self.case.ranges).items():
                log = isinstance(domain, vj.LogUniform)
                low, high = domain.tuning.low, domain.tuning.high
                values[name] = trial.suggest_float(name, low, high, log=log)
            task = dataclasses.replace(
                self.case.task, **{n: jnp.float32(values[n]) for n in self.case.ranges}
            )
            named = {name: values[name] for name in OPTIMISER}
            policy = self.trained(task, named, 1000 * seed + number)
            study.tell(trial, float(evaluate(self.case.nominal, policy, episodes=20).mean()))
            policies.append(policy)
        seconds["training"] = time.process_time() - began
        began = time.process_time()
        safe = [self.certified(policy, seed, configurations) for policy in policies]
        seconds["certifying"] = time.process_time() - began
        return Outcome(safe, seconds, policies, until_first(safe, sum(seconds.values())))

    def certified(self, policy: Policy, seed: int, among: int) -> bool:
        """Return whether independent samples show the policy to be safe."""
        confidence = 1 - (1 - CONFIDENCE) / among
        count = 64
        while upper_bound(count // 400, count, confidence) >= self.case.p:
            count += 64
        points = np.random.default_rng([seed, 7]).random(
            (count, self.case.problem(policy).space.dim), np.float32
        )
        failures = int(np.sum(~(np.asarray(self.simulate(policy, points)) >= 0)))
        return upper_bound(failures, count, confidence) < self.case.p


class RejaxSide(OptunaSide):
    """Optuna and rejax, whose program is compiled once for all configurations."""

    def __init__(self, case: Case) -> None:
        import rejax  # pyright: ignore[reportMissingImports]

        super().__init__(case)
        ours = PPO(**case.settings)
        self.algorithm = rejax.PPO.create(
            env=environment_of(case),
            env_params=parameters_of(case.task),
            num_envs=ours.environments,
            num_steps=ours.horizon,
            num_epochs=ours.epochs,
            num_minibatches=ours.minibatches,
            max_grad_norm=ours.max_gradient,
            normalize_observations=ours.normalise,
            agent_kwargs={"hidden_layer_sizes": HIDDEN, "activation": "tanh"},
            total_timesteps=case.steps,
            eval_freq=case.steps,
            skip_initial_evaluation=True,
        ).replace(eval_callback=lambda *_: ())

        def train(algorithm: Any, key: Any) -> Any:
            state, _ = algorithm.train(key)
            return state.actor_ts.params["params"], state.obs_rms_state

        self.train = jax.jit(train)

    def trained(self, task: Any, values: dict[str, float], seed: int) -> Policy:
        named = {THEIR_NAMES.get(n, n): jnp.float32(value) for n, value in values.items()}
        algorithm = self.algorithm.replace(env_params=parameters_of(task), **named)
        return self.policy(*self.train(algorithm, jax.random.key(seed)))

    def policy(self, weights: Any, statistics: Any) -> Policy:
        """Return rejax' network as a policy of ours."""
        kind = self.case.task.action
        last = weights["action_logits" if isinstance(kind, Discrete) else "action_mean"]
        dense = [*weights["features"].values(), last]
        layers = [(one["kernel"], one["bias"]) for one in dense]
        if isinstance(kind, Continuous):
            middle, half = (kind.high + kind.low) / 2, (kind.high - kind.low) / 2
            layers[-1] = (layers[-1][0] / half, (layers[-1][1] - middle) / half)
        mean = scale = None
        if self.case.settings.get("normalise"):
            mean, scale = statistics.mean, jnp.sqrt(statistics.var + 1e-8)
        return Policy(tuple(layers), mean, scale, None, kind)


class StableBaselinesSide(OptunaSide):
    """Optuna and stable-baselines3, whose environments step in one program of JAX."""

    def __init__(self, case: Case) -> None:
        from benchmarks import stable_baselines

        super().__init__(case)
        self.trainer = stable_baselines
        self.programs = stable_baselines.programs_of(environment_of(case))

    def trained(self, task: Any, values: dict[str, float], seed: int) -> Policy:
        case, parameters = self.case, parameters_of(task)
        return self.trainer.train(
            self.programs, parameters, case.task.action, PPO(**case.settings), case.steps, values,
            HIDDEN, seed,
        )  # fmt: skip


THEIRS = {"rejax": RejaxSide, "stable_baselines": StableBaselinesSide}


def failure_rate(case: Case, policy: Any, count: int) -> float:
    """Count failures among fresh simulations that decided nothing."""
    run = vj.falsify(
        case.problem(policy), "uniform", count, seed=10**6, confirm=False, progress=False
    )
    return len(run.table.violating) / count


def main() -> None:
    """Print what each side finds in an hour of a processor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="+", choices=list(CASES))
    sides = [*SIDES, *THEIRS]
    parser.add_argument("--sides", nargs="+", choices=sides, default=sides)
    parser.add_argument("--configurations", type=int, default=32)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--check", type=int, default=0, help="fresh simulations of a certificate")
    chosen = parser.parse_args()
    for stage in STAGES:
        count_time(stage)
    for name in chosen.cases:
        case = CASES[name]
        print(f"{name}: {chosen.configurations} configurations of {case.steps:,} steps at most")
        for side in chosen.sides:
            if side in THEIRS:
                try:
                    run = THEIRS[side](case).run
                except ImportError as error:
                    print(f"  {side}: left out, {error}")
                    continue
            else:
                search, halving, checkpoints = SIDES[side]
                study = case.study(checkpoints)
                run = functools.partial(our_side, study, search=search, halving=halving)
            before = time.process_time()
            run(4, 999)
            compiling = time.process_time() - before
            print(f"  {side}: {compiling:.0f} s before, compiling")
            every = []
            for seed in chosen.seeds:
                every.append(run(chosen.configurations, seed).with_return(case))
                show(f"seed {seed}", every[-1:])
                if chosen.check:
                    count_again(case, every[-1], chosen.check)
            show("together", every)


def show(name: str, outcomes: list[Outcome]) -> None:
    """Print what some runs of a side found, and in which time."""
    safe = sum(sum(one.safe) for one in outcomes)
    stages = list(dict.fromkeys(stage for one in outcomes for stage in one.seconds))
    seconds = {stage: sum(one.seconds.get(stage, 0.0) for one in outcomes) for stage in stages}
    total = sum(seconds.values())
    parts = ", ".join(f"{took:.1f} s {stage}" for stage, took in seconds.items())
    first = float(np.mean([one.first for one in outcomes]))
    when = [one.passed for one in outcomes if not math.isnan(one.passed)]
    earliest = f" (passed {np.mean(when):.2f} s, {len(when)} runs)" if when else ""
    known = [one.nominal for one in outcomes if not math.isnan(one.nominal)]
    of_them = f"; nominal return of the safe ones {np.mean(known):.1f}" if known else ""
    soon = f"; first after {first:.1f} s{earliest}" if math.isfinite(first) else ""
    print(
        f"    {name:9} {safe} safe in {total:.1f} CPU s ({parts}): {3600 * safe / total:,.0f} an "
        f"hour{soon}{of_them}",
        flush=True,
    )


def count_again(case: Case, found: Outcome, count: int) -> None:
    """Print the failure rates of ten certified policies in fresh simulations."""
    safe = [p for p, good in zip(found.policies, found.safe, strict=True) if good][:10]
    rates = [failure_rate(case, policy, count) for policy in safe]
    wrong = sum(rate >= case.p for rate in rates)
    print(f"    of {len(safe)} certificates counted again {wrong} are wrong: {rates}")


if __name__ == "__main__":
    main()
