import importlib
import importlib.metadata
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.rl import Discrete, Policy
from verifai_jax.addons.rl.policy import new_layers
from verifai_jax.addons.simulators.environments.episode import episode_keys
from verifai_jax.core.messages.errors import MissingExtra, UnknownNameError
from verifai_jax.core.values.trace import Status
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.testing import check_forks, check_system

pytest.importorskip("brax")

with warnings.catch_warnings():
    # Brax imports a package that says it is no longer maintained.
    warnings.simplefilter("ignore", DeprecationWarning)
    from brax import base
    from brax.envs.base import Env, State
    from brax.envs.wrappers.training import AutoResetWrapper, EpisodeWrapper
from flax import struct

from verifai_jax.addons.simulators.environments._brax import brax

KEY = jax.random.key(3)


@struct.dataclass
class Machine(base.Base):
    """What a Brax system looks like to an adapter."""

    mass: jax.Array
    drag: jax.Array
    color: jax.Array
    name: str = struct.field(pytree_node=False, default="slide")

    def q_size(self):
        return 1

    def qd_size(self):
        return 1


class Slide(Env):
    """A weight on a rail that is pushed; over where the rail ends, at 1 m."""

    dt = np.float32(0.1)
    observation_size = 2
    action_size = 1
    backend = "none"

    def __init__(self):
        self.sys = Machine(jnp.array([2.0, 7.0]), jnp.array(0.5), jnp.zeros(3))

    def pipeline_init(self, q, qd):
        return base.State(q=q, qd=qd, x=None, xd=None, contact=None)

    def reset(self, rng):
        q, qd = 0.2 * jax.random.normal(rng, (2, 1))
        return self.shown(self.pipeline_init(q, qd), 0.0)

    def step(self, state, action):
        physics = state.pipeline_state
        rate = (action - self.sys.drag * physics.qd) / self.sys.mass[:1]
        qd = physics.qd + self.dt * rate
        return self.shown(physics.replace(q=physics.q + self.dt * qd, qd=qd), -(action[0] ** 2))

    def shown(self, physics, reward):
        done = jnp.where(jnp.abs(physics.q[0]) > 1, 1.0, 0.0)
        seen = jnp.concatenate([physics.q, physics.qd])
        return State(physics, seen, jnp.float32(reward), done, {"energy": physics.qd[0] ** 2})


