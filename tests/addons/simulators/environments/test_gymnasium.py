from functools import partial

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from host_systems import balancing, cartpole_start, light_touch, pendulum

import verifai_jax as vj
from envs import cartpole
from verifai_jax.addons.simulators.environments._gymnasium import gymnasium
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.values.trace import Status
from verifai_jax.core.values.waveform import Waveform

NAMES = ("x", "x_dot", "theta", "theta_dot")
CARTPOLE = partial(
    gymnasium,
    "CartPole-v1",
    balancing,
    signals=NAMES,
    features=("masspole", "length"),
    reset=cartpole_start,
)
POLE = {"x0": 0.3, "theta0": 0.05, "masspole": 0.3, "length": 0.8}


def test_it_is_stepping_by_hand():
    env = gym.make("CartPole-v1")
    observation, _ = env.reset(seed=11)
    rows, rewards, actions = [observation], [0.0], [light_touch(observation)]
    over = False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(actions[-1])
        rows.append(observation)
        rewards.append(reward)
        actions.append(light_touch(observation))
        over = terminated or truncated
    trace = gymnasium("CartPole-v1", light_touch, steps=150)({}, 11)
    assert trace.length == 151
    assert trace.valid == len(rows) < 151
    assert trace.dt == 0.02
    np.testing.assert_array_equal(trace["observation"][: len(rows)], rows)
    np.testing.assert_array_equal(trace["reward"][: len(rows)], rewards)
    np.testing.assert_array_equal(trace["action"][: len(rows)], actions)
    # It stays as it ended: there is no reset within a trace.
    np.testing.assert_array_equal(trace["observation"][len(rows) :], [rows[-1]] * (151 - len(rows)))
    assert trace.status == Status.OK


def test_it_agrees_with_the_cartpole_in_jax():
    def push(time, state, features):
        right = state.theta + 0.5 * state.theta_dot + 0.02 * state.x > 0
        return jnp.where(right, 10.0, -10.0)

    with in_precision("float64"):
        ours = jax.jit(cartpole.cartpole(push, duration=2.0, terminate=True))(POLE)
        ours = jax.tree.map(np.asarray, ours)
    theirs = CARTPOLE(steps=100)(POLE, 0)
    assert int(ours.valid) == theirs.valid
    for name in NAMES:
        np.testing.assert_allclose(theirs[name], ours[name], atol=1e-5)


def test_a_time_limit_ends_the_trace():
    make = partial(gym.make, "CartPole-v1", max_episode_steps=5)
    system = gymnasium(make, balancing, steps=20, dt=0.5)
    assert system.exact_step
    trace = system({}, 0)
    assert (trace.length, trace.valid, trace.dt) == (21, 6, 0.5)


def test_configure_signals_and_continuous_actions():
    env = gym.make("Pendulum-v1")
    env.reset(seed=3)
    env.unwrapped.g = 5.0
    angles = [env.unwrapped.state[0]]
    for _ in range(10):
        observation = env.unwrapped._get_obs()
        env.step(pendulum(observation))
        angles.append(env.unwrapped.state[0])

    def configure(env, features):
        env.unwrapped.g = features["gravity"]

    system = gymnasium(
        "Pendulum-v1",
        pendulum,
        steps=10,
        configure=configure,
        signals=lambda env, observation, action, reward, features: {
            "theta": env.unwrapped.state[0],
            "torque": action,
        },
    )
    trace = system({"gravity": 5.0}, 3)
    np.testing.assert_allclose(trace["theta"], angles, atol=1e-6)
    assert trace["torque"].shape == (11, 1)
    assert trace.dt == 0.05


class Rising(gym.Env):
    """Observes a dictionary, in one and the same array each time."""

    observation_space = gym.spaces.Dict(
        {
            "height": gym.spaces.Box(-100, 100, (1,), np.float64),
            "wind": gym.spaces.Box(-100, 100, (2,), np.float64),
        }
    )
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    speed = 1.0

    def __init__(self):
        self.seen = {"height": np.zeros(1), "wind": np.zeros(2)}

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.seen["height"][:] = 0.0
        self.seen["wind"][:] = seed
        return self.seen, {}

    def step(self, action):
        self.seen["height"] += self.speed * float(action[0])
        return self.seen, self.seen["height"][0], False, False, {}


class Resetting:
    """A policy that counts its steps."""

    count = 0

    def reset(self):
        self.count = 0

    def __call__(self, observation):
        self.count += 1
        return 1.0 if self.count < 3 else 0.5


