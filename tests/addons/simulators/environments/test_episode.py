import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.simulators.environments.episode import (
    Episode,
    Moment,
    episode_keys,
    features_at,
    has_waveforms,
    policy_function,
    rollout,
    sampling_period,
    step_count,
    used_inputs,
    vector_action,
)
from verifai_jax.core.values.trace import Status
from verifai_jax.core.values.waveform import Waveform

KEY = jax.random.key(1)


def without_features(policy):
    decide = policy_function(policy)
    return lambda time, observation, memory, key: decide(observation, memory, key, {})


def tank(level, **changes):
    """A tank that empties (Torricelli) and is over when it is empty; below that its rate is NaN."""

    def step(time, state, action, key):
        state = state - 0.1 * jnp.sqrt(state)
        return Moment(state, state[None], jnp.ones(()), state <= 0)

    parts = {
        "name": "tank",
        "start": lambda key: Moment(level, level[None], 0, False),
        "step": step,
        "decide": without_features(lambda observation: 0.0),
        "memory": None,
        "signals": lambda time, moment, action: {"level": moment.state, "time": time},
        "steps": 30,
        "dt": 0.1,
    }
    return Episode(**{**parts, **changes})


def test_what_is_over_is_frozen_and_has_a_finite_gradient():
    def total(level):
        trace = rollout(tank(level), KEY).trace()
        return jnp.sum(trace["level"]), trace

    (_, trace), slope = jax.jit(jax.value_and_grad(total, has_aux=True))(jnp.float32(1.0))
    levels = [1.0]
    while levels[-1] > 0:
        levels.append(levels[-1] - 0.1 * levels[-1] ** 0.5)
    end = len(levels)
    assert int(trace.valid) == end
    assert int(trace.status) == Status.OK
    np.testing.assert_allclose(trace.trim()["level"], levels, atol=1e-5)
    np.testing.assert_allclose(trace["level"][end:], levels[-1], atol=1e-5)
    np.testing.assert_allclose(trace["time"], np.minimum(np.arange(31), end - 1) * 0.1, rtol=1e-5)
    assert np.isfinite(float(slope))


def test_a_fold_takes_in_the_samples_of_the_trace():
    def add(carry, sample):
        return carry[0] + sample["level"], jnp.maximum(carry[1], sample["time"])

    for level, steps in ((1.0, 30), (9.0, 30)):
        episode = tank(jnp.float32(level), steps=steps)
        trace = rollout(episode, KEY).trace()
        (total, latest), status = rollout(episode, KEY).fold((0.0, 0.0), add)
        assert float(total) == pytest.approx(float(trace["level"].sum()), rel=1e-5)
        assert float(latest) == float(trace["time"][-1])
        assert int(status) == int(trace.status) == Status.OK


def test_a_state_that_is_not_a_number_is_a_status():
    def step(time, state, action, key):
        return Moment(state * state, state, jnp.zeros(()), jnp.array(False))

    def status(x):
        start = lambda key: Moment(x, x, 0.0, False)  # noqa: E731
        return rollout(tank(x, step=step, start=start), KEY).trace().status

    codes = jax.jit(jax.vmap(status))(jnp.array([0.9, 3.0, jnp.nan]))
    np.testing.assert_array_equal(codes, [Status.OK, Status.NONFINITE, Status.NONFINITE])


def test_types_of_the_start_give_way_to_those_of_a_step():
    def step(time, state, action, key):
        after = {"n": state["n"] + 0.5, "one": state["one"]}
        return Moment(after, after["n"][None], 1, jnp.float32(0))

    start = Moment({"n": 0, "one": True}, jnp.zeros(1, int), 0, False)
    signals = {"signals": lambda time, moment, action: {"n": moment.state["n"]}}
    trace = rollout(tank(jnp.ones(()), start=lambda key: start, step=step, **signals), KEY).trace()
    np.testing.assert_allclose(trace["n"], np.arange(31) / 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"step": lambda t, s, a, k: Moment((s, s), s[None], 0.0, False)},
            r"tank: a step must return a state in the form that the start has: .* got ",
        ),
        (
            {"step": lambda t, s, a, k: Moment(s, jnp.zeros(2), 0.0, False)},
            r"tank: observation has shape \[1\] at the start and \[2\] after a step",
        ),
        (
            {
                "start": lambda k: Moment(jnp.ones(()), jnp.ones(1), jnp.zeros(2), False),
                "step": lambda t, s, a, k: Moment(s, jnp.ones(1), jnp.zeros(2), False),
            },
            r"tank: the reward must be one number; got float32\[2\]",
        ),
        (
            {"signals": lambda t, m, a: {"x": jnp.zeros((2, 2))}},
            r"signal 'x' must be a scalar or a vector at each sample",
        ),
    ],
)
def test_parts_that_do_not_fit(changes, message):
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(lambda level: rollout(tank(level, **changes), KEY).trace(), 1.0)


