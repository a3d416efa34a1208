"""Trainers in NumPy: random search for a gain, which a folder remembers or not."""

import os
import signal
from pathlib import Path

import jax
import numpy as np
from drifting import closed_loop

import verifai_jax as vj


class Gain:
    """A policy with two weights, as NumPy has them."""

    def __init__(self, weights):
        self.weights = weights

    def __call__(self, observation):
        return (observation @ self.weights)[None]


def trained(rng, weights, hyperparameters, steps):
    """Move towards -1, 0 by noisy steps; the curve is the distance from there."""
    returns = []
    for _ in range(steps):
        noise = hyperparameters["rate"] * rng.normal(size=2)
        weights = weights + hyperparameters["rate"] * (np.array([-1.0, 0.0]) - weights) + noise
        returns.append(-float(np.abs(weights[0] + 1.0)))
    return weights, returns


def seed_of(key):
    return int(jax.random.key_data(key)[-1])


def train(key, hyperparameters, steps=8, resume=None):
    """Go on from what is in the folder."""
    file = resume / "state.npz"
    begun, weights, returns = 0, np.zeros(2), np.zeros(0)
    if file.exists():
        with np.load(file) as state:
            begun, weights, returns = int(state["steps"]), state["weights"], state["returns"]
    rng = np.random.default_rng([seed_of(key), begun])
    weights, more = trained(rng, weights, hyperparameters, steps - begun)
    returns = np.concatenate([returns, more])
    np.savez(file, steps=steps, weights=weights, returns=returns)
    kill = os.environ.get("KILL_ONCE")
    if kill and begun and not Path(kill).exists():
        Path(kill).touch()
        os.kill(os.getppid(), signal.SIGKILL)
    curve = {"steps": np.arange(1, steps + 1), "mean_return": returns}
    return Gain(np.float32(weights)), curve


def train_anew(key, hyperparameters, steps=8):
    """Train from the beginning; one configuration cannot."""
    if hyperparameters["rate"] > 0.4:
        raise ValueError("the rate is too great")
    weights, _ = trained(np.random.default_rng(seed_of(key)), np.zeros(2), hyperparameters, steps)
    return Gain(np.float32(weights))


def train_reporting(key, hyperparameters, steps=8, checkpoint=None):
    """Train once for all checkpoints, and report after each step."""
    rng, weights = np.random.default_rng(seed_of(key)), np.zeros(2)
    for step in range(1, steps + 1):
        weights, returns = trained(rng, weights, hyperparameters, 1)
        if hyperparameters["rate"] < 0.4 or step < 3:
            checkpoint(step, Gain(np.float32(weights)), returns[0])
    return Gain(np.float32(weights))


def train_towards(key, hyperparameters, steps=8, checkpoint=None):
    """Report policies that depend on how long the training will be."""
    for step in range(1, steps + 1):
        checkpoint(step, Gain(np.float32([-step / steps, 0.0])), float(step))
    return Gain(np.float32([-1.0, 0.0]))


def study(function, **options):
    trainer = vj.Trainer(
        function, steps=8, example=lambda observation: observation[:1], observation=np.zeros(2)
    )
    space = {"rate": vj.Categorical(0.1, 0.3, 0.5)}
    return vj.Study("by_hand", space, trainer, closed_loop, checkpoints=(4,), **options)


def sweep(function, folder=None, **options):
    return vj.sweep(
        study(function), "halton", 2, folder=folder, progress=False,
        certification=vj.Certification(samples=64, attack_simulations=0), **options,
    )  # fmt: skip


if __name__ == "__main__":
    sweep(train, "killed")