def test_dictionaries_and_a_policy_that_remembers():
    system = gymnasium(
        Rising,
        Resetting(),
        steps=4,
        features={"fast": "speed"},
        signals={"height": "height", "wind": "wind"},
    )
    for _ in range(2):
        trace = system({"fast": 2.0}, 7)
        np.testing.assert_array_equal(trace["height"], [0.0, 2.0, 4.0, 5.0, 6.0])
        np.testing.assert_array_equal(trace["reward"], [0.0, 2.0, 4.0, 5.0, 6.0])
        np.testing.assert_array_equal(trace["action"], [1.0, 1.0, 0.5, 0.5, 0.5])
        np.testing.assert_array_equal(trace["wind"], np.full((5, 2), 7.0))
        assert (trace.dt, trace.valid) == (1.0, 5)
    assert system({"fast": np.nan}, 7).status == Status.NONFINITE
    with pytest.raises(ValueError, match="unknown entry of Rising's observation 'hight'"):
        gymnasium(Rising, Resetting(), steps=4, signals={"h": "hight"})({}, 0)


def test_a_signal_feature_is_set_before_each_step():
    seen = []

    def look(env, observation, action, reward, features):
        seen.append(env.unwrapped.g)
        return {"g": env.unwrapped.g}

    system = gymnasium("Pendulum-v1", pendulum, steps=4, features={"gravity": "g"}, signals=look)
    system({"gravity": Waveform(np.array([1.0, 3.0]), "linear")}, 0)
    # A sample is taken before the step that its time begins.
    np.testing.assert_allclose(seen, [1.0, 1.0, 1.5, 2.0, 2.5], rtol=1e-6)


def test_a_policy_network_is_an_object_with_act():
    network = cartpole.load_policy(cartpole.POLICY_FILE)
    trace = gymnasium("CartPole-v1", network, steps=20, signals=NAMES)({}, 0)
    env = gym.make("CartPole-v1")
    observation, _ = env.reset(seed=0)
    for k in range(20):
        assert trace["theta"][k] == observation[2]
        assert trace["action"][k] == int(network.act(observation))
        observation, *_ = env.step(int(trace["action"][k]))


@pytest.mark.slow
def test_workers_make_their_own_environment():
    system = CARTPOLE(steps=50, workers=1)
    alone = CARTPOLE(steps=50)
    alone(POLE, 0)
    found = dict(system.simulate_each([POLE, {**POLE, "length": 0.3}], [0, 1]))
    system.close()
    assert [found[i].message for i in range(2)] == ["", ""]
    np.testing.assert_array_equal(found[0].trace["x"], alone(POLE, 0)["x"])
    np.testing.assert_array_equal(found[1].trace["x"], alone({**POLE, "length": 0.3}, 1)["x"])


@pytest.mark.parametrize(
    ("arguments", "options", "match"),
    [
        (
            ("CartPol-v1", balancing),
            {"steps": 5},
            "environment .* 'CartPol-v1'; did you mean",
        ),
        ((3, balancing), {"steps": 5}, "env must be an id or a function that makes one; got 3"),
        (("CartPole-v1", 3), {"steps": 5}, "policy must be a function of the observation.*got 3"),
        (("CartPole-v1", balancing), {"steps": 0}, "steps must be an integer of at least 1; got 0"),
        (("CartPole-v1", balancing), {"steps": 5, "dt": 0}, "dt must be a positive number"),
        (("CartPole-v1", balancing), {"steps": 5, "signals": 3}, "signals must be names of the"),
        (("CartPole-v1", balancing), {"stepz": 5}, "option of gymnasium 'stepz'; did you mean"),
    ],
)
def test_refuses_what_does_not_fit(arguments, options, match):
    with unchecked(), pytest.raises(ValueError, match=match):
        gymnasium(*arguments, **options)


def test_an_attribute_that_is_not_there_is_named_before_anything_runs():
    system = gymnasium("CartPole-v1", balancing, steps=5, features={"m": "massploe"})
    problem = vj.Problem("pole", {"m": vj.Box(0.1, 0.2)}, system, "always action <= 1")
    with pytest.raises(
        ValueError, match="unknown attribute of CartPole-v1 'massploe'; did you mean 'mass"
    ):
        problem.check()
    system = gymnasium("CartPole-v1", balancing, steps=5, features=("masspole",))
    problem = vj.Problem("pole", {"maspole": vj.Box(0.1, 0.2)}, system, "always action <= 1")
    with pytest.raises(ValueError, match="unknown feature 'masspole'; did you mean 'maspole'"):
        problem.check()