class Bare(Env):
    """An environment with nothing but what it must have; its observation is a dictionary."""

    observation_size, action_size, backend = 2, 2, "none"

    def __init__(self, gain=1.0):
        self.gain = gain

    def reset(self, rng):
        at = {"place": jnp.zeros(2), "clock": jnp.zeros(1)}
        return State(None, at, jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        seen = {
            "place": state.obs["place"] + self.gain * action,
            "clock": state.obs["clock"] + 1,
        }
        return state.replace(obs=seen)


def push(observation):
    return jnp.array([1.5])


def jitter(observation, key):
    return -observation[:1] + jax.random.normal(key, (1,))


@pytest.mark.thorough
@pytest.mark.parametrize("policy", [push, jitter])
def test_equal_to_the_environment_stepped_by_hand(policy):
    env, keys = Slide(), episode_keys(KEY)
    state, rows = env.reset(keys.start), []
    for k in range(31):
        action = (
            policy(state.obs)
            if policy is push
            else jitter(state.obs, jax.random.fold_in(keys.decide, k))
        )
        rows.append([*state.obs, state.reward, action[0], state.metrics["energy"]])
        if state.done:
            break
        state = env.step(state, action)
    trace = brax(env, policy, steps=30)({}, KEY)
    assert int(trace.valid) == len(rows)
    assert (len(rows) < 31) == (policy is push)
    assert trace.dt == 0.1
    kept = trace.trim()
    got = [*kept["observation"].T, kept["reward"], kept["action"], kept["energy"]]
    np.testing.assert_allclose(np.stack(got, axis=1), rows, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(kept["q"], kept["observation"][:, 0])


@pytest.mark.thorough
def test_an_environment_that_is_done_is_not_reset_in_the_trace():
    trace = brax(Slide(), push, steps=40, signals=["x", "v"])({}, KEY)
    end = int(trace.valid)
    assert 10 < end < 30
    assert trace.held
    assert sorted(trace.signals) == ["action", "reward", "v", "x"]
    for name in trace.signals:
        np.testing.assert_array_equal(trace[name][end:], trace[name][end - 1])
    assert float(trace["x"][-1]) > 1
    assert int(trace.status) == Status.OK


@pytest.fixture(scope="module")
def changed():
    """A system whose features set parts of the machine and of where it starts."""
    return brax(
        Slide(),
        push,
        duration=0.5,
        features={"mass": "mass[0]", "drag": "drag"},
        initial={"x0": "q[0]", "v0": "qd[0]"},
        signals=["x", "v"],
    )


def test_features_of_each_lane_set_parts_of_the_system(changed):
    mass, drag = jnp.array([1.0, 2.0, 4.0]), jnp.array([0.0, 0.5, 1.0])
    x0, v0 = jnp.array([0.0, 0.1, -0.2]), jnp.array([0.3, 0.0, 0.1])
    batch = {"mass": mass, "drag": drag, "x0": x0, "v0": v0}
    traces = jax.jit(jax.vmap(changed))(batch, jax.random.split(KEY, 3))
    x, v = np.array(x0), np.array(v0)
    for k in range(6):
        np.testing.assert_allclose(traces["x"][:, k], x, atol=1e-6)
        np.testing.assert_allclose(traces["v"][:, k], v, atol=1e-6)
        v = v + 0.1 * (1.5 - drag * v) / mass
        x = x + 0.1 * v


def test_gradients_are_finite_differences(changed):
    def reached(mass, drag, x0):
        return changed({"mass": mass, "drag": drag, "x0": x0, "v0": 0.2}, KEY)["x"][-1]

    with jax.enable_x64():
        at = np.array([2.0, 0.5, 0.1])
        slope = jax.jit(jax.grad(reached, argnums=(0, 1, 2)))(*at)
        value = jax.jit(jax.vmap(reached))
        steps = np.concatenate([np.eye(3), -np.eye(3)]) * 1e-6
        ends = np.asarray(value(*(at + steps).T))
    np.testing.assert_allclose(slope, (ends[:3] - ends[3:]) / 2e-6, rtol=1e-3, atol=1e-4)
    assert abs(float(slope[0])) > 1e-2


@pytest.mark.thorough
def test_falsified_in_batches(changed):
    problem = vj.Problem(
        "slide",
        {
            "mass": vj.Box(0.5, 4.0),
            "drag": vj.Box(0.0, 1.0),
            "x0": vj.Box(-0.5, 0.5),
            "v0": vj.Box(-0.5, 0.5),
        },
        changed,
        "always[0, 0.5] x <= 0.6",
        nominal={"mass": 2.0, "drag": 0.5, "x0": 0.0, "v0": 0.0},
    )
    run = vj.falsify(problem, "halton", 64, batch=64, progress=False)
    assert 0 < len(run.table.counterexamples) < 64


@pytest.mark.slow
def test_keeps_the_contract_of_systems():
    system = brax(Slide(), jitter, steps=30, features={"mass": "mass[0]", "drag": "drag"})
    space = vj.FeatureSpace({"mass": vj.Box(1.0, 4.0), "drag": vj.Box(0.0, 1.0)})
    check_system(system, space)
    check_forks(system, space)


def test_signal_feature_changes_the_system_as_time_goes_by():
    system = brax(
        Slide(),
        lambda o: jnp.zeros(1),
        steps=4,
        configure=lambda sys, f: sys.tree_replace({"drag": -f["wind"]}),
        initial=lambda env, f, key: env.shown(env.pipeline_init(jnp.zeros(1), jnp.ones(1)), 0.0),
    )
    trace = system({"wind": Waveform(jnp.array([2.0, 0.0]), hold="constant")}, KEY)
    np.testing.assert_allclose(trace["qd"], [1, 1.1, 1.21, 1.21, 1.21], rtol=1e-5)


def test_an_environment_of_ones_own_without_sys():
    system = brax(
        Bare(),
        lambda seen, count: (jnp.array([1.0, -1.0]), count + 1),
        policy_memory=0,
        steps=3,
        dt=0.5,
        configure=lambda env, f: Bare(f["gain"]),
        signals={"place": "place", "clock": "clock"},
    )
    trace = jax.jit(system)({"gain": 2.0}, KEY)
    np.testing.assert_allclose(trace["place"], [[0, 0], [2, -2], [4, -4], [6, -6]])
    np.testing.assert_allclose(trace["clock"], [0, 1, 2, 3])
    assert trace["action"].shape == (4, 2)
    with pytest.raises(ValueError, match=r"Bare has no sys whose parts features could set: use"):
        brax(Bare(), push, steps=3, dt=0.5, features=["gain"])
    with pytest.raises(ValueError, match=r"Bare has no pipeline_init: initial must be a function"):
        brax(Bare(), push, steps=3, dt=0.5, initial={"x": "q[0]"})
    with pytest.raises(ValueError, match=r"Bare has no dt: give dt="):
        brax(Bare(), push, steps=3)
    unknown = brax(Bare(), lambda o: jnp.ones(2), steps=3, dt=0.5, signals={"x": "plaice"})
    with pytest.raises(UnknownNameError, match="Bare's observation 'plaice'; did you mean 'place'"):
        jax.eval_shape(unknown, {}, KEY)


def test_wrappers_that_reset_are_refused():
    with pytest.raises(ValueError, match=r"AutoResetWrapper is for training: one episode that is"):
        brax(AutoResetWrapper(EpisodeWrapper(Slide(), 10, 1)), push, steps=5)
    with pytest.raises(ValueError, match="EpisodeWrapper is for training"):
        brax(EpisodeWrapper(Slide(), 10, 1), push, steps=5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"features": {"m": "mas"}}, r"unknown part of the system of Slide 'mas'; did you mean 'm"),
        ({"features": {"m": "mass[2]"}}, r"mass of Slide has 2 entries; got the number 2"),
        ({"features": {"m": "mass[left]"}}, r"unknown entry of mass of Slide 'left'. Known: 0, 1"),
        ({"features": {"m": "drag[0]"}}, r"drag of Slide is one number and has no entry '0'"),
        ({"features": {"m": "name"}}, r"name of Slide holds no real numbers that a feature could"),
        (
            {"features": {"m": "color[1]"}},
            r"'m' sets color\[1\], which Slide on the backend 'none'",
        ),
        ({"initial": {"x": "p[0]"}}, r"unknown part of Slide's initial state 'p\[0\]'; did you me"),
        ({"initial": {"x": "q[1]"}}, r"q of Slide has 1 entries; got the number 1"),
        (
            {"backend": "mjx"},
            r"backend and options need the name of an environment; got the object Slide",
        ),
        ({"duration": 0.25}, r"either duration or steps"),
        ({"steps": None}, r"give steps or duration; got neither"),
        ({"policy": 3}, r"policy must be a function of \(observation\) or \(observation, key\)"),
        ({"env": 3}, r"env must be the name of an environment or a brax Env; got 3, which has no"),
    ],
)
def test_refuses_options_that_do_not_fit(options, message):
    chosen = {"env": Slide(), "policy": push, "steps": 5, **options}
    with pytest.raises(ValueError, match=message):
        brax(**chosen)


