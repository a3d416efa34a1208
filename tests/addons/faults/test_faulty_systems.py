"""Faults in the loop of every kind of system: off they change no bit, on they change the run."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons import faults
from verifai_jax.addons.simulators.remote_client import serve
from verifai_jax.core.messages.errors import UnknownNameError

KEY = jax.random.key(3)
NO_KINDS = ("AtMost", "Fault", "Scale", "on_host")
KINDS = [getattr(faults, name) for name in faults.__all__ if name not in NO_KINDS]
WINDOW = {"onset": vj.Box(0, 0.2), "duration": vj.Box(0, 5)}
OPTIONS = {
    "Delay": {"seconds": vj.Box(0, 0.2)}, "Bias": {"offset": vj.Box(-1, 1)},
    "Drift": {"rate": vj.Box(0, 1)}, "Noise": {"std": vj.Box(0, 1)},
    "Spikes": {"height": vj.Box(0, 1), "rate": 20.0}, "Quantisation": {"step": vj.Box(0, 1)},
    "Saturation": {"limit": vj.Box(0.1, 1e6)}, "Stuck": {"value": 1.0},
    "LossOfAuthority": {"loss": vj.Box(0, 1)}, "HeldAction": {"hold": vj.Box(0, 0.2)},
    "PacketLoss": {"loss": vj.Box(0, 1)}, "ClockJitter": {"jitter": vj.Box(0, 0.2)},
    "DeadBand": {"width": vj.Box(0, 1)}, "Backlash": {"gap": vj.Box(0, 1)},
    "RateLimit": {"rate": vj.Box(1e-3, 1e6)}, "Gain": {"factor": vj.Box(1, 3)},
}  # fmt: skip


def all_kinds(channel, source=None, choices=False):
    made = []
    for kind in KINDS:
        if (choices and not kind.choices) or (kind is faults.WrongChannel and source is None):
            continue
        own = {"source": source} if kind is faults.WrongChannel else OPTIONS.get(kind.__name__, {})
        made.append(kind(channel, **own, **WINDOW))
    return made


def numbers(fault):
    """A fault at its severest from 0.04 s on."""
    worst = {"onset": 0.04, "duration": 5.0}
    if fault.severity != "duration":
        domain = fault.domains[fault.severity]
        worst[fault.severity] = domain.low if fault.off == np.inf else domain.high
    return worst


def check(problem, made, simulate, **features):
    """All faults off are no fault, bit for bit; each of them on is one."""
    faulty = problem.with_faults(*made)
    base = simulate(problem.system)(problem.space.coerce(features), KEY)
    run = simulate(faulty.system)
    off = run(faulty.space.coerce(features), KEY)
    for name in base.signals:
        assert np.asarray(off[name]).tobytes() == np.asarray(base[name]).tobytes()
    ineffective = []
    for fault in made:
        on = run(faulty.space.coerce({**features, fault.name: numbers(fault)}), KEY)
        same = all(np.array_equal(on[name], base[name]) for name in base.signals)
        ineffective += [type(fault).__name__] * same
    return ineffective


def on_host(system):
    return lambda features, key: system(jax.tree.map(np.asarray, features), key)


@pytest.mark.slow
def test_gymnasium_observations_and_choices():
    def policy(observation):
        return int(observation[2] + 0.3 * observation[3] > 0)

    signals = ["x", "x_dot", "theta", "theta_dot"]
    problem = vj.Problem(
        "cart",
        {"length": vj.Box(0.4, 0.6)},
        vj.gymnasium("CartPole-v1", policy, steps=40, signals=signals, features=["length"]),
        "always abs(theta) <= 0.2",
    )
    # The pole never leans by the least limit: that fault has nothing to change.
    assert check(problem, all_kinds("theta", "theta_dot"), on_host, length=0.5) == ["Saturation"]
    made = all_kinds("action", choices=True)
    assert check(problem, made, on_host, length=0.5) == []
    with pytest.raises(UnknownNameError, match="unknown channel 'thetta'; did you mean 'theta'"):
        problem.with_faults(faults.Bias("thetta", offset=1.0))
    with pytest.raises(ValueError, match="has whole numbers, such as choices, which Bias cannot"):
        problem.with_faults(faults.Bias("action", offset=1.0))
    with pytest.raises(ValueError, match=r"channel 'observation' has 4 entries; got 'observation"):
        problem.with_faults(faults.Bias("observation[4]", offset=1.0))


@pytest.mark.slow
def test_gymnasium_continuous_actions():
    system = vj.gymnasium(
        "Pendulum-v1", lambda o: -2.0 * o[1:2] - 0.5 * o[2:], steps=30, features={"m": "m"}
    )
    problem = vj.Problem("pendulum", {"m": vj.Box(0.9, 1.1)}, system, "always abs(action) <= 3")
    assert check(problem, all_kinds("action"), on_host, m=1.0) == []
    run = vj.falsify(
        problem.with_faults(faults.Bias("action", offset=vj.Box(0, 2))), "uniform", 8,
        progress=False,
    )  # fmt: skip
    assert "action_bias.offset" in run.table.all
    assert len(run.table.all) == 8


@pytest.mark.slow
def test_gymnax():
    pytest.importorskip("gymnax")
    system = vj.gymnax(
        "Pendulum-v1", lambda o: -2.0 * o[1:2] - 0.5 * o[2:], steps=30, features={"m": "m"}
    )
    problem = vj.Problem("pendulum", {"m": vj.Box(0.9, 1.1)}, system, "always abs(action) <= 3")
    made = [*all_kinds("observation[2]", "observation[1]"), faults.Bias("action", offset=0.0)]
    assert check(problem, made[:-1], jax.jit, m=1.0) == []


@pytest.mark.slow
def test_brax():
    pytest.importorskip("brax")
    system = vj.brax(
        "fast", lambda observation: jnp.tanh(observation[:1]), steps=20,
        configure=lambda sys, features: sys, dt=0.02,
    )  # fmt: skip
    problem = vj.Problem("fast", {"gain": vj.Box(0, 1)}, system, "always reward <= 1e9")
    made = all_kinds("action")
    assert set(check(problem, made, jax.jit, gain=0.5)) <= {type(f).__name__ for f in made}


MUJOCO = """
<mujoco><option timestep="0.01"/><worldbody><body name="pole"><joint name="hinge" type="hinge"
axis="0 1 0"/><geom name="pole" type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0.2"
contype="0" conaffinity="0"/><site name="tip" pos="0 0 0.5"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator>
<sensor><gyro name="gyro" site="tip"/><jointpos name="angle" joint="hinge"/></sensor></mujoco>
"""


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["mjx", "native"])
def test_mujoco(backend):
    def controller(time, state, features):
        return jnp.clip(-4.0 * state.sensordata[3:] - 0.3 * state.sensordata[1:2], -2, 2)

    system = vj.mujoco(
        MUJOCO, duration=0.6, control_period=0.02, controller=controller, backend=backend,
        bind={"start": "joint/hinge/qpos"},
        signals={"angle": "joint/hinge/qpos", "u": "actuator/motor/ctrl"},
    )  # fmt: skip
    problem = vj.Problem("pole", {"start": vj.Box(-0.3, 0.3)}, system, "always abs(angle) <= 1")

    def simulate(system):
        if backend == "mjx":
            return jax.jit(system)

        def one(features, key):
            batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], features)
            trace = system.simulate_batch(batch, key[None])
            return jax.tree.map(lambda leaf: leaf[0], trace)

        return one

    made = [*all_kinds("angle", "gyro[1]"), *all_kinds("motor")]
    assert check(problem, made, simulate, start=0.2) == []
    with pytest.raises(UnknownNameError, match="did you mean 'gyro'"):
        problem.with_faults(faults.Dropout("gyros"))


def simulate_here(features, seed):
    """A simulator of one's own, which puts the faults into its loop itself."""
    loop = faults.on_host(REMOTE, features, seed, period=0.1)
    x, course = features["x0"], []
    for k in range(20):
        course.append(x)
        seen = loop.observation(0.1 * k, {"x": x})["x"]
        x = x + 0.1 * loop.action(0.1 * k, np.float64(-seen))
    return {"x": np.array(course), "dt": 0.1}


