"""A sweep with known numbers: nothing in it was trained."""

import jax.numpy as jnp
import numpy as np

import verifai_jax as vj
from verifai_jax.addons.rl import Discrete, Policy
from verifai_jax.addons.training.sweeps.record import Curve, SweepRecord
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.trainer import Trainer

SPACE = vj.FeatureSpace(
    {
        "learning_rate": vj.LogUniform(1e-4, 1e-2),
        "discount": vj.Box(0.9, 0.999),
        "width": vj.Categorical(16, 64),
        "algorithm": vj.Categorical("ppo", "sac"),
    }
)
P = 0.01


class ToyTrainer(Trainer):
    """A trainer whose algorithms have all hyper-parameters."""

    by_name = {"ppo": None, "sac": None}  # noqa: RUF012

    def __init__(self):
        pass

    def used_hyperparameters(self, values):
        return tuple(values)


class ToyStudy(Study):
    """As much of a study as a result needs."""

    def __init__(self):
        pass

    trainer = ToyTrainer()

    name = "toy"
    space = SPACE
    p = P
    checkpoints = (1000, 2000)
    curve = "eventually return >= 90"

    @staticmethod
    def problem(policy):
        """Fails where the policy prefers action 1: for x above minus its second bias."""

        def system(features, key):
            outputs = policy(jnp.stack([features["x"]]))
            return vj.Trace({"y": jnp.repeat(outputs[0] - outputs[1], 3)}, dt=1.0)

        return vj.Problem("toy", {"x": vj.Box(0.0, 1.0)}, system, "always y >= 0")


def policy_failing(rate):
    """A policy that fails for x in [1 - rate, 1]."""
    weight, bias = np.array([[0.0, 1.0]], np.float32), np.array([0.0, rate - 1.0], np.float32)
    return Policy(((weight, bias),), None, None, None, Discrete(2))


def record_of(rows, curves=None, **changes):
    """A record from rows as dictionaries; what is left out has a usual value."""
    usual = {
        "configuration": 0,
        "seed": 0,
        "steps": 2000,
        "learning_rate": 1e-3,
        "discount": 0.99,
        "width": 16,
        "algorithm": "ppo",
        "status": "trained",
        "training_return": 90.0,
        "nominal_return": 100.0,
        "failures": 0,
        "simulations": 512,
        "failure_rate": 0.0,
        "failure_low": 0.0,
        "failure_high": 0.0072,
        "worst_robustness": 0.1,
        "verdict": "safe@0.01",
        "curve_robustness": np.nan,
        "training_seconds": 1.5,
    }
    full = [{**usual, **row} for row in rows]
    columns = {name: np.array([row[name] for row in full]) for name in usual}
    fine = [row["status"] != "nonfinite" and "error" not in row["status"] for row in full]
    if curves is None:
        curves = {(row["configuration"], row["seed"]): curve_to(row["nominal_return"])
                  for row in full}  # fmt: skip
    options = {
        "study": "toy",
        "seed": 3,
        "hyperparameters": tuple(SPACE.domains),
        "policies": tuple(
            policy_failing(row["failure_rate"]) if good else None
            for row, good in zip(full, fine, strict=True)
        ),
        "worst": tuple(
            {"x": 1.0 - row["failure_rate"] / 2} if good else None
            for row, good in zip(full, fine, strict=True)
        ),
        "certificates": None,
        "certified": tuple(np.flatnonzero(fine).tolist()),
        "options": {"p": P, "confidence": 0.95, "search": "halton"},
        "version": "0.1.0",
        "seconds": {"training": 12.0, "certification": 3.5},
    }
    return SweepRecord(columns=columns, curves=curves, **{**options, **changes})


def curve_to(returned, updates=20):
    """A learning curve that rises to a return; no episode ends in the first update."""
    steps = 100 * np.arange(1, updates + 1)
    values = returned * (1 - np.exp(-steps / 500.0))
    return Curve(steps, np.where(steps == 100, np.nan, values))


def planted_rows(configurations=40, seed=0, seeds=1, checkpoints=(2000,)):
    """Return depends on the discount, failing on the learning rate and, less, on the width."""
    rng = np.random.default_rng(seed)
    rows = []
    for number in range(configurations):
        u = rng.random(4)
        for training in range(seeds):
            for steps in checkpoints:
                late = steps == max(checkpoints)
                rate = max(0.0, 1.2 * u[0] - 0.45) ** 2 * (0.6 + 0.4 * (u[2] > 0.5))
                rate = min(1.0, rate + 0.3 * (not late))
                returned = min(500.0, 700 * u[1] + 60) * (1.0 if late else 0.6)
                failures = int(rng.binomial(512, rate))
                interval = vj.clopper_pearson(failures, 512, 0.9999)
                verdict = "undecided" if interval.low <= P else "unsafe"
                verdict = "safe@0.01" if rate == 0 and u[3] < 0.9 else verdict
                rows.append(
                    {
                        "configuration": number,
                        "seed": training,
                        "steps": steps,
                        "learning_rate": 1e-4 * 100 ** u[0],
                        "discount": 0.9 + 0.099 * u[1],
                        "width": [16, 64][int(2 * u[2])],
                        "algorithm": ["ppo", "sac"][int(2 * u[3])],
                        "training_return": 0.9 * returned,
                        "nominal_return": returned,
                        "failures": failures,
                        "failure_rate": failures / 512,
                        "failure_low": interval.low,
                        "failure_high": 0.0095 if verdict.startswith("safe") else interval.high,
                        "worst_robustness": 0.2 - rate,
                        "verdict": verdict,
                    }
                )
    return rows
