"""A toy that is trained at once: an algorithm whose policies drift, a task, and its closed loop.

Compiles in a fraction of a second, where PPO takes several; what a sweep does with trainings does
not depend on what they learn.
"""

import itertools
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import verifai_jax as vj
from verifai_jax.addons.estimation.certification.result import Certificate, Certificates
from verifai_jax.addons.rl import Continuous, Discrete, Policy, Progress
from verifai_jax.addons.rl.algorithm import check_values, static_field
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.trainer import Trainer
from verifai_jax.statistics.binomial import clopper_pearson

STEPS_PER_UPDATE = 32


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Point:
    """Stay near 0 on a line; the reward falls with the distance."""

    reward_scale: float = 1.0
    time_limit: int = field(default=16, metadata={"static": True})

    @property
    def action(self):
        return Continuous(-1.0, 1.0)

    def reset(self, key):
        return jnp.float32(0.5)

    def step(self, key, state, action):
        after = state + 0.2 * action[0]
        return after, self.reward_scale * (1.0 - jnp.abs(after)), jnp.abs(after) > 2.0

    def observe(self, state):
        return jnp.stack([state, jnp.ones(())])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Drift:
    """The output's bias moves by `rate` an update, and by noise; it is NaN once beyond `limit`."""

    actions: ClassVar[tuple[type, ...]] = (Continuous,)

    rate: Any = 0.1
    noise: Any = 0.01
    limit: Any = 1e3
    hidden: tuple[int, ...] = static_field((4,))
    environments: int = static_field(4)
    parts: int = static_field(1)

    @property
    def steps_per_update(self):
        return STEPS_PER_UPDATE

    def check(self):
        check_values(self, ["rate", "limit"], "positive")
        below = f"less than limit = {self.limit}"
        check_values(self, ["rate"], below, lambda value: float(value) < float(self.limit))
        wanted = f"a divisor of environments = {self.environments}"
        check_values(self, ["parts"], wanted, lambda value: self.environments % value == 0)

    def init(self, task, key, updates):
        sizes = (2, *self.hidden, 1)
        layers = tuple(
            (0.3 * jax.random.normal(jax.random.fold_in(key, i), (a, b)), jnp.zeros(b))
            for i, (a, b) in enumerate(itertools.pairwise(sizes))
        )
        return layers, key, jnp.int32(0)

    def step(self, task, state):
        layers, key, done = state
        key, now = jax.random.split(key)
        moved = self.rate + self.noise * jax.random.normal(now)
        (weight, bias), rest = layers[-1], layers[:-1]
        bias = jnp.where(jnp.abs(bias + moved) > self.limit, jnp.nan, bias + moved)
        earned = task.reward_scale * (10.0 - bias[0])
        progress = Progress(jnp.where(done % 2 == 1, earned, jnp.nan), done % 2)
        return ((*rest, (weight, bias)), key, done + 1), progress

    def policy(self, task, state):
        return Policy(state[0], None, None, None, task.action)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Picks(Drift):
    """For discrete actions only."""

    actions: ClassVar[tuple[type, ...]] = (Discrete,)


def closed_loop(policy):
    """The point under a policy, which must not go too far."""

    def system(features, key):
        def step(x, _):
            x = x + 0.2 * policy.act(jnp.stack([x, jnp.ones(())]))[0]
            return x, x

        return vj.Trace({"x": jax.lax.scan(step, features["x0"], None, length=8)[1]}, dt=0.1)

    return vj.Problem("stay", {"x0": vj.Box(-1.0, 1.0)}, system, "always x <= 1.5")


def drifting(space=None, **options):
    """A study of the toy."""
    options = {"steps": 128, "algorithms": Drift(), "task": Point(), **options}
    made = Trainer(options.pop("task"), options.pop("algorithms"), options.pop("steps"))
    space = {"rate": vj.LogUniform(0.01, 1.0)} if space is None else space
    return Study("drifting", space, made, closed_loop, **{"checkpoints": (32, 64), **options})


def quick_certificates(problem_of, policies, *, p, certification, seed, remember, **_):
    """In place of the certification: the closed loop on a grid, in NumPy, policy by policy."""
    found, samples, confidence = [], certification.samples, certification.confidence
    for policy in policies:
        layers = [(np.asarray(w), np.asarray(b)) for w, b in policy.layers]

        def compute(layers=layers):
            x = x0 = np.random.default_rng(seed).uniform(-1, 1, samples)
            worst = np.full(samples, np.inf)
            for _ in range(8):
                seen = np.stack([x, np.ones_like(x)], axis=1)
                for weight, bias in layers[:-1]:
                    seen = np.tanh(seen @ weight + bias)
                action = np.clip((seen @ layers[-1][0] + layers[-1][1])[:, 0], -1, 1)
                x = x + 0.2 * action
                worst = np.minimum(worst, 1.5 - x)
            return {"worst": worst, "x0": x0}

        name = f"{seed}/{samples}/{[w.tobytes().hex() for pair in layers for w in pair]}"
        work = remember(name, compute)
        place, failures = int(np.argmin(work["worst"])), int(np.sum(work["worst"] < 0))
        rate = clopper_pearson(failures, samples, confidence)
        verdict = "safe@0.01" if rate.high < p else "unsafe" if rate.low > p else "undecided"
        worst = {"x0": float(work["x0"][place])}
        found.append(
            Certificate(
                len(found), failures, samples, 0, rate, verdict, 0, 0,
                float(work["worst"][place]), worst, {},
            )
        )  # fmt: skip
    return Certificates(
        tuple(found), "drifting", p, confidence, None, None, 0.0, seed, samples,
        samples * len(found), "decided", 0.0,
    )  # fmt: skip