@pytest.mark.parametrize(
    ("options", "features", "message"),
    [
        (
            {"policy": lambda o: o},
            {},
            r"the 1 real number that Slide takes as an action, shape \[1",
        ),
        ({"policy": lambda o: 1}, {}, None),
        ({"signals": ["x"]}, {}, r"signals has 1 names, x, for the entries of an observation of S"),
        (
            {"features": {"m": "mass"}},
            {"m": 1.0},
            r"'m' has shape \[\] and mass has \[2\]; name one",
        ),
        ({"features": {"m": "drag"}}, {"n": 1.0}, r"unknown feature 'm'. Known: n."),
        ({}, {"m": 1.0}, r"feature 'm' changes nothing in Slide: bind it by features="),
        (
            {"configure": lambda s, f: 0},
            {},
            r"configure must return the sys of Slide, a Machine; g",
        ),
        ({"initial": lambda e, f, k: 0}, {}, r"reset, step and initial must return a brax State"),
    ],
)
def test_parts_that_do_not_fit_are_refused_while_tracing(options, features, message):
    system = brax(**{"env": Slide(), "policy": push, "steps": 3, **options})
    if message is None:
        assert jax.eval_shape(system, features, KEY)["action"].shape == (4,)
        return
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(system, features, KEY)


def test_policy_of_another_kind_is_refused():
    policy = Policy(new_layers(KEY, (2, 3), 1.0), None, None, None, Discrete(3))
    with pytest.raises(ValueError, match=r"the 1 real number that Slide takes .* got int32\[\]"):
        jax.eval_shape(brax(Slide(), policy, steps=3), {}, KEY)


