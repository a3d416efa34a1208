"""Delays of observations and actions, against loops that are written out by hand."""

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.addons.simulators.delay_options import as_delay
from verifai_jax.addons.simulators.environments._gymnasium import gymnasium
from verifai_jax.core.values.trace import Status
from verifai_jax.systems.channels import Instant
from verifai_jax.systems.delays import Delay

STEPS = 40


def lean(observation):
    return int(observation[2] + 0.3 * observation[3] > 0)


def lean_jax(observation):
    return (observation[2] + 0.3 * observation[3] > 0).astype(int)


def weighted(observation, features):
    return int(features["gain"] * observation[2] + 0.3 * observation[3] > 0)


def weighted_jax(observation, *, features):
    return (features["gain"] * observation[2] + 0.3 * observation[3] > 0).astype(int)


def by_hand(seed, wait, lag, gain=1.0):
    """Cart positions and applied actions of Gymnasium's cart-pole, stepped in a plain loop."""
    env = gym.make("CartPole-v1")
    observation, _ = env.reset(seed=seed)
    seen, decided, applied = [], [], []
    for k in range(STEPS + 1):
        seen.append(np.array(observation))
        late = seen[k - wait] if k >= wait else seen[0]
        decided.append(int(gain * late[2] + 0.3 * late[3] > 0))
        applied.append(decided[k - lag] if k >= lag else 0)
        if k == STEPS:
            break
        observation, _, over, _, _ = env.step(applied[k])
        if over:
            seen.append(np.array(observation))
            applied.append(None)
            break
    return np.array(seen), applied


@pytest.mark.parametrize(("wait", "lag"), [(0, 0), (2, 0), (0, 3), (1, 2)])
def test_gymnasium(wait, lag):
    options = {"steps": STEPS, "action_delay": lag, "observation_delay": {"late": 4}}
    trace = gymnasium("CartPole-v1", lean, **options)({"late": wait}, 3).trim()
    seen, applied = by_hand(3, wait, lag)
    np.testing.assert_allclose(trace["observation"], seen, rtol=1e-6)
    known = [a for a in applied if a is not None]
    np.testing.assert_array_equal(np.asarray(trace["action"])[: len(known)], known)


def test_a_policy_that_sees_features():
    trace = gymnasium("CartPole-v1", weighted, steps=STEPS)({"gain": 2.5}, 3).trim()
    np.testing.assert_allclose(trace["observation"], by_hand(3, 0, 0, 2.5)[0], rtol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("late", [0, 1, 3])
def test_gymnax_and_gymnasium_agree(late):
    pytest.importorskip("gymnax")
    from verifai_jax.addons.simulators.environments._gymnax import gymnax

    start = {"x": 0.02, "x_dot": 0.0, "theta": 0.03, "theta_dot": -0.1}

    def reset(env, features, seed):
        env.reset(seed=seed)
        env.unwrapped.state = np.array(list(start.values()))
        return np.array(list(start.values()), np.float32)

    features = {"late": late, "lag": 1, "gain": 1.5}
    options = {
        "steps": STEPS,
        "observation_delay": {"late": 3},
        "action_delay": {"lag": 2},
    }
    traced = gymnax("CartPole-v1", weighted_jax, initial={n: n for n in start}, **options)
    ours = jax.jit(traced)({**features, **start}, jax.random.key(0)).trim()
    theirs = gymnasium("CartPole-v1", weighted, reset=reset, **options)(features, 0).trim()
    np.testing.assert_allclose(ours["observation"], theirs["observation"], atol=1e-4)
    np.testing.assert_array_equal(ours["action"][:-1], theirs["action"][:-1])
    # Out of range, or between two steps: no silent rounding.
    for bad in (4, -1, 0.5):
        row = jax.jit(traced)({**features, "late": bad, **start}, jax.random.key(0))
        assert int(row.status) == Status.ERROR
        with pytest.raises(ValueError, match=r"feature 'late' of CartPole-v1 must be a whole numb"):
            gymnasium("CartPole-v1", weighted, reset=reset, **options)({**features, "late": bad}, 0)


@pytest.mark.slow
def test_a_delay_is_searched_as_any_feature():
    pytest.importorskip("gymnax")
    from verifai_jax.addons.simulators.environments._gymnax import gymnax

    system = gymnax("CartPole-v1", lean_jax, steps=STEPS, action_delay={"lag": 6})
    problem = vj.Problem("late", {"lag": vj.DiscreteBox(0, 6)}, system, "always abs(theta) < 12deg")
    run = vj.falsify(problem, "uniform", 64, batch=64)
    failing = set(run.table.counterexamples["lag"])
    assert failing
    assert min(failing) > 0
    with pytest.raises(ValueError, match="unknown feature 'lag'"):
        vj.Problem("late", {"x": vj.Box(0, 1)}, system, "always theta < 1").check()


@pytest.mark.thorough
def test_a_run_says_which_delay_is_too_long():
    pytest.importorskip("gymnax")
    from verifai_jax.addons.simulators.environments._gymnax import gymnax

    system = gymnax("CartPole-v1", lean_jax, steps=STEPS, action_delay={"lag": 2})
    problem = vj.Problem("late", {"lag": vj.DiscreteBox(0, 5)}, system, "always abs(theta) < 12deg")
    run = vj.falsify(problem, "uniform", 64, batch=64, confirm=False)
    first = run.table.failed.iloc[0]
    said = "feature 'lag' of CartPole-v1 must be a whole number of steps from 0 to 2; got "
    assert f"first in row {first.name}: {said}{int(first['lag'])}" in str(run)


def test_lines():
    link, now = Delay(2), Instant(0.0, 0.1, {})
    line = link.begin({"a": jnp.zeros(2)}, now, None)
    got = []
    for k in range(5):
        value, line = link.through(line, {"a": jnp.full(2, float(k))}, now)
        got.append(float(value["a"][0]))
    assert got == [0, 0, 0, 1, 2]
    nothing = Delay(0).begin(7, now, None)
    assert nothing == []
    assert Delay(0).through(nothing, 7, now) == (7, nothing)


@pytest.mark.parametrize("option", [-1, True, 1.5, {"a": 1, "b": 2}, {"a": -1}, {}, "late"])
def test_bad_delays(option):
    with (
        unchecked(),
        pytest.raises(ValueError, match="action_delay must be a number of st"),
    ):
        as_delay(option, "action_delay")
    assert as_delay({"late": 3}, "x") == Delay(3, "late")
