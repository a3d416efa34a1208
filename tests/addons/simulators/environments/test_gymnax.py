import importlib
import importlib.metadata

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from envs import cartpole as cp
from verifai_jax.addons.rl import Continuous, Discrete, Policy, load_policy
from verifai_jax.addons.rl.policy import new_layers
from verifai_jax.addons.simulators.environments.episode import episode_keys
from verifai_jax.core.messages.errors import MissingExtra, UnknownNameError
from verifai_jax.core.values.trace import Status
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.testing import check_forks, check_system

package = pytest.importorskip("gymnax")

from gymnax.wrappers.purerl import StickyActionWrapper  # noqa: E402

from verifai_jax.addons.simulators.environments._gymnax import gymnax  # noqa: E402

KEY = jax.random.key(7)
PARTS = ("x", "x_dot", "theta", "theta_dot")


def lean(observation):
    """Push to where the pole falls: balances for a while."""
    return (observation[2] + 0.3 * observation[3] > 0).astype(int)


def right(observation):
    return 1


def coin(observation, key):
    return jax.random.bernoulli(key)


def by_hand(name, choose, steps, key, **changes):
    """Observations, rewards and ends of an environment stepped in Python, without reset."""
    env, params = package.make(name)
    params = params.replace(**changes)
    keys = episode_keys(key)
    observation, state = env.reset_env(keys.start, params)
    seen = [(np.asarray(observation), 0.0, False)]
    step = jax.jit(lambda k, s, a: env.step_env(k, s, a, params))
    for k in range(steps):
        action = choose(observation, jax.random.fold_in(keys.decide, k))
        observation, state, reward, over, _ = step(jax.random.fold_in(keys.step, k), state, action)
        seen.append((np.asarray(observation), float(reward), bool(over)))
        if over:
            break
    return [np.array(column) for column in zip(*seen, strict=True)]


@pytest.mark.thorough
@pytest.mark.parametrize("policy", [lean, right, coin])
def test_equal_to_the_environment_stepped_by_hand(policy):
    choose = policy if policy is coin else lambda o, key: policy(o)
    observations, rewards, over = by_hand("CartPole-v1", choose, 60, KEY, force_mag=12.0)
    system = gymnax("CartPole-v1", policy, steps=60, features={"push": "force_mag"})
    trace = jax.jit(system)({"push": 12.0}, KEY)
    assert int(trace.valid) == len(observations)
    assert over[-1] == (int(trace.valid) < 61)
    np.testing.assert_allclose(trace.trim()["observation"], observations, atol=1e-6)
    np.testing.assert_array_equal(trace.trim()["reward"], rewards)


def test_an_environment_that_is_over_is_not_reset_in_the_trace():
    trace = jax.jit(gymnax("CartPole-v1", right, steps=60))({}, KEY)
    end = int(trace.valid)
    assert 8 < end < 15
    assert trace.held
    params = package.make("CartPole-v1")[1]
    # The package's own `step` would be back at the middle by now.
    assert abs(float(trace["theta"][-1])) > params.theta_threshold_radians
    for name in (*PARTS, "action", "reward"):
        np.testing.assert_array_equal(trace[name][end:], trace[name][end - 1])
    assert int(trace.status) == Status.OK


