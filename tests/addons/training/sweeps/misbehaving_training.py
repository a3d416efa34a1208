"""A training function that does what none should."""

import os
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np


class Gain:
    """A policy with weights and several equal actions."""

    def __init__(self, weights, actions=1):
        self.weights, self.actions = weights, actions

    def __call__(self, observation):
        return jnp.repeat((observation @ self.weights)[None], self.actions)


def train_badly(key, hyperparameters, steps):
    """Train at once, in a process that `file` then knows, or do what `kind` says."""
    with Path(hyperparameters["file"]).open("a") as file:
        file.write(f"{os.getpid()}\n")
    weights = np.float32([-1.0, 0.0])
    match hyperparameters["kind"]:
        case "hang":
            time.sleep(1000)
        case "crash":
            os.kill(os.getpid(), 11)
        case "exit":
            os._exit(0)
        case "leave":
            sys.exit("bye")
        case "fork":
            os.fork()
        case "child":
            subprocess.Popen(["sleep", "1000"])
        case "print":
            os.write(1, b"raw")
            subprocess.run(["echo", "from a process"], check=True)
        case "none":
            return None
        case "two":
            return Gain(weights, 2)
        case "three":
            return Gain(np.float32([-1.0, 0.0, 1.0]))
        case "nan":
            return Gain(weights * np.nan)
    return Gain(weights)