REMOTE = [
    faults.Bias("observation.x", offset=vj.Box(0, 1), onset=vj.Box(0, 1)),
    faults.Noise("action", std=vj.Box(0, 0.5)),
]


@pytest.mark.slow
def test_remote_simulators_get_the_numbers_by_message():
    with vj.remote(timeout=20.0, patience=20.0) as system:
        problem = vj.Problem("far", {"x0": vj.Box(0, 1)}, system, "always x >= -2", nominal=None)
        with pytest.raises(ValueError, match="by_simulator=True"):
            problem.with_faults(*REMOTE)
        faulty = problem.with_faults(*REMOTE, by_simulator=True)
        host, port = system.address
        client = threading.Thread(
            target=serve, args=(simulate_here,), kwargs={"host": host, "port": port}, daemon=True
        )
        client.start()

        def course(**features):
            return np.asarray(system(faulty.space.coerce(features), KEY)["x"])

        healthy = course(x0=1.0)
        np.testing.assert_allclose(healthy, 0.9 ** np.arange(20), rtol=1e-6)
        biased = course(x0=1.0, observation_x_bias={"offset": 1.0, "onset": 0.5})
        np.testing.assert_array_equal(biased[:6], healthy[:6])
        np.testing.assert_allclose(biased[6], biased[5] - 0.1 * (biased[5] + 1.0), rtol=1e-6)
        noisy = course(x0=1.0, action_noise={"std": 0.5})
        assert 0.01 < np.std(noisy[1:] - 0.9 * noisy[:-1]) < 0.1
    client.join(10)


def test_what_has_no_loop_says_so():
    plant = vj.ode(
        lambda time, state, control, features: {"x": -state["x"]},
        lambda features, key: {"x": features["x0"]}, dt=0.1, steps=5,
    )  # fmt: skip
    problem = vj.Problem("plant", {"x0": vj.Box(0, 1)}, plant, "always x >= 0")
    with pytest.raises(ValueError, match="this system has no controller"):
        problem.with_faults(faults.Dropout("x"))
    black = vj.Problem("b", {"x0": vj.Box(0, 1)}, vj.blackbox(lambda f: None), "always x >= 0")
    with pytest.raises(ValueError, match="has no loop with known observations and actions"):
        black.with_faults(faults.Dropout("x"))