RISING = {"signals": {"height": "height"}, "features": {"fast": "speed"}}
FAST = {"fast": vj.Box(0.5, 1.0)}


@pytest.mark.parametrize(
    ("space", "options", "spec", "match"),
    [
        (
            FAST | {"more": vj.Box(0, 1)},
            {},
            "height < 9",
            "feature 'more' changes nothing in Rising",
        ),
        (FAST, {}, "heigth < 9", "the trace has no signal 'heigth'; did you mean 'height'"),
        (FAST, {"signals": None}, "hight < 9", "the trace has no signal 'hight'; did you mean"),
        (FAST, {"signals": {"h": "hight"}}, "h < 9", "entry of Rising's observation 'hight'; did"),
        (
            FAST | {"late": vj.Box(0, 3)},
            {"action_delay": {"late": 3}},
            "height < 9",
            r"'late' is a delay in whole steps: make it a DiscreteBox, as in DiscreteBox\(0, 3\)",
        ),
    ],
)
def test_a_problem_that_does_not_fit_is_refused_before_anything_runs(space, options, spec, match):
    system = gymnasium(Rising, lambda o: [1.0], steps=5, **{**RISING, **options})
    with pytest.raises(ValueError, match=match):
        vj.Problem("rising", space, system, spec).check()


def test_an_attribute_of_the_class_is_set_too():
    problem = vj.Problem(
        "rising", FAST, gymnasium(Rising, lambda o: [1.0], steps=5, **RISING), "height < 9"
    )
    problem.check()
    assert problem.system({"fast": 0.5}, 0)["height"][-1] == pytest.approx(2.5)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"policy": lambda a, b: 1}, r"policy is called with \(observation\); got a function of"),
        (
            {"configure": lambda env: 1},
            r"configure is called with \(env, features\); got a function",
        ),
        ({"signals": lambda o: o}, r"signals is called with \(env, observation, action, reward, f"),
        ({"reset": lambda env: 1}, r"reset is called with \(env, features, seed\); got a function"),
    ],
)
def test_functions_of_other_arguments_are_refused_at_once(options, match):
    options = {"policy": balancing, "steps": 5} | options
    with pytest.raises(ValueError, match=match):
        gymnasium("CartPole-v1", **options)


@pytest.mark.parametrize(
    ("policy", "options", "match"),
    [
        (lambda o: 0.5, {}, "policy must return one of the 2 actions of CartPole-v1; got 0.5"),
        (lambda o: 2, {}, "policy must return one of the 2 actions of CartPole-v1; got 2"),
        (
            balancing,
            {"signals": ("x", "v")},
            "signals has 2 names, x, v, for the entries",
        ),
        (balancing, {"reset": lambda e, f, s: None}, "reset must return the first observation of"),
    ],
)
def test_parts_that_do_not_fit_together(policy, options, match):
    with pytest.raises((ValueError, TypeError), match=match):
        gymnasium("CartPole-v1", policy, steps=5, **options)({}, 0)


def test_an_action_of_the_wrong_shape():
    with pytest.raises(ValueError, match=r"action of Pendulum-v1; got .* of shape \[2\], where"):
        gymnasium("Pendulum-v1", lambda o: np.ones(2), steps=5)({}, 0)


def test_what_makes_no_environment():
    with pytest.raises(TypeError, match=r"dict must make a Gymnasium environment; it made \{\}"):
        gymnasium(dict, balancing, steps=5)({}, 0)


class Integrates:
    def __init__(self):
        self.total = 0.0

    def __call__(self, observation):
        self.total += float(observation[2]) + 0.3
        return int(np.sin(9 * self.total) > 0)


class Begins(Integrates):
    def reset(self):
        self.total = 0.0


class Forgets(Integrates):
    def reset(self):
        pass


def test_a_policy_begins_each_episode_anew_or_is_refused():
    def episode(policy):
        return gymnasium("CartPole-v1", policy, steps=20, signals=NAMES)

    begins = episode(Begins())
    first, again = (begins({}, 3)["theta"] for _ in range(2))
    np.testing.assert_array_equal(first, again)
    for policy, words in {
        Integrates(): "keeps attribute 'total' of Integrates from one call to the next",
        Forgets(): "keeps attribute 'total' of Forgets from one call to the next",
        lambda observation: int(np.random.rand() < 0.5): "other numbers each time",  # noqa: NPY002
    }.items():
        refused = episode(policy)
        for _ in range(2):
            with pytest.raises(ValueError, match=words) as error:
                refused({}, 3)
        assert ("Its reset() is called" in str(error.value)) == isinstance(policy, Forgets)