def test_the_step_belongs_to_the_environment_unless_it_is_said_not_to():
    system = brax(Slide(), lambda observation: 0.0, steps=3)
    assert system.exact_step
    assert not system.can_refine
    with pytest.raises(ValueError, match=r"the step belongs to Slide .* give exact_step=False"):
        system.refined(2)
    assert brax(Slide(), lambda observation: 0.0, steps=3, exact_step=False).can_refine


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"features": {"g": "gravity[2]"}}])
def test_one_program_replays_at_every_step(options):
    pole = brax(
        "inverted_pendulum", lambda observation: 0.1, steps=8, backend="generalized",
        exact_step=False, initial={"angle": "q[1]"}, signals={"x": 0, "angle": 1}, **options,
    )  # fmt: skip
    assert pole.traced_factor
    assert not brax(Slide(), push, steps=3, exact_step=False).traced_factor
    features = {"angle": jnp.float32(0.1)} | ({"g": jnp.float32(-3.0)} if options else {})
    any_step = jax.jit(lambda factor: pole.refined(factor)(features, KEY).signals)
    found = []
    for factor in (1, 4):
        finer = pole.refined(factor)
        expected = jax.jit(lambda finer=finer: finer(features, KEY).signals)()
        found.append(any_step(jnp.int32(factor)))
        for name in ("x", "angle"):
            np.testing.assert_allclose(found[-1][name], expected[name], rtol=1e-5, atol=1e-6)
    assert np.abs(found[0]["x"] - found[1]["x"]).max() > 1e-5


@pytest.mark.thorough
def test_an_error_within_brax_names_the_versions():
    class Broken(Slide):
        def step(self, state, action):
            raise TypeError("dot_general requires contracting dimensions to have the same shape")

    message = r"Broken on the backend 'none' does not work with brax .*, mujoco .*, jax .*: its ste"
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(brax(Broken(), push, steps=3), {}, KEY)
    with pytest.raises(ValueError, match=r"swimmer on the backend 'mjx' does not work with brax"):
        brax("swimmer", push, steps=3, backend="mjx")


@pytest.mark.slow
def test_names_in_the_environments_of_brax():
    with pytest.raises(UnknownNameError, match="environment of brax 'hoper'; did you mean 'hopper"):
        brax("hoper", push, steps=3)
    with pytest.raises(UnknownNameError, match="unknown backend 'springs'; did you mean 'spring'"):
        brax("inverted_pendulum", push, steps=3, backend="springs")
    with pytest.raises(UnknownNameError, match="unknown option of brax 'step'"):
        brax("inverted_pendulum", push, step=3)

    def pendulum(backend, path):
        return brax("inverted_pendulum", push, steps=3, backend=backend, features={"m": path})

    assert str(pendulum("spring", "link.inertia.mass[pole]").features["m"]) == (
        "link.inertia.mass[1]"
    )
    with pytest.raises(
        UnknownNameError, match=r"mass of inverted_pendulum 'pol'; did you mean 'po"
    ):
        pendulum("spring", "link.inertia.mass[pol]")
    with pytest.raises(UnknownNameError, match=r"'link.inertia.mas'; did you mean 'link.inertia.m"):
        pendulum("spring", "link.inertia.mas")
    # MuJoCo's own array of masses: right for mjx, and nothing that the spring pipeline looks at.
    with pytest.raises(
        ValueError, match=r"sets body_mass\[2\], .* 'spring' does not read. The mjx"
    ):
        pendulum("spring", "body_mass[pole]")
    start = brax("inverted_pendulum", push, steps=3, initial={"a": "q[hinge]"}).initial
    assert {name: str(place) for name, place in start.items()} == {"a": "q[1]"}


