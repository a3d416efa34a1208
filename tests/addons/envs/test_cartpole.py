from dataclasses import replace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import cartpole as cp
from envs.cartpole_task import CartPoleTask, Episode
from specs.cartpole import balance_with
from verifai_jax.addons.rl import Discrete, Policy, evaluate, load_policy
from verifai_jax.addons.rl.policy import new_layers
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.verdicts import trace_verdict

KEY = jax.random.key(0)


def gymnasium_episode(features, actions):
    """States of CartPole-v1 under these actions, up to the terminal one."""
    env = gymnasium.make("CartPole-v1").unwrapped
    env.reset(seed=0)
    for name in ("masscart", "masspole", "length", "force_mag"):
        setattr(env, name, features[name])
    env.total_mass = env.masspole + env.masscart
    env.polemass_length = env.masspole * env.length
    env.state = np.array([features[n] for n in ("x0", "x_dot0", "theta0", "theta_dot0")])
    states, terminated = [env.state], False
    for action in actions:
        _, _, terminated, _, _ = env.step(int(action))
        states.append(env.state)
        if terminated:
            break
    return np.array(states), terminated


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(8))
def test_equal_to_gymnasium_step_for_step(seed):
    rng = np.random.default_rng(seed)
    features = {
        "x0": rng.uniform(-2, 2),
        "x_dot0": rng.uniform(-1, 1),
        "theta0": rng.uniform(-0.1, 0.1),
        "theta_dot0": rng.uniform(-0.5, 0.5),
        "masscart": rng.uniform(0.5, 2),
        "masspole": rng.uniform(0.05, 0.5),
        "length": rng.uniform(0.3, 2),
        "force_mag": rng.uniform(5, 15),
    }
    actions = rng.integers(0, 2, 201)
    expected, terminated = gymnasium_episode(features, actions[:200])
    with jax.enable_x64():

        def controller(time, state, features):
            k = jnp.round(time / cp.DT).astype(int)
            return jnp.where(jnp.asarray(actions)[k] == 1, 1, -1) * features["force_mag"]

        trace = jax.jit(cp.cartpole(controller, terminate=True))(features, KEY)
    assert int(trace.valid) == len(expected)
    got = np.stack([trace[n] for n in ("x", "x_dot", "theta", "theta_dot")], axis=1)
    np.testing.assert_allclose(got[: len(expected)], expected, rtol=1e-11, atol=1e-11)
    assert terminated == (int(trace.valid) < 201)
    assert got.dtype == np.float64


def test_missing_features_are_those_of_cartpole_v1():
    env = gymnasium.make("CartPole-v1").unwrapped
    for name in ("masscart", "masspole", "length", "force_mag"):
        assert getattr(env, name) == cp.NOMINAL[name]
    assert env.x_threshold == cp.X_LIMIT
    assert env.theta_threshold_radians == cp.THETA_LIMIT
    assert env.tau == cp.DT


def test_linear_controller_balances_the_nominal_plant_and_not_every_plant():
    system = jax.jit(cp.cartpole(cp.linear(), duration=10.0))
    trace = system({"x0": 0.5, "theta0": 0.1}, KEY)
    assert int(trace.status) == Status.OK
    assert float(jnp.max(jnp.abs(trace["theta"]))) <= cp.THETA_LIMIT
    assert abs(float(trace["theta"][-1])) < 1e-3
    assert abs(float(trace["x"][-1])) < 0.05
    heavy = system({"theta0": 0.2, "masspole": 5.0, "length": 0.2}, KEY)
    assert float(jnp.max(jnp.abs(heavy["theta"]))) > cp.THETA_LIMIT


def test_force_is_saturated_at_the_features_force():
    trace = cp.cartpole(cp.linear())({"theta0": 0.2, "force_mag": 3.0}, KEY)
    assert float(trace["force"][0]) == 3.0


def test_linear_refuses_wrong_gains():
    with pytest.raises(ValueError, match=r"needs 4 gains; got \[1.0, 2.0\]"):
        cp.linear([1.0, 2.0])


@pytest.mark.parametrize("push_time", [1.0, 1.0123])
def test_push_gives_its_impulse_at_its_time(push_time):
    # Without gravity's lever (a massless-like pole at rest) the cart gains F t / m.
    system = cp.cartpole(lambda t, s, f: 0.0, duration=2.0)
    features = {"push": 7.0, "push_time": push_time, "masspole": 1e-6}
    x_dot = np.asarray(system(features, KEY)["x_dot"])
    assert np.all(x_dot[:51] == 0)
    assert x_dot[57] == pytest.approx(0.7, rel=1e-4)
    assert x_dot[-1] == pytest.approx(0.7, rel=1e-4)


