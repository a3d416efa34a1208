"""Forks: what stops before a sample goes on to the undisturbed trace, bit for bit."""

import os
import signal
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.values.trace import Trace
from verifai_jax.systems.forks import read_fork, save_fork
from verifai_jax.testing import check_forks

SPACE = vj.FeatureSpace({"x0": vj.Box(-1, 1), "g": vj.Box(5, 20)})


def pendulum(**options):
    """A pendulum whose controller has a memory, whose start draws, and which ends early."""

    def dynamics(time, state, control, features):
        x, v = state
        return v, features["g"] * jnp.sin(x) + control

    def controller(time, state, memory, features):
        x, v = state
        return -30 * x - 5 * v - memory, memory + 0.2 * x

    def initial(features, key):
        return features["x0"] + 0.1 * jax.random.normal(key), jnp.zeros(())

    settings = {
        "initial": initial, "controller": controller, "controller_memory": 0.0, "dt": 0.01,
        "duration": 1.0, "terminate": lambda state, features: state[0] > 0.9,
        "signals": lambda time, state, control, features: {"x": state[0], "u": control},
    }  # fmt: skip
    return vj.ode(dynamics, **{**settings, **options})


def test_a_fork_has_the_undisturbed_trace_and_a_new_one_with_other_features():
    system, key = pendulum(), jax.random.key(1)
    features = {"x0": jnp.float32(0.3), "g": jnp.float32(9.0)}
    whole, forks = jax.jit(system)(features, key), jax.jit(system.forks)(features, key)
    go_on = jax.jit(system.go_on)
    for index in (0, 37, 100):
        same = go_on(forks.at(index))
        assert all(np.array_equal(whole.signals[n], same.signals[n]) for n in ("x", "u")), index
    heavier = {**features, "g": jnp.float32(30.0)}
    other = go_on(forks.at(37)._replace(features=heavier))
    assert np.array_equal(whole.signals["x"][:38], other.signals["x"][:38])
    assert not np.array_equal(whole.signals["x"][38:60], other.signals["x"][38:60])


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"control_period": 0.05},
        {"dt": 0.001, "duration": 0.8, "method": "euler", "terminate": None},
    ],
    ids=["memory and early end", "held control", "long, in segments"],
)
def test_odes(options):
    check_forks(pendulum(**options), SPACE)


@pytest.mark.slow
@pytest.mark.addons
def test_an_ode_with_faults():
    plain = vj.Problem("p", SPACE, pendulum(), "always[0, 1] x <= 0.8")
    faults = vj.faults
    noisy = plain.with_faults(
        faults.Noise("action", std=vj.Box(0.1, 0.3), onset=0.2),
        faults.Delay("action", seconds=0.03),
    )
    check_forks(noisy.system, noisy.space, samples=1)


def test_a_system_that_cannot_fork_is_named():
    system = vj.blackbox(lambda f: Trace({"x": np.full(3, f["x0"])}, dt=1.0))
    assert not system.can_fork
    with pytest.raises(NotImplementedError, match=r"has no rollout.*, so it cannot fork"):
        system.forks({"x0": 0.0})


class Leaky:
    """A system whose state forgets something: its forks do not go on as undisturbed."""

    def __init__(self, system):
        self.system = system

    def __call__(self, features, key=None):
        return self.system(features, key)

    def rollout(self, features, key=None):
        rollout = self.system.rollout(features, key)

        def sample(state, k):
            state, signals = rollout.sample(state, k)
            return state._replace(memory=0.0 * state.memory), signals

        return rollout._replace(sample=sample)


@pytest.mark.thorough
def test_a_state_that_forgets_is_found():
    with pytest.raises(AssertionError, match="must go on"):
        check_forks(Leaky(pendulum()), SPACE, samples=1)


def test_a_file_of_another_system_is_refused(tmp_path):
    features, key = {"x0": jnp.float32(0.3), "g": jnp.float32(9.0)}, jax.random.key(1)
    save_fork(pendulum(duration=0.1).forks(features, key).at(3), tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"a\.npz holds no fork of this system"):
        read_fork(tmp_path / "a.npz", pendulum().forks(features, key).at(0))


KILLED = """
import os, signal, sys
sys.path[:0] = [{here!r}, {root!r}]
import jax, jax.numpy as jnp
from test_forks import pendulum
from verifai_jax.systems.forks import save_fork
features, key = {{"x0": jnp.float32(0.3), "g": jnp.float32(9.0)}}, jax.random.key(1)
save_fork(jax.jit(pendulum().forks)(features, key).at(37), {file!r})
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_a_fork_of_a_killed_process_goes_on_in_another(tmp_path):
    here, file = os.path.dirname(__file__), tmp_path / "fork.npz"
    code = KILLED.format(here=here, root=os.path.dirname(os.path.dirname(here)), file=str(file))
    done = subprocess.run([sys.executable, "-c", code], check=False)
    assert done.returncode == -signal.SIGKILL
    system = pendulum()
    features, key = {"x0": jnp.float32(0.3), "g": jnp.float32(9.0)}, jax.random.key(1)
    whole = jax.jit(system)(features, key)
    same = jax.jit(system.go_on)(read_fork(file, system.forks(features, key).at(0)))
    assert all(np.array_equal(whole.signals[n], same.signals[n]) for n in whole.signals)