@pytest.mark.slow
def test_friction_of_a_geom_and_gear_of_an_actuator():
    def hop(**features):
        return brax("hopper", lambda o: jnp.zeros(3), steps=3, backend="mjx", features=features)

    places = hop(rough="geom_friction[floor, 0]", gear="actuator_gear[1, 0]").features
    assert [str(place) for place in places.values()] == [
        "geom_friction[0, 0]",
        "actuator_gear[1, 0]",
    ]
    # The advice must not be what was given.
    with pytest.raises(ValueError, match=r"name one entry, as in 'geom_friction\[0, 0\]'"):
        jax.eval_shape(hop(rough="geom_friction[floor]"), {"rough": 1.0}, KEY)
    with pytest.raises(ValueError, match=r"has shape \[5, 3\], and \[floor, 0, 0\] names 3 ind"):
        hop(rough="geom_friction[floor, 0, 0]")
    with pytest.raises(ValueError, match="geom_friction of hopper has 3 entries; got the number 3"):
        hop(rough="geom_friction[floor, 3]")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("backend", "path"), [("spring", "link.inertia.mass[pole]"), ("mjx", "body_mass[pole]")]
)
def test_pendulum_is_that_of_brax_stepped_by_hand(backend, path):
    def balance(observation):
        return -3 * observation[1:2] - observation[3:4]

    system = brax(
        "inverted_pendulum",
        balance,
        steps=20,
        backend=backend,
        features={"mass": path},
        initial={"angle": "q[hinge]"},
    )
    trace = jax.jit(jax.vmap(lambda m: system({"mass": m, "angle": 0.05}, KEY)))(
        jnp.array([3.0, 9.0])
    )
    env = system.env
    field = path.split("[")[0]
    index = 2 if backend == "mjx" else 1
    old = np.asarray(env.sys.body_mass if backend == "mjx" else env.sys.link.inertia.mass)

    def under(machine, function):
        kept, env.sys = env.sys, machine
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)
                return function()
        finally:
            env.sys = kept

    @jax.jit
    def begin(machine):
        drawn = under(machine, lambda: env.reset(episode_keys(KEY).start)).pipeline_state
        return under(machine, lambda: env.pipeline_init(drawn.q.at[1].set(0.05), drawn.qd))

    step = jax.jit(lambda machine, *given: under(machine, lambda: env.step(*given)))
    for lane, mass in enumerate((3.0, 9.0)):
        machine = env.sys.tree_replace({field: jnp.asarray(old).at[index].set(mass)})
        physics = begin(machine)
        state = State(
            physics,
            jnp.concatenate([physics.q, physics.qd]),
            jnp.zeros(()),
            jnp.zeros(()),
            {},
            {"time_out": jnp.zeros(())},
        )
        for k in range(int(trace.valid[lane])):
            np.testing.assert_allclose(trace["observation"][lane, k], state.obs, atol=2e-4)
            state = step(machine, state, balance(state.obs))


@pytest.mark.parametrize(("backend", "effort"), [("generalized", "little"), ("spring", "most")])
def test_the_generalized_backend_is_compiled_with_less_effort(backend, effort):
    assert brax("inverted_pendulum", push, steps=3, backend=backend).effort == effort


def test_a_missing_or_old_package_is_one_line(monkeypatch):
    real = importlib.import_module

    def missing(name, *arguments):
        if name == "brax":
            raise ModuleNotFoundError("No module named 'brax'", name="brax")
        return real(name, *arguments)

    with monkeypatch.context() as patched:
        patched.setattr(importlib, "import_module", missing)
        with pytest.raises(MissingExtra, match=r"pip install 'verifai_jax\[brax\]'$"):
            brax("hopper", push, steps=3)
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.9.1")
    with pytest.raises(MissingExtra, match=r"brax 0.9.1 is installed, .* needs 0.14 or later"):
        brax("hopper", push, steps=3)


@pytest.mark.parametrize("backend", ["spring", None])
def test_made_while_the_weights_of_its_policy_are_traced(backend):
    name = "inverted_pendulum"
    env = name if backend else brax(name, push, steps=1, backend="spring").env

    def last(weights):
        system = brax(env, lambda seen: seen @ weights, steps=2, backend=backend, signals={"x": 0})
        return system({}, KEY)["x"][-1]

    assert jax.eval_shape(last, jnp.ones((4, 1))).shape == ()