def test_push_can_be_shifted_by_a_gradient():
    system = cp.cartpole(lambda t, s, f: 0.0, duration=2.0)

    def reached(push_time):
        return system({"push": 7.0, "push_time": push_time, "masspole": 1e-6}, KEY)["x"][-1]

    # A push that comes later by one second reaches 0.7 m less far.
    assert float(jax.grad(reached)(1.005)) == pytest.approx(-0.7, rel=1e-3)


def test_finer_step_converges():
    coarse = cp.cartpole(cp.linear())({"theta0": 0.1}, KEY)
    fine = cp.cartpole(cp.linear(), method="rk4", dt=0.005)({"theta0": 0.1}, KEY)
    np.testing.assert_allclose(coarse["theta"], fine["theta"][::4], atol=0.02)


def test_shipped_network_balances_cartpole_v1():
    returns = evaluate(CartPoleTask(), load_policy(cp.POLICY_FILE), seed=5, episodes=300)
    assert returns.mean() >= 475


def test_shipped_network_balances_in_gymnasium_itself():
    policy = load_policy(cp.POLICY_FILE)
    act = jax.jit(policy.act)
    env = gymnasium.make("CartPole-v1")
    observation, _ = env.reset(seed=11)
    total, over = 0.0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(int(act(observation)))
        total, over = total + float(reward), terminated or truncated
    assert total >= 475


@pytest.mark.slow
def test_shipped_network_fails_off_nominal():
    # What the whole toolkit is shown on: a controller of full return that breaks.
    system = cp.cartpole(cp.neural(), terminate=True)
    long = system({"x0": 0.9, "theta0": 0.1, "masspole": 0.3, "length": 1.2}, KEY)
    assert int(long.valid) < 201
    assert int(system({}, KEY).valid) == 201


def test_task_steps_like_gymnasium():
    env = gymnasium.make("CartPole-v1").unwrapped
    env.reset(seed=0)
    task = CartPoleTask()
    state = Episode(cp.State(*(jnp.float32(v) for v in env.state)), {})
    step = jax.jit(task.step)
    for action in [1, 0, 0] + [1] * 20:
        observed, reward, over, _, _ = env.step(action)
        state, our_reward, terminated = step(KEY, state, action)
        np.testing.assert_allclose(task.observe(state), observed, atol=1e-5)
        assert float(our_reward) == reward
        assert bool(terminated) == over
        if over:
            break
    assert over


@pytest.mark.slow
def test_an_episode_has_its_own_pole_and_start():
    task = CartPoleTask(masspole_range=1.0, length_range=0.5, x0_range=1.0, theta0_range=0.1)
    assert len(jax.tree.leaves(task)) == 5
    episodes = jax.vmap(task.reset)(jax.random.split(KEY, 4000))
    for name, least, most in (("masspole", 0.05, 0.2), ("length", 1 / 3, 0.75)):
        values = np.asarray(episodes.features[name])
        assert (values.min(), values.max()) == pytest.approx((least, most), rel=0.01)
        assert np.median(values) == pytest.approx(cp.NOMINAL[name], rel=0.05)
    for name, most in (("x", 1.0), ("theta", 0.1), ("x_dot", 0.05)):
        values = np.asarray(getattr(episodes.state, name))
        assert (values.min(), values.max()) == pytest.approx((-most, most), rel=0.01)
    together = np.corrcoef([*episodes.features.values(), *episodes.state])
    assert np.abs(together - np.eye(6)).max() < 0.06
    # One step is that of the system with the same features.
    first = jax.tree.map(lambda leaf: leaf[0], episodes)
    after, reward, over = task.step(KEY, first, 1)
    starts = zip(("x0", "x_dot0", "theta0", "theta_dot0"), first.state, strict=True)
    features = {**dict(starts), **first.features}
    trace = cp.cartpole(lambda time, state, f: 10.0, duration=cp.DT)(features, KEY)
    np.testing.assert_allclose(task.observe(after)[2], trace["theta"][1], rtol=1e-6)
    assert (float(reward), bool(over)) == (1.0, False)


def test_shaping_sums_to_the_difference_of_potentials():
    task = CartPoleTask(potential=3.0, shaping_discount=0.9)
    state = cp.State(*(jnp.float32(v) for v in (1.2, 0.0, cp.THETA_LIMIT / 2, 0.0)))
    episode, total, weight, over = Episode(state, {}), 0.0, 1.0, False
    step = jax.jit(task.step)
    while not over:
        episode, reward, over = step(KEY, episode, 1)
        total, weight = total + weight * (float(reward) - 1), weight * 0.9
    # It ends where the potential is 0: what is left is that of the start.
    assert total == pytest.approx(-3.0 * 0.75, rel=1e-4)


def test_task_refuses_numbers_out_of_range():
    with pytest.raises(ValueError, match=r"CartPoleTask's x0_range must be between 0 and 2.4; got"):
        CartPoleTask(x0_range=3.0)
    with pytest.raises(ValueError, match="length_range must be at least 0; got -1"):
        CartPoleTask(length_range=-1)