@pytest.mark.thorough
def test_cartpole_is_that_of_our_own_equations():
    policy = load_policy(cp.POLICY_FILE)
    theirs = gymnax(
        "CartPole-v1",
        policy,
        steps=100,
        features=["masspole", "masscart", "length"],
        initial={"x0": "x", "x_dot0": "x_dot", "theta0": "theta", "theta_dot0": "theta_dot"},
    )

    def push(time, state, features):
        return jnp.where(policy.act(jnp.stack(state)) == 1, 10.0, -10.0)

    ours = cp.cartpole(push, duration=2.0, terminate=True)
    rng = np.random.default_rng(0)
    batch = {
        "x0": rng.uniform(-1, 1, 16),
        "x_dot0": rng.uniform(-0.5, 0.5, 16),
        "theta0": rng.uniform(-0.1, 0.1, 16),
        "theta_dot0": rng.uniform(-0.2, 0.2, 16),
        "masspole": rng.uniform(0.05, 0.5, 16),
        "masscart": rng.uniform(0.5, 2.0, 16),
        "length": rng.uniform(0.3, 1.2, 16),
    }
    with jax.enable_x64():
        batch = {name: jnp.asarray(values) for name, values in batch.items()}
        got = jax.jit(jax.vmap(lambda f: theirs(f, KEY)))(batch)
        wanted = jax.jit(jax.vmap(lambda f: ours(f, KEY)))(batch)
    assert theirs.dt == 0.02
    np.testing.assert_array_equal(got.valid, wanted.valid)
    assert len(set(np.asarray(got.valid).tolist())) > 1
    for name in PARTS:
        np.testing.assert_allclose(got[name], wanted[name], atol=1e-5)


def test_gradient_of_an_environment_that_has_one():
    system = gymnax(
        "Pendulum-v1",
        lambda observation: -observation[2:],
        steps=20,
        features={"gravity": "g"},
        initial={"theta0": "theta", "speed0": "theta_dot"},
    )

    def reached(gravity, theta0):
        features = {"gravity": gravity, "theta0": theta0, "speed0": 0.3}
        return system(features, KEY)["theta"][-1]

    with jax.enable_x64():
        slopes = jax.jit(jax.grad(reached, argnums=(0, 1)))(9.0, 0.4)
        value = jax.jit(reached)
        for i, slope in enumerate(slopes):
            low, high = (value(9.0 + d * (i == 0), 0.4 + d * (i == 1)) for d in (-1e-6, 1e-6))
            assert float(slope) == pytest.approx(float(high - low) / 2e-6, rel=1e-5)


def test_gradient_that_the_environment_stops_is_refused():
    system = gymnax("CartPole-v1", lean, steps=5, initial={"theta0": "theta"})
    with pytest.raises(ValueError, match=r"CartPole-v1: the environment stops gradients between"):
        jax.eval_shape(jax.grad(lambda t: system({"theta0": t}, KEY)["x"][-1]), 0.1)


@pytest.mark.slow
def test_falsified_in_batches():
    problem = vj.Problem(
        "gymnax",
        {"spin": vj.Box(-2.0, 2.0), "masspole": vj.Box(0.05, 0.5)},
        gymnax("CartPole-v1", lean, steps=50, features=["masspole"], initial={"spin": "theta_dot"}),
        "always[0, 1] abs(theta) <= 0.2094",
        nominal={"spin": 0.0, "masspole": 0.1},
    )
    run = vj.falsify(problem, budget=64, search="halton", batch=64)
    assert 0 < len(run.table.counterexamples) < 64
    assert run.replay(run.table.counterexamples.index[0]).trace.length < 51


@pytest.mark.slow
def test_keeps_the_contract_of_systems():
    system = gymnax(
        "CartPole-v1", coin, steps=50, features=["masspole"], initial={"spin": "theta_dot"}
    )
    space = vj.FeatureSpace({"spin": vj.Box(-2.0, 2.0), "masspole": vj.Box(0.05, 0.5)})
    check_system(system, space)
    check_forks(system, space)


def test_time_limit_cuts_only_when_asked():
    params = package.make("CartPole-v1")[1]
    short = params.replace(max_steps_in_episode=5)
    system = gymnax("CartPole-v1", lean, params=short)
    assert system.steps == 5
    assert system.exact_step
    assert not system.can_refine
    assert int(gymnax("CartPole-v1", lean, params=short, steps=9)({}, KEY).valid) == 10
    cut = gymnax("CartPole-v1", lean, params=short, steps=9, truncate=True)
    assert int(cut({}, KEY).valid) == 6


