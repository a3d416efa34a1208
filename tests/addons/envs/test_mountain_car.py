from dataclasses import replace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.classic_control import continuous_mountain_car

from envs import mountain_car as mc
from specs.mountain_car import climb, climb_continuous, climb_with
from verifai_jax.addons.rl import Continuous, Discrete, Policy, evaluate
from verifai_jax.evaluation.verdicts import trace_verdict

KEY = jax.random.key(0)
STEPS = 400


def swinging(rng, continuous):
    """Actions that reach the goal, the left wall and the greatest speed, and others."""
    pushes = np.repeat(rng.uniform(-1.5, 1.5, STEPS // 25), 25)
    return pushes if continuous else np.clip(np.round(pushes), -1, 1)


class DoublePrecision:
    """NumPy, but its float32 is float64: what Gymnasium rounds its state to."""

    float32 = np.float64

    def __getattr__(self, name):
        return getattr(np, name)


def gymnasium_episode(continuous, start, actions, **constants):
    """States, rewards and terminations of Gymnasium under these throttles, past the end too."""
    env = gymnasium.make("MountainCarContinuous-v0" if continuous else "MountainCar-v0").unwrapped
    env.reset(seed=0)
    for name, value in constants.items():
        setattr(env, name, value)
    env.state = np.array(start, np.float64)
    states, rewards, terminations = [np.array(env.state)], [], []
    for action in actions:
        taken = np.array([action]) if continuous else int(action) + 1
        _, reward, over, _, _ = env.step(taken)
        states.append(np.array(env.state, np.float64))
        rewards.append(float(reward))
        terminations.append(over)
    return np.array(states), np.array(rewards), np.array(terminations)


def ours(continuous, start, actions, dtype):
    """The same of our task."""
    task = mc.ContinuousMountainCarTask() if continuous else mc.MountainCarTask()
    nominal = mc.NOMINAL_CONTINUOUS if continuous else mc.NOMINAL

    @jax.jit
    def run(start, actions):
        def step(episode, action):
            taken = action[None] if continuous else action.astype(jnp.int32) + 1
            after, reward, over = task.step(KEY, episode, taken)
            return after, (after.state, reward, over)

        physics = (jnp.asarray(nominal[name], dtype) for name in ("power", "gravity"))
        episode = mc.Episode(mc.State(*start), *physics)
        _, (states, rewards, over) = jax.lax.scan(step, episode, actions)
        return jnp.stack(states, axis=1), rewards, over

    states, rewards, over = run(np.asarray(start, dtype), np.asarray(actions, dtype))
    assert states.dtype == dtype
    return np.concatenate([np.asarray(start)[None], states]), np.asarray(rewards), np.asarray(over)


@pytest.mark.slow
@pytest.mark.parametrize("continuous", [False, True])
def test_equal_to_gymnasium_step_for_step(continuous, monkeypatch):
    # Gymnasium computes the discrete car in float64; it rounds the continuous one's state to
    # float32 at each step, which is switched off for the comparison in float64.
    ended = walls = fastest = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        start = np.float32([rng.uniform(-1.1, 0.3), rng.uniform(-0.05, 0.05)])
        actions = np.float32(swinging(rng, continuous))
        rounded = gymnasium_episode(continuous, start, actions)
        with monkeypatch.context() as patch:
            patch.setattr(continuous_mountain_car, "np", DoublePrecision())
            exact = gymnasium_episode(continuous, start, np.float64(actions))
        with jax.enable_x64():
            double = ours(continuous, start, actions, np.float64)
        np.testing.assert_allclose(double[0], exact[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(double[1], exact[1], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(double[2], exact[2])
        single = ours(continuous, start, actions, np.float32)
        np.testing.assert_allclose(single[0], rounded[0], rtol=0, atol=3e-5)
        differs = single[2] != rounded[2]
        np.testing.assert_allclose(single[1][~differs], rounded[1][~differs], atol=1e-5)
        assert differs.sum() <= 1
        ended += exact[2].sum()
        walls += np.sum((exact[0][:, 0] == mc.LEFT) & (exact[0][:, 1] == 0))
        fastest = max(fastest, np.abs(exact[0][:, 1]).max())
    assert ended > 0
    assert walls > 0
    assert fastest > 0.05


def test_system_is_gymnasium_with_other_physics_until_the_goal():
    rng = np.random.default_rng(26)
    actions = swinging(rng, False)
    constants = {"force": 0.0013, "gravity": 0.0021, "max_speed": 0.05}
    states, _, over = gymnasium_episode(False, [-0.9, 0.01], actions, **constants)
    assert over.any()
    end = int(np.argmax(over)) + 1
    with jax.enable_x64():

        def controller(time, state, features):
            return jnp.asarray(actions)[jnp.round(time).astype(int)]

        features = {
            "position0": -0.9,
            "velocity0": 0.01,
            "power": constants["force"],
            "gravity": constants["gravity"],
            "max_speed": constants["max_speed"],
        }
        trace = jax.jit(mc.mountain_car(controller, steps=STEPS - 1))(features, KEY)
    got = np.stack([trace["position"], trace["velocity"]], axis=1)
    np.testing.assert_allclose(got[: end + 1], states[: end + 1], rtol=0, atol=1e-12)
    assert np.all(got[end:] == got[end])
    np.testing.assert_array_equal(trace["throttle"][:end], actions[:end])


@pytest.mark.parametrize("name", ["MountainCar-v0", "MountainCarContinuous-v0"])
def test_missing_features_are_gymnasiums(name):
    env = gymnasium.make(name)
    inner, continuous = env.unwrapped, "Continuous" in name
    kind = "continuous" if continuous else "discrete"
    assert inner.goal_position == mc.GOAL[kind]
    assert (
        env.spec.max_episode_steps == mc.STEPS[kind] == mc.mountain_car(continuous=continuous).steps
    )
    assert (inner.min_position, inner.max_position) == (mc.LEFT, mc.RIGHT)
    assert inner.max_speed == mc.MAX_SPEED
    assert (
        inner.power == mc.NOMINAL_CONTINUOUS["power"]
        if continuous
        else (inner.force == mc.NOMINAL["power"] and inner.gravity == mc.NOMINAL["gravity"])
    )


@pytest.mark.thorough
def test_rolling_along_climbs_the_hill_and_full_throttle_does_not():
    climbing = jax.jit(mc.mountain_car())
    climbs = climbing({"velocity_bias": 0.0}, KEY)
    stuck = mc.mountain_car(lambda time, state, features: 1.0)({}, KEY)
    assert float(climbs["position"][-1]) >= 0.5
    assert float(jnp.max(stuck["position"])) < 0.0
    # It coasts back once that is enough, clear of the wall that it would hit.
    gentle = mc.mountain_car(mc.along(enough=0.4), continuous=True)({}, KEY)
    harsh = mc.mountain_car(continuous=True)({}, KEY)
    assert float(jnp.min(gentle["position"])) > -1.1
    assert float(jnp.min(harsh["position"])) == pytest.approx(mc.LEFT)
    assert float(gentle["position"][-1]) >= 0.45
    # A sensor that shows a roll to the right where there is none turns the engine too early.
    misled = climbing({"velocity_bias": 0.02}, KEY)
    assert float(jnp.max(misled["position"])) < 0.0


def test_friction_takes_energy():
    rolling = lambda time, state, features: 0.0  # noqa: E731
    start = {"position0": -0.9}
    free = mc.mountain_car(rolling)(start, KEY)
    braked = mc.mountain_car(rolling)({**start, "friction": 0.05}, KEY)
    first = mc.State(jnp.float32(-0.9), jnp.float32(0.0))
    last = [mc.State(trace["position"][-1], trace["velocity"][-1]) for trace in (free, braked)]
    # Symplectic Euler keeps the energy within its step's order.
    assert float(mc.energy(last[0])) == pytest.approx(float(mc.energy(first)), rel=0.1)
    assert float(mc.energy(last[1])) < 0.02


def test_shaping_sums_to_the_difference_of_potentials():
    plain, discount = mc.MountainCarTask(), 0.97
    shaped = replace(plain, potential=20.0, shaping_discount=discount)
    rng = np.random.default_rng(0)
    episode = plain.reset(KEY)
    start, total, weight = episode.state, 0.0, 1.0
    step = jax.jit(lambda task, e, a: task.step(KEY, e, a))
    for _ in range(50):
        action = jnp.int32(rng.integers(3))
        _, reward, over = step(plain, episode, action)
        episode, more, _ = step(shaped, episode, action)
        assert float(reward) == -1.0
        assert not over
        total, weight = total + weight * float(more - reward), weight * discount
    value = [20.0 * float(mc.energy(state) - 1) for state in (start, episode.state)]
    assert total == pytest.approx(discount**50 * value[1] - value[0], rel=1e-4)
    # At the goal the potential is 0, whatever the speed.
    near = episode._replace(state=mc.State(jnp.float32(0.49), jnp.float32(0.05)))
    _, reward, over = step(shaped, near, jnp.int32(2))
    assert bool(over)
    assert float(reward) == pytest.approx(-1 - 20.0 * float(mc.energy(near.state) - 1), rel=1e-5)


@pytest.mark.thorough
def test_ranges_of_episodes():
    task = mc.ContinuousMountainCarTask(
        start_range=0.4, start_speed_range=0.02, power_range=1.0, gravity_range=0.5
    )
    episodes = jax.vmap(task.reset)(jax.random.split(KEY, 4000))
    power = np.asarray(episodes.power) / 0.0015
    assert 0.5 <= power.min() < 0.51
    assert 1.98 < power.max() <= 2.0
    assert np.median(power) == pytest.approx(1.0, rel=0.05)
    gravity = np.asarray(episodes.gravity) / 0.0025
    assert gravity.min() == pytest.approx(1 / 1.5, rel=0.01)
    assert gravity.max() == pytest.approx(1.5, rel=0.01)
    position = np.asarray(episodes.state.position)
    assert (position.min(), position.max()) == pytest.approx((-0.9, -0.1), abs=0.01)
    assert np.abs(episodes.state.velocity).max() == pytest.approx(0.02, rel=0.02)
    plain = jax.vmap(mc.MountainCarTask().reset)(jax.random.split(KEY, 100))
    assert np.all(plain.power == np.float32(0.001))
    assert np.all(plain.state.velocity == 0)
    assert np.all((plain.state.position >= -0.6) & (plain.state.position <= -0.4))


def test_a_task_is_a_pytree_of_its_numbers():
    task = mc.MountainCarTask(potential=3.0)
    leaves, structure = jax.tree.flatten(task)
    assert len(leaves) == 6
    assert jax.tree.unflatten(structure, leaves) == task
    assert jax.tree.structure(mc.MountainCarTask(time_limit=100)) != structure


@pytest.mark.parametrize(
    ("field", "value", "wanted"),
    [
        ("power_range", -0.1, "at least 0"),
        ("start_range", 0.8, "between 0 and 0.7"),
        ("shaping_discount", 1.1, "between 0 and 1"),
    ],
)
def test_tasks_refuse_numbers_out_of_range(field, value, wanted):
    with pytest.raises(
        ValueError, match=f"MountainCarTask's {field} must be {wanted}; got {value}"
    ):
        mc.ContinuousMountainCarTask(**{field: value})


@pytest.mark.thorough
@pytest.mark.parametrize("action", [Discrete(3), Continuous(-1.0, 1.0)])
def test_a_network_drives_the_system_as_it_drives_the_task(action):
    continuous = isinstance(action, Continuous)
    rng = np.random.default_rng(4)
    sizes = ((2, 16), (16, 1 if continuous else 3))
    layers = tuple(
        (np.float32(0.5 * rng.normal(size=s)), np.zeros(s[1], np.float32)) for s in sizes
    )
    policy = Policy(layers, None, None, None, action)
    task = mc.ContinuousMountainCarTask() if continuous else mc.MountainCarTask()
    episode = task.reset(KEY)
    step = jax.jit(lambda e: task.step(KEY, e, policy.act(task.observe(e))))
    positions = [float(episode.state.position)]
    start = positions[0]
    for _ in range(60):
        episode, _, _ = step(episode)
        positions.append(float(episode.state.position))

    @jax.jit
    def drive(policy, start):
        system = mc.mountain_car(mc.neural(policy), continuous=continuous, steps=60)
        return system({"position0": start}, KEY)["position"]

    np.testing.assert_allclose(drive(policy, start), positions, atol=1e-5)
    raw = Policy(layers, -jnp.array([0.3, 0.0]), jnp.array([0.9, 0.07]), None, action)
    see = mc.State(jnp.float32(-0.7), jnp.float32(0.02))

    @jax.jit
    def both(velocity):
        at = see._replace(velocity=velocity)
        return mc.neural(policy)(0.0, at, {}), mc.neural(raw, raw=True)(0.0, at, {})

    throttle, same = both(0.02)
    assert float(throttle) == pytest.approx(float(same), abs=1e-5)
    assert float(jax.jit(jax.jacfwd(lambda v: both(v)[0]))(0.02)) != 0.0


def test_neural_refuses_what_it_cannot_use():
    layers = ((np.zeros((2, 2), np.float32), np.zeros(2, np.float32)),)
    with pytest.raises(ValueError, match="sees 2 numbers and has 3 discrete actions or one"):
        mc.neural(Policy(layers, None, None, None, Discrete(2)))


def pushing_along(continuous):
    """The baseline as a network: full throttle the way it rolls, to the right from rest."""
    if continuous:
        layers = ((jnp.array([[0.0], [1e6]]), jnp.full(1, 1.0)),)
        return Policy(layers, None, None, None, Continuous(-1.0, 1.0))
    weight = jnp.array([[0.0, 0.0, 0.0], [-1e6, 0.0, 1e6]])
    return Policy(((weight, jnp.array([0.0, -1.0, 0.5])),), None, None, None, Discrete(3))


@pytest.mark.thorough
@pytest.mark.parametrize("continuous", [False, True])
def test_one_program_judges_any_policy_of_a_form(continuous):
    baseline = climb_continuous if continuous else climb
    u = np.random.default_rng(0).uniform(size=(256, 5)).astype(np.float32)

    def worst(problem, u):
        def one(u):
            return trace_verdict(problem, problem.system(problem.space.unflatten(u), KEY))[0][0]

        return jax.vmap(one)(u)

    judged = jax.jit(lambda policy, u: worst(climb_with(policy), u))
    policy = pushing_along(continuous)
    rho = np.asarray(judged(policy, u))
    lazy = np.asarray(judged(jax.tree.map(jnp.zeros_like, policy), u))
    assert judged._cache_size() == 1
    # Some turn around a step earlier or later: rounding decides the sign of a small velocity.
    close = np.isclose(rho, jax.jit(lambda u: worst(baseline, u))(u), atol=1e-5)
    assert close.mean() > 0.95
    assert np.mean(rho < 0) < 0.02
    assert np.mean(lazy < 0) > 0.5
    assert climb_with(policy).name == baseline.name
    baseline.check()


@pytest.mark.slow
def test_pushing_along_solves_the_tasks():
    returns = evaluate(mc.ContinuousMountainCarTask(), pushing_along(True), episodes=50)
    assert returns.min() > 85
    policy = pushing_along(False)
    returns = evaluate(mc.MountainCarTask(), policy, episodes=50)
    assert -130 < returns.mean() < -100