@pytest.mark.slow
def test_argmax_pushes_with_full_force_and_has_the_derivative_of_the_mean_force():
    hard, smooth = cp.neural(), cp.neural(action="expected")
    blind = cp.neural(straight_through=False)
    features = {"force_mag": 7.0}
    rng = np.random.default_rng(0)
    for point in rng.uniform(-0.2, 0.2, (20, 4)).astype(np.float32):
        at = [jnp.float32(v) for v in point]

        def force(controller, theta, at=at):
            return controller(0.0, cp.State(at[0], at[1], theta, at[3]), features)

        assert abs(float(force(hard, at[2]))) == 7.0
        assert float(force(hard, at[2])) * float(force(smooth, at[2])) > 0
        expected = jax.grad(lambda t, f=force: f(smooth, t))(at[2])
        np.testing.assert_allclose(
            jax.grad(lambda t, f=force: f(hard, t))(at[2]), expected, rtol=1e-4, atol=1e-6
        )
        assert float(jax.grad(lambda t, f=force: f(blind, t))(at[2])) == 0


@pytest.mark.thorough
@pytest.mark.parametrize("width", [16, 64])
def test_force_is_that_of_the_policy_small_or_large_normalised_or_not(width):
    layers = new_layers(jax.random.key(1), (4, width, width, 2), gain=1.0)
    mean, scale = jnp.array([0.1, -0.2, 0.05, 0.3]), jnp.array([1.0, 2.0, 0.1, 0.7])
    for policy in (
        Policy(layers, None, None, None, Discrete(2)),
        Policy(layers, mean, scale, None, Discrete(2)),
    ):
        state = jnp.array([0.3, -0.5, 0.1, 0.4])
        logits = np.asarray(policy(state))
        force = cp.neural(policy, action="expected")(0.0, cp.State(*state), {})
        assert float(force) == pytest.approx(10 * np.tanh((logits[1] - logits[0]) / 2), rel=1e-4)
        push = cp.neural(policy)(0.0, cp.State(*state), {})
        assert float(push) == (10 if int(policy.act(state)) == 1 else -10)


@pytest.mark.slow
def test_one_program_judges_any_policy_of_a_form():
    @jax.jit
    def worst(policy, u):
        problem = balance_with(policy)

        def one(u):
            return trace_verdict(problem, problem.system(problem.space.unflatten(u), KEY))[0][0]

        return jax.vmap(one)(u)

    rng = np.random.default_rng(0)
    u = rng.uniform(size=(64, 4)).astype(np.float32)
    shipped = load_policy(cp.POLICY_FILE)
    rho = np.asarray(worst(shipped, u))
    wrong = np.asarray(worst(jax.tree.map(lambda leaf: -leaf, shipped), u))
    assert worst._cache_size() == 1
    assert np.mean(rho < 0) < 0.1
    assert np.mean(wrong < 0) > 0.9
    # As constants, which are written out.
    problem = balance_with(shipped)
    row = int(np.argmin(rho))
    alone = trace_verdict(problem, jax.jit(problem.system)(problem.space.unflatten(u[row]), KEY))[
        0
    ][0]
    np.testing.assert_allclose(alone, rho[row], atol=1e-4)


def test_neural_refuses_what_it_cannot_use():
    with pytest.raises(UnknownNameError, match="unknown action 'argmin'; did you mean 'argmax'"):
        cp.neural(action="argmin")
    policy = load_policy(cp.POLICY_FILE)
    with pytest.raises(ValueError, match="has 2 discrete actions; got 4 and Discrete"):
        cp.neural(replace(policy, action=Discrete(3)))


@pytest.mark.thorough
def test_wind_is_a_force_on_the_cart():
    blown = cp.cartpole(lambda time, state, f: 0.0 * state.x, duration=0.2)
    pushed = cp.cartpole(lambda time, state, f: 2.0 * time + 0.0 * state.x, duration=0.2)
    wind = jax.tree_util.Partial(lambda time: 2.0 * time)
    one = blown({"theta0": 0.02, "wind": wind}, KEY)
    other = pushed({"theta0": 0.02}, KEY)
    np.testing.assert_allclose(one.signals["theta"], other.signals["theta"], rtol=1e-6)
    assert abs(one.signals["theta"][-1] - blown({"theta0": 0.02}, KEY).signals["theta"][-1]) > 1e-4


@pytest.mark.slow
def test_either_controller():
    both = cp.cartpole(cp.either(cp.linear(), cp.neural()), duration=0.2)
    for place, alone in enumerate((cp.linear(), cp.neural())):
        one = both({"theta0": 0.05, "controller": jnp.int32(place)}, KEY)
        other = cp.cartpole(alone, duration=0.2)({"theta0": 0.05}, KEY)
        np.testing.assert_array_equal(one.signals["theta"], other.signals["theta"])
    with pytest.raises(ValueError, match="at least one controller"):
        cp.either()