@pytest.mark.slow
def test_signal_feature_sets_a_parameter_as_it_changes():
    system = gymnax(
        "Pendulum-v1",
        lambda observation: jnp.zeros(1),
        duration=0.2,
        features={"g": "g"},
        initial=lambda state, features, key: state.replace(
            theta=jnp.float32(np.pi / 2), theta_dot=jnp.float32(0)
        ),
        signals=lambda state, observation, action, reward, features: {
            "speed": state.theta_dot,
            "g": features["g"],
        },
    )
    trace = system({"g": Waveform(jnp.array([10.0, 0.0, 5.0, 0.0, 0.0]))}, KEY)
    np.testing.assert_allclose(trace["g"], [10, 0, 5, 0, 0], atol=1e-5)
    # theta_dot += 3 g / (2 l) sin(theta) dt
    np.testing.assert_allclose(trace["speed"][:3], [0, 0.75, 0.75], atol=1e-5)


def test_policy_with_memory_and_an_observation_by_names():
    def alternate(observation, memory):
        return memory, 1 - memory

    trace = gymnax("CartPole-v1", alternate, policy_memory=0, steps=5, signals=PARTS)({}, KEY)
    np.testing.assert_array_equal(trace["action"], [0, 1, 0, 1, 0, 1])
    assert sorted(trace.signals) == sorted([*PARTS, "action", "reward"])
    picked = gymnax("CartPole-v1", right, steps=5, signals={"angle": 2})({}, KEY)
    assert sorted(picked.signals) == ["action", "angle", "reward"]


@pytest.mark.parametrize(
    ("name", "policy"),
    [
        ("Acrobot-v1", lambda o: 1),
        ("MountainCarContinuous-v0", lambda o: 0.5),
        ("PointRobot-misc", lambda o: jnp.full(2, 0.1)),
        ("BernoulliBandit-misc", lambda o: 1),
        ("UmbrellaChain-bsuite", lambda o: 1),
        ("Breakout-MinAtar", lambda o: 1),
        ("FrozenLake-misc", lambda o: 1),
    ],
)
def test_environments_whose_state_starts_in_another_type(name, policy):
    trace = jax.eval_shape(gymnax(name, policy, steps=5), {}, KEY)
    assert trace.length == 6
    assert trace["reward"].shape == (6,)


def test_names_that_do_not_exist():
    with pytest.raises(UnknownNameError, match="environment of gymnax 'Cartpole-v1'; did you mean"):
        gymnax("Cartpole-v1", lean)
    message = "unknown parameter of CartPole-v1 'mass_pole'; did you mean 'masspole'"
    with pytest.raises(UnknownNameError, match=message):
        gymnax("CartPole-v1", lean, features={"m": "mass_pole"})
    with pytest.raises(
        UnknownNameError, match="part of CartPole-v1's state 'thetha'; did you mean"
    ):
        gymnax("CartPole-v1", lean, initial={"theta0": "thetha"})
    with pytest.raises(UnknownNameError, match="unknown option of gymnax 'step'; did you mean"):
        gymnax("CartPole-v1", lean, step=4)
    system = gymnax("CartPole-v1", lean, steps=4, features=["masspole"])
    with pytest.raises(UnknownNameError, match="unknown feature 'masspole'; did you mean 'mass'"):
        system({"mass": 0.2}, KEY)
    with pytest.raises(ValueError, match="feature 'mass' changes nothing in CartPole-v1: bind it"):
        system({"masspole": 0.1, "mass": 0.2}, KEY)


