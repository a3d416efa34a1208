import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from envs import cartpole as cp
from verifai_jax.addons.rl import PPO, Continuous, Discrete, Policy, Task, train
from verifai_jax.addons.rl.policy import new_layers
from verifai_jax.addons.rl.task.mjx import mjx_task
from verifai_jax.addons.rl.task.ode import ode_task
from verifai_jax.addons.training.sweeps import Trainer
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.systems.ode import ode

KEY = jax.random.key(5)

ARM = """
<mujoco>
  <option timestep="0.005" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" contype="0" conaffinity="0"/>
        <site name="tip" pos="0 0 -0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder" gear="4" ctrllimited="true" ctrlrange="-1 2"/>
    <motor joint="elbow" gear="2" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def can_be_trained_on(task):
    """An update can be traced: states keep their form from reset to step; nothing compiles."""
    ppo = PPO(environments=2, horizon=16, hidden=(4,))
    jax.eval_shape(lambda key: ppo.step(task, ppo.init(task, key, 1)), KEY)


# gymnax


@pytest.fixture(scope="module")
def gymnax():
    return pytest.importorskip("gymnax")


def gymnax_task(*arguments, **options):
    from verifai_jax.addons.rl.task.gymnax import gymnax_task

    return gymnax_task(*arguments, **options)


@pytest.mark.thorough
def test_gymnax_task_is_the_environments_own_rollout(gymnax):
    for name, steps in (("CartPole-v1", 60), ("Pendulum-v1", 20)):
        task = gymnax_task(name)
        env, params = gymnax.make(name)
        assert isinstance(task, Task)
        assert task.time_limit == params.max_steps_in_episode
        observation, state = env.reset_env(KEY, params)
        ours = task.reset(KEY)
        np.testing.assert_array_equal(task.observe(ours), observation)
        theirs = jax.jit(lambda k, s, a, env=env, params=params: env.step_env(k, s, a, params))
        mine = jax.jit(task.step)
        ended = False
        for k in range(steps):
            key = jax.random.fold_in(KEY, k)
            # A push to where the pole falls, which soon is too much.
            action = jnp.int32(1) if name == "CartPole-v1" else jnp.array([2.5])
            observation, state, reward, terminated, _ = theirs(key, state, action)
            ours, earned, over = mine(key, ours, action)
            np.testing.assert_array_equal(task.observe(ours), observation)
            assert (float(earned), bool(over)) == (float(reward), bool(terminated))
            ended |= bool(over)
        assert ended == (name == "CartPole-v1")


class Counter:
    """An environment of one's own in the shape of gymnax's; its step merges its time limit."""

    name = "Counter"
    supports_transition_gradients = transition_gradients_enabled = False

    def __init__(self, struct, spaces):
        self.struct, self.spaces = struct, spaces

        @struct.dataclass
        class Params:
            goal: float = 7.0
            max_steps_in_episode: int = 5

        @struct.dataclass
        class State:
            place: float
            time: int

        self.State, self.default_params = State, Params()

    def reset_env(self, key, params):
        state = self.State(place=0, time=0)
        return self.observe(key, state, None, params), state

    def step_env(self, key, state, action, params):
        # From -1 to 3 and from 0 to 10 in its own units.
        state = self.State(place=state.place + action[0], time=state.time + 1)
        over = (state.place >= params.goal) | (state.time >= params.max_steps_in_episode)
        return self.observe(key, state, action, params), state, action[1], over, {}

    def is_truncated(self, state, params):
        return state.time >= params.max_steps_in_episode

    def observe(self, key, state, action, params):
        left = params.max_steps_in_episode - state.time
        return jnp.array([[state.place, left]], jnp.float32)

    def action_space(self, params):
        return self.spaces.Box(jnp.array([-1.0, 0.0]), jnp.array([3.0, 10.0]), (2,))


@pytest.mark.thorough
def test_a_time_limit_that_an_environment_merges_into_its_end_is_taken_out(gymnax):
    from flax import struct
    from gymnax.environments import spaces

    task = gymnax_task(Counter(struct, spaces))
    assert (task.action, task.time_limit) == (Continuous(-1.0, 1.0, 2), 5)
    state, seen = task.reset(KEY), []
    for _ in range(6):
        state, reward, over = task.step(KEY, state, jnp.array([0.0, 0.5]))
        seen.append((*map(float, task.observe(state)), float(reward), bool(over)))
    # Places by 1 and rewards of 7.5, in the environment's own units; its clock still shows.
    assert seen == [(k, 5 - k, 7.5, False) for k in range(1, 7)]
    state, _, over = task.step(KEY, state, jnp.array([0.0, 0.5]))
    assert bool(over)
    assert float(task.observe(state)[0]) == 7.0
    can_be_trained_on(task)


def test_gymnax_tasks_of_one_id_share_what_is_compiled(gymnax):
    one, other = (jax.tree.structure(gymnax_task("CartPole-v1")) for _ in range(2))
    assert one == other
    assert hash(one) == hash(other)
    assert one != jax.tree.structure(gymnax_task("CartPole-v1", time_limit=100))
    heavy = gymnax_task("CartPole-v1", params=gymnax_task("CartPole-v1").params.replace(length=2.0))
    assert jax.tree.structure(heavy) == one
    image = gymnax_task("Breakout-MinAtar")
    assert jax.eval_shape(image.observe, jax.eval_shape(image.reset, KEY)).shape == (400,)


def test_gymnax_task_refuses_what_does_not_fit(gymnax):
    from gymnax.wrappers.purerl import StickyActionWrapper

    with pytest.raises(UnknownNameError, match="'CartPole-v2'; did you mean 'CartPole-v1'"):
        gymnax_task("CartPole-v2")
    wrapped = StickyActionWrapper(gymnax.make("CartPole-v1")[0])
    with pytest.raises(ValueError, match="StickyActionWrapper is a wrapper"):
        gymnax_task(wrapped)
    with pytest.raises(ValueError, match=r"give time_limit=\.\.\.; got 0"):
        gymnax_task("CartPole-v1", time_limit=0)
    params = gymnax.make("Pendulum-v1")[1]
    with pytest.raises(ValueError, match="params must be those of CartPole-v1"):
        gymnax_task("CartPole-v1", params=params)
    with pytest.raises(UnknownNameError, match="'limit'; did you mean 'time_limit'"):
        gymnax_task("CartPole-v1", limit=3)


# Brax


@pytest.fixture(scope="module")
def brax():
    pytest.importorskip("brax")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from brax import envs
    return envs


def brax_task(*arguments, **options):
    from verifai_jax.addons.rl.task.brax import brax_task

    return brax_task(*arguments, **options)


def slide(envs):
    """A weight on a rail that is pushed; done at 1 m. A count in it begins as an integer."""

    class Slide(envs.Env):
        dt, observation_size, action_size, backend = 0.1, 2, 1, "none"

        def reset(self, rng):
            place = jnp.concatenate([0.2 * jax.random.normal(rng, (1,)), jnp.zeros(1)])
            zero = jnp.zeros(())
            return envs.State(place, place, zero, zero, {}, {"effort": 0})

        def step(self, state, action):
            x, v = state.pipeline_state
            v = v + 0.1 * action[0]
            place = jnp.stack([x + 0.1 * v, v])
            return state.replace(
                pipeline_state=place,
                obs=place,
                reward=-jnp.abs(x),
                done=jnp.where(jnp.abs(place[0]) > 1, 1.0, 0.0),
                info={"effort": state.info["effort"] + jnp.abs(action[0])},
            )

    return Slide()


@pytest.mark.thorough
def test_brax_task_is_the_environments_own_rollout(brax):
    env = slide(brax)
    task = brax_task(env, time_limit=30)
    assert isinstance(task, Task)
    assert (task.action, task.time_limit) == (Continuous(-1.0, 1.0, 1), 30)
    theirs, ours, ended = env.reset(KEY), task.reset(KEY), []
    mine = jax.jit(task.step)
    for _ in range(20):
        theirs = env.step(theirs, jnp.array([0.7]))
        ours, reward, over = mine(KEY, ours, jnp.array([0.7]))
        np.testing.assert_allclose(task.observe(ours), theirs.obs, rtol=1e-6)
        assert float(reward) == pytest.approx(float(theirs.reward))
        assert bool(over) == bool(theirs.done)
        ended.append(bool(over))
    assert ended[-1]
    assert not ended[0]
    assert float(ours.state.info["effort"]) == pytest.approx(14.0)
    can_be_trained_on(task)


def test_brax_task_refuses_what_does_not_fit(brax):
    from brax.envs.wrappers.training import EpisodeWrapper

    with pytest.raises(UnknownNameError, match="'hoper'; did you mean 'hopper'"):
        brax_task("hoper")
    with pytest.raises(ValueError, match="EpisodeWrapper is for training"):
        brax_task(EpisodeWrapper(slide(brax), 10, 1))
    with pytest.raises(ValueError, match="time_limit must be an integer of at least 1; got 0"):
        brax_task(slide(brax), time_limit=0)


@pytest.mark.proves
def test_an_environment_of_brax_is_its_own_rollout_and_can_be_learnt(brax):
    task = brax_task("inverted_pendulum", backend="generalized")
    assert task == brax_task("inverted_pendulum", backend="generalized")
    assert hash(task) == hash(brax_task("inverted_pendulum", backend="generalized"))
    actions = [jnp.array([np.sin(k)], jnp.float32) for k in range(20)]
    with warnings.catch_warnings():
        # Of Brax on itself, when a model is loaded and when its step is traced.
        warnings.simplefilter("ignore")
        env = brax.get_environment("inverted_pendulum", backend="generalized")
        advance, states = jax.jit(env.step), [jax.jit(env.reset)(KEY)]
        for action in actions:
            states.append(advance(states[-1], action))
    mine, ours = jax.jit(task.step), jax.jit(task.reset)(KEY)
    for action, theirs in zip(actions, states[1:], strict=True):
        ours, reward, over = mine(KEY, ours, action)
        np.testing.assert_allclose(task.observe(ours), theirs.obs, rtol=1e-4, atol=1e-5)
        assert (float(reward), bool(over)) == (float(theirs.reward), bool(theirs.done))
    ppo = PPO(learning_rate=1e-3, hidden=(16, 16), normalise=True, entropy=0.0)
    returns = train(task, ppo, steps=65_536).mean_return
    # The returns of training, as `evaluate` would compile the physics once more.
    assert np.nanmean(returns[-8:]) > 10 * returns[~np.isnan(returns)][0]


# Systems of our own


@pytest.mark.thorough
def test_ode_task_is_the_loop_under_the_same_controls():
    def features_of(key):
        return {"length": jax.random.uniform(key, minval=0.3, maxval=0.8), "theta0": 0.05}

    loop = replace(cp.cartpole(duration=1.0, terminate=True, dt=0.01), controller=None)
    task = ode_task(
        loop,
        Continuous(-10.0, 10.0),
        reward=lambda time, state, force, after: 1.0 - jnp.abs(after.x),
        features=features_of,
    )
    assert isinstance(task, Task)
    assert task.time_limit == 50
    layers = new_layers(jax.random.key(1), (4, 8, 1), gain=2.0)
    policy = Policy(layers, None, None, None, Continuous(-10.0, 10.0))
    tested = replace(
        loop,
        controller=lambda time, state, features: policy.act(jnp.stack(state))[0],
    )
    start = task.reset(KEY)
    assert 0.3 < float(start.features["length"]) < 0.8
    trace = jax.jit(tested)(start.features, KEY)
    step = jax.jit(lambda s: task.step(KEY, s, policy.act(task.observe(s))))
    now, periods, over = start, 0, False
    while not over and periods < 50:
        before = now
        now, reward, over = step(now)
        periods += 1
        assert float(reward) == pytest.approx(1 - abs(float(now.state.x)), rel=1e-6)
        row = min(2 * periods, int(trace.valid) - 1)
        seen = [trace[name][row] for name in cp.State._fields]
        np.testing.assert_allclose(task.observe(now), seen, rtol=2e-4, atol=1e-5)
    # It falls, and both end at the same sample.
    assert over
    assert int(trace.valid) < 101
    assert float(now.time) == pytest.approx((int(trace.valid) - 1) * 0.01, abs=1e-5)
    assert float(before.time) == pytest.approx((periods - 1) * 0.02, abs=1e-5)


def pendulum(time, state, torque, features):
    return {"angle": state["rate"], "rate": features["pull"] * jnp.sin(state["angle"]) + torque}


def test_weights_of_a_reward_are_fields_that_a_sweep_may_vary():
    loop = ode(pendulum, lambda f, key: {"angle": 0.1, "rate": 0.0}, dt=0.05, steps=40)

    def reward(time, state, torque, after, effort, bonus):
        return bonus - effort * torque**2

    def make(**weights):
        return ode_task(
            loop,
            Continuous(-1.0, 1.0),
            reward=reward,
            features={"pull": 9.8},
            weights={"effort": 0.5, "bonus": 1.0} | weights,
        )

    task = make()
    assert isinstance(task, Task)
    assert jax.tree.leaves(task) == [0.5, 1.0]
    start = task.reset(KEY)
    changed = replace(task, effort=2.0)
    earned = jax.jit(lambda task: task.step(KEY, start, jnp.asarray([0.5]))[1])
    assert float(earned(task)) == pytest.approx(1 - 0.5 * 0.25)
    assert float(earned(changed)) == pytest.approx(1 - 2.0 * 0.25)
    assert jax.tree.structure(task) == jax.tree.structure(changed)
    assert earned._cache_size() == 1
    trainer = Trainer(task, PPO())
    assert {"effort", "bonus"} <= set(trainer.names)
    assert trainer.configuration({"effort": 3}).task.effort == 3.0
    for name, message in (("loop", "cannot be a weight"), ("a b", "identifier of its own")):
        with pytest.raises(ValueError, match=message):
            make(**{name: 1.0})
    with (
        unchecked(),
        pytest.raises(ValueError, match="weight effort must be a finite number; got 'x"),
    ):
        make(effort="x")


@pytest.mark.slow
def test_ode_task_of_choices_and_what_it_refuses():
    loop = ode(
        pendulum, lambda f, key: {"angle": 0.1, "rate": 0.0}, dt=0.05, steps=40, method="rk4"
    )
    reward = lambda time, state, torque, after: jnp.cos(after["angle"])  # noqa: E731
    with pytest.raises(ValueError, match=r"Discrete\(n=3\) needs control=..., a function"):
        ode_task(loop, Discrete(3), reward=reward, features={"pull": 9.8})
    with pytest.raises(ValueError, match=r"there is no feature .pull.\. It has none"):
        ode_task(loop, Continuous(-1.0, 1.0), reward=reward)
    message = "action must be a Discrete or a Continuous; got 3"
    with unchecked(), pytest.raises(ValueError, match=message):
        ode_task(loop, 3, reward=reward, features={"pull": 9.8})
    task = ode_task(
        loop,
        Discrete(3),
        reward=reward,
        control=lambda action: 2.0 * (action - 1),
        observe=lambda s: [jnp.cos(s["angle"]), jnp.sin(s["angle"]), s["rate"]],
        features={"pull": 9.8},
        time_limit=10,
    )
    start = task.reset(KEY)
    np.testing.assert_allclose(task.observe(start), [np.cos(0.1), np.sin(0.1), 0.0], rtol=1e-6)
    after, earned, over = task.step(KEY, start, jnp.asarray(2))
    same = replace(loop, controller=lambda time, state, features: 2.0, steps=1)
    trace = same({"pull": 9.8}, KEY)
    assert float(after.state["angle"]) == pytest.approx(float(trace["angle"][1]), rel=1e-6)
    assert float(earned) == pytest.approx(np.cos(float(trace["angle"][1])), rel=1e-6)
    assert not over
    can_be_trained_on(task)


# MJX


@pytest.fixture(scope="module")
def arm():
    pytest.importorskip("mujoco.mjx")
    return mjx_task(
        ARM,
        control_period=0.02,
        time_limit=50,
        reward=lambda before, action, after: -jnp.sum(after.site_xpos[0] ** 2) + action[0],
        observe=lambda data: jnp.concatenate([data.qpos, data.qvel, data.site_xpos[0]]),
        initial=lambda key, qpos, qvel: (jax.random.uniform(key, qpos.shape), qvel),
        terminate=lambda data: data.qpos[0] > 2.0,
        vary=lambda key, model: {"body_mass": model.body_mass.at[2].set(0.5)},
    )


@pytest.fixture(scope="module")
def step(arm):
    return jax.jit(arm.step)


@pytest.mark.slow
def test_mjx_task_is_native_mujoco_under_the_same_controls(arm, step):
    import mujoco

    assert isinstance(arm, Task)
    assert arm.action == Continuous(-1.0, 1.0, 2)
    model = mujoco.MjModel.from_xml_string(ARM)
    model.body_mass[2] = 0.5
    data = mujoco.MjData(model)
    state = arm.reset(KEY)
    data.qpos[:] = state.qpos
    rng, over = np.random.default_rng(0), False
    for k in range(40):
        action = np.float32([1.0, 1.0] if k > 10 else rng.uniform(-1, 1, 2))
        data.ctrl[:] = 0.5 + 1.5 * action[0], action[1]
        mujoco.mj_step(model, data, 4)
        state, reward, over = step(KEY, state, action)
        mujoco.mj_kinematics(model, data)
        seen = np.concatenate([data.qpos, data.qvel, data.site_xpos[0]])
        np.testing.assert_allclose(arm.observe(state), seen, rtol=1e-3, atol=2e-3)
        wanted = action[0] - np.sum(data.site_xpos[0] ** 2)
        assert float(reward) == pytest.approx(wanted, abs=2e-3)
        assert bool(over) == (data.qpos[0] > 2.0)
        if over:
            break
    assert over


@pytest.mark.slow
def test_a_state_that_is_not_finite_ends_an_episode_without_poisoning_it(arm, step):
    can_be_trained_on(arm)
    state = arm.reset(KEY)
    after, reward, over = step(KEY, state, jnp.array([jnp.nan, 0.0]))
    assert bool(over)
    assert float(reward) == 0.0
    np.testing.assert_array_equal(after.qpos, state.qpos)
    assert np.all(np.isfinite(arm.observe(after)))


def test_mjx_task_refuses_what_does_not_fit():
    pytest.importorskip("mujoco.mjx")
    given = {"control_period": 0.02, "time_limit": 50, "reward": lambda b, a, c: 0.0}
    with pytest.raises(ValueError, match=r"multiple of the model's timestep 0.005 s; got 0.012"):
        mjx_task(ARM, **{**given, "control_period": 0.012})
    with pytest.raises(ValueError, match=r"Discrete\(n=3\) needs control=..., .* of 2 actuators"):
        mjx_task(ARM, **given, action=Discrete(3))
    with pytest.raises(UnknownNameError, match="'body_masses'; did you mean 'body_mass'"):
        mjx_task(ARM, **given, vary=lambda key, model: {"body_masses": model.body_mass})
    with pytest.raises(
        ValueError, match=r"initial must return \(qpos, qvel\), qpos of shape \[2\]"
    ):
        mjx_task(ARM, **given, initial=lambda key, qpos, qvel: (qpos[:1], qvel))
    with pytest.raises(ValueError, match="no actuator"):
        mjx_task("<mujoco><worldbody/></mujoco>", **given)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"weights": {"efort": 1.0}},
            r"weights=\{efort\} by name; got a function of \(t, s, c, a, eff",
        ),
        ({"weights": {}}, r"\(time, state, control, after\) and no weights; got a function of"),
        ({"weights": {"effort": float("nan")}}, "weight effort must be a finite number; got nan"),
        (
            {"reward": lambda t, s, c, a, effort: jnp.ones(2)},
            r"reward must return one number; got f",
        ),
        ({"features": lambda key: {"gain": 1.0}}, "there is no feature 'p0'.*features are gain"),
        ({"features": lambda: {}}, r"features is called with \(key\); got a function of \(\)"),
        ({"observe": lambda a, b: a}, r"observe is called with \(state\); got a function of"),
    ],
)
def test_parts_of_an_ode_task_that_do_not_fit_are_named(options, message):
    loop = ode(
        lambda t, s, c, f: {"p": c * f["gain"]}, lambda f, key: {"p": f["p0"]}, dt=0.1, duration=1.0
    )
    usual = {
        "reward": lambda t, s, c, a, effort: -effort * c**2,
        "weights": {"effort": 1.0},
        "features": {"gain": 1.0, "p0": 0.0},
    }
    with pytest.raises(ValueError, match=message):
        ode_task(loop, Continuous(-1.0, 1.0), **usual | options)