def test_random_policies_get_a_key_of_each_step():
    seen = []

    def signals(time, moment, action):
        return {"action": action}

    decide = without_features(lambda observation, key: jax.random.normal(key))
    trace = rollout(tank(jnp.float32(9.0), decide=decide, signals=signals), KEY).trace()
    for k in range(31):
        seen.append(jax.random.normal(jax.random.fold_in(episode_keys(KEY).decide, k)))
    np.testing.assert_allclose(trace["action"], seen, rtol=1e-6)


class Actor:
    """What `rl.Policy` is to the adapters: something else when called."""

    def __call__(self, observation):
        return "logits"

    def act(self, observation):
        return observation[0]


def test_forms_of_a_policy():
    seen, key = jnp.array([2.0]), KEY
    assert policy_function(Actor())(seen, None, key, {}) == (2.0, None)
    assert policy_function(jax.jit(lambda o: o[0]))(seen, None, key, {})[0] == 2.0
    assert policy_function(functools.partial(lambda a, o: a, 3.0))(seen, None, key, {})[0] == 3.0
    assert policy_function(lambda *a: len(a))(seen, None, key, {})[0] == 1
    assert policy_function(lambda o, scale=2: scale * o[0])(seen, None, key, {})[0] == 4.0
    assert policy_function(lambda o, k: k is key)(seen, None, key, {})[0] is True
    assert policy_function(lambda o, m: (o[0], m + 1), 0)(seen, 5, key, {}) == (2.0, 6)
    assert policy_function(lambda o, m, k: (k is key, m), 0)(seen, 5, key, {}) == (True, 5)
    gain = {"gain": 4.0}
    assert policy_function(lambda o, features: features["gain"])(seen, None, key, gain)[0] == 4.0
    assert policy_function(lambda o, k, *, features: k is key)(seen, None, key, gain)[0] is True
    with pytest.raises(ValueError, match=r"\(observation, memory\) or .*; got one of 1 arguments"):
        policy_function(lambda o: o, 0)


def test_vector_actions():
    assert vector_action(jnp.float32(2), 1, "it").shape == (1,)
    assert vector_action(1, 1, "it").dtype == jnp.float32
    np.testing.assert_array_equal(vector_action(jnp.arange(2.0), 2, "it"), [0, 1])
    with pytest.raises(ValueError, match=r"the 2 real numbers that it takes .* got float32\[3\]"):
        vector_action(jnp.zeros(3), 2, "it")
    with pytest.raises(ValueError, match=r"the 1 real number that it takes .* got int32\[\]"):
        vector_action(jnp.int32(1), 1, "it")


def test_features_of_an_instant():
    features = {"wind": Waveform(jnp.array([0.0, 2.0]), duration=4.0), "mass": 3.0}
    assert has_waveforms(features)
    assert not has_waveforms({"mass": 3.0})
    assert float(features_at(features, 1.0)["wind"]) == 0.5
    assert features_at(features, 1.0)["mass"] == 3.0


def test_steps_and_periods():
    assert step_count(None, 1.0, 0.1) == 10
    assert step_count(None, None, 0.1, 7) == 7
    assert sampling_period(np.float32(0.05)) == 0.05
    assert sampling_period(jnp.float32(0.008)) == 0.008
    with pytest.raises(ValueError, match="dt must be a positive number of seconds; got 'x'"):
        sampling_period("x")
    with pytest.raises(ValueError, match="steps must be an integer of at least 1; got True"):
        step_count(True, None, 0.1)


def test_inputs_that_nothing_depends_on():
    def function(tree, b):
        return jax.jit(lambda used, unused: used * 2)(tree["a"], tree["c"]) + 0 * jnp.sum(b)

    used = used_inputs(function, {"a": 1.0, "c": 2.0}, jnp.ones(2))
    assert used == [True, False, True]