@pytest.mark.parametrize(
    ("name", "policy", "options", "message"),
    [
        ("CartPole-v1", lambda o: o, {}, r"one of the 2 actions of CartPole-v1, an integer; got f"),
        ("CartPole-v1", lambda o: 0.5, {}, r"an integer; got 0.5"),
        ("Pendulum-v1", lambda o: o, {}, r"the 1 real number that Pendulum-v1 takes as an action"),
        ("PointRobot-misc", lambda o: 1.0, {}, r"the 2 real numbers that PointRobot-misc takes"),
        ("CartPole-v1", lambda o, m: 0, {"policy_memory": 0}, r"must return \(action, memory\)"),
        ("CartPole-v1", lambda o, m: (0, 0.5), {"policy_memory": 0}, r"in the form of policy_mem"),
        ("CartPole-v1", lean, {"signals": ["x", "v"]}, r"signals has 2 names, x, v, for the entr"),
        ("CartPole-v1", lean, {"signals": {"x": 4}}, r"signal 'x' is entry 4 of an observation of"),
        ("CartPole-v1", lean, {"configure": lambda p, f: None}, r"configure must return the param"),
        ("CartPole-v1", lean, {"initial": lambda s, f, k: 0}, r"initial must return a state of"),
    ],
)
def test_parts_that_do_not_fit_are_refused_while_tracing(name, policy, options, message):
    system = gymnax(name, policy, steps=3, **options)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(system, {}, KEY)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, r"steps must be an integer of at least 1; got 0"),
        ({"steps": 5, "duration": 1.0}, r"either duration or steps; got \(duration=1.0, steps=5\)"),
        ({"duration": 0.03}, r"a positive multiple of dt; got \(duration=0.03, dt=0.02\)"),
        ({"dt": -1.0}, r"dt must be a positive number of seconds; got -1.0"),
        ({"features": {"t": "tau"}}, r"feature 't' cannot set 'tau': all samples of a trace"),
        ({"configure": lambda p: p}, r"configure is called with \(params, features\); got a func"),
        ({"initial": lambda s: s}, r"initial is called with \(state, features, key\); got"),
        ({"signals": lambda s: s}, r"signals is called with \(state, observation, action, rew"),
        ({"signals": "x"}, r"signals must be names of the observation's entries"),
        ({"signals": ["x", "action"]}, r"different names, other than action and reward"),
    ],
)
def test_refuses_options_that_do_not_fit(options, message):
    with pytest.raises(ValueError, match=message):
        gymnax("CartPole-v1", lean, **options)


def test_refuses_policies_and_environments_of_another_kind():
    with pytest.raises(ValueError, match=r"\(observation\) or \(observation, key\); got 3"):
        gymnax("CartPole-v1", 3)
    with pytest.raises(ValueError, match="got one of 3 arguments"):
        gymnax("CartPole-v1", lambda a, b, c: 0)
    three = Policy(new_layers(KEY, (4, 3), 1.0), None, None, None, Discrete(3))
    with pytest.raises(ValueError, match="policy chooses one of 3 actions; CartPole-v1 takes Disc"):
        gymnax("CartPole-v1", three)
    vector = Policy(new_layers(KEY, (4, 2), 1.0), None, None, jnp.zeros(2), Continuous(-1, 1, 2))
    with pytest.raises(ValueError, match="one of the 2 actions"):
        jax.eval_shape(gymnax("CartPole-v1", vector, steps=2), {}, KEY)
    with pytest.raises(ValueError, match="id of an environment or a gymnax Environment; got 5"):
        gymnax(5, lean)
    sticky = StickyActionWrapper(package.make("CartPole-v1")[0], 0.5)
    with pytest.raises(ValueError, match="StickyActionWrapper is a wrapper, whose step resets"):
        gymnax(sticky, lean)


def test_a_missing_or_old_package_is_one_line(monkeypatch):
    real = importlib.import_module

    def missing(name, *arguments):
        if name == "gymnax":
            raise ModuleNotFoundError("No module named 'gymnax'", name="gymnax")
        return real(name, *arguments)

    with monkeypatch.context() as patched:
        patched.setattr(importlib, "import_module", missing)
        with pytest.raises(MissingExtra, match=r"pip install 'verifai_jax\[gymnax\]'$"):
            gymnax("CartPole-v1", lean)
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.0.9")
    with pytest.raises(MissingExtra, match=r"gymnax 0.0.9 is installed, .* needs 1.0.1 or later"):
        gymnax("CartPole-v1", lean)
