"""Simulators that a worker process can import."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from verifai_jax.core.values.trace import Trace


def decay(features):
    return Trace({"x": features["a"] * np.exp(-np.arange(5) * 0.1)}, dt=0.1)


def seeded(features, seed):
    if seed == 0:
        return troublesome(features)
    return Trace({"x": np.array([features["a"], float(seed)])}, dt=0.1)


def troublesome(features):
    """Does what the feature `a` says: 0 is well, what follows is not."""
    match features["a"]:
        case 1:
            raise KeyError("no such road")
        case 3:
            os.kill(os.getpid(), signal.SIGSEGV)
        case 4:
            time.sleep(60)
        case 5:
            sys.exit("enough")
        case 6:
            return "no trace"
        case 7:
            return Trace({"y": np.ones(5)}, dt=0.1)
        case 8:
            print("noise " * 10)
        case 9:
            return Trace({"x": np.array([os.getpid(), os.getsid(0)])}, dt=1.0)
        case 10:
            die_once(features["file"])
        case 12:
            child = subprocess.Popen(["sleep", "300"])
            return Trace({"x": np.array([child.pid, 0.0])}, dt=1.0)
        case 11:
            wind = features["wind"]
            assert (wind.hold, wind.duration) == ("linear", 2.0)
            return Trace({"x": wind.knots}, dt=1.0)
    return decay(features)


calls = 0


def counting(features):
    """Fails at every third simulation of its process, and says in which process."""
    global calls
    calls += 1
    x = -1.0 if calls % 3 == 0 else 1.0
    return Trace({"x": np.array([x, x]), "pid": np.full(2, os.getpid())}, dt=1.0)


def die_once(file):
    if not Path(file).exists():
        Path(file).touch()
        os._exit(1)


def light_touch(observation):
    return int(observation[2] > 0)


def balancing(observation):
    x, _, theta, theta_dot = observation
    return int(theta + 0.5 * theta_dot + 0.02 * x > 0)


def cartpole_start(env, features, seed):
    env.reset(seed=seed)
    state = np.array([features.get("x0", 0.0), 0.0, features["theta0"], 0.0])
    env.unwrapped.state = state
    return state.astype(np.float32)


def pendulum(observation):
    return np.array([-observation[2]])
