"""The hopper: the policy in the loop against a plain MuJoCo loop, and what its problems say."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import verifai_jax as vj
from envs import hopper as h
from envs import train_hopper, training
from specs import hopper as specs
from verifai_jax.addons.rl import Discrete, Training, evaluate, load_policy, policy_notes
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.evaluation.replay import replay

KEY = jax.random.key(0)
PROBLEMS = ("upright", "gusts", "advances")  # that of "familiar" is that of "upright"


def nominal_row(problem):
    features = problem.space.unflatten(problem.space.flatten(problem.nominal))
    rows = problem.space.rows(jax.tree.map(lambda leaf: np.asarray(leaf)[None], features))
    return {name: column[0] for name, column in rows.items()}


def plain_loop(seconds, friction):
    """Positions [time, 6] by MuJoCo's own step, the network written out in NumPy."""
    with np.load(h.POLICY_FILE) as file:
        arrays = dict(file)
    model = mujoco.MjModel.from_xml_path(str(h.MODEL_FILE))
    model.geom("floor").friction[0] = friction
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 1.03, 0, -0.2, 0.4, -0.2]
    seen = [data.qpos.copy()]
    for _ in range(round(seconds / 0.02)):
        x = np.concatenate([data.qpos[1:], np.clip(data.qvel, -10, 10)])
        x = (x - arrays["mean"]) / arrays["scale"]
        for i in range(2):
            x = np.tanh(x @ arrays[f"weight{i}"] + arrays[f"bias{i}"])
        data.ctrl[:] = np.clip(x @ arrays["weight2"] + arrays["bias2"], -1, 1)
        for _ in range(4):
            mujoco.mj_step(model, data)
        seen.append(data.qpos.copy())
    return np.array(seen)


@pytest.fixture(scope="module")
def native():
    return h.hopper("friction", duration=2.0, backend="native")


def test_native_equals_a_plain_mujoco_loop():
    system = h.hopper("friction", duration=0.6, backend="native")
    for friction in (0.9, 0.5):
        with jax.enable_x64():
            trace = system({"friction": np.float64(friction)}, KEY)
        # Contacts make rounding grow: after half a second it is still small.
        expected = plain_loop(0.5, friction)
        for signal, i in (("x", 0), ("height", 1), ("pitch", 2)):
            got = np.asarray(trace[signal])[: len(expected)]
            np.testing.assert_allclose(got, expected[:, i], atol=2e-4)


def test_it_runs_on_both_engines_and_runs_forward(native):
    assert set(native.backends) == {"native", "mjx"}
    trace = native({"friction": np.float32(0.9)}, KEY)
    assert trace["x"].shape == (101,)
    assert int(trace.valid) == 101
    assert 1.0 < float(trace["x"][-1]) < 3.5
    assert float(jnp.min(trace["height"])) > 0.9


def test_it_ends_when_it_lies(native):
    limp = h.hopper(
        "friction", controller=lambda t, s, f: jnp.zeros(3), duration=2.0, backend="native"
    )
    trace = limp({"friction": np.float32(0.9)}, KEY)
    valid = int(trace.valid)
    assert valid < 101
    assert h.lying(State(trace, valid - 1), {})
    assert not h.lying(State(trace, valid - 2), {})


class State:
    """What `lying` looks at, at one sample."""

    def __init__(self, trace, sample):
        self.qpos = jnp.array([trace[name][sample] for name in ("x", "height", "pitch")])


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_an_ordinary_day_is_safe(name):
    problem = getattr(specs, name).on_backend("native")
    problem.check()
    seen = replay(problem, nominal_row(problem), KEY)
    assert min(seen.rho.values()) > 0.05


@pytest.mark.slow
def test_a_few_samples_find_a_failure():
    problem = specs.upright.on_backend("native")
    run = vj.falsify(problem, "uniform", 64, batch=64, seed=0)
    failing = run.table.all["rho"] < 0
    assert 1 <= failing.sum() <= 24
    worst = run.replay(run.best)
    assert worst.violated
    assert float(worst.trace["height"][-1]) < 0.8 or abs(float(worst.trace["pitch"][-1])) > 0.8


def test_the_policy_knows_how_it_was_trained():
    notes = policy_notes(h.POLICY_FILE)
    assert (notes["task"], notes["algorithm"]) == ("hopper", "PPO")
    assert notes["mean_return"] >= train_hopper.SOLVED
    policy = load_policy(h.POLICY_FILE)
    assert policy.layers[0][0].shape == (11, 32)
    with pytest.raises(ValueError, match=r"sees 11 numbers and has 3 actions .* got 11 and"):
        h.neural(replace(policy, action=Discrete(3)))


def test_unknown_features_are_named():
    with pytest.raises(UnknownNameError, match="'frictoin'; did you mean 'friction'"):
        h.hopper("frictoin")


def test_the_task_starts_as_it_says():
    task = h.HopperTask()
    states = jax.tree.map(np.asarray, jax.jit(jax.vmap(task.reset))(jax.random.split(KEY, 500)))
    assert np.ptp(states.qpos[:, 3]) == pytest.approx(0.1, rel=0.05)
    np.testing.assert_allclose(states.qpos.mean(axis=0), h.STANCE, atol=0.01)
    for i, (least, most) in enumerate(h.TRAINED_FOR.values()):
        assert least <= states.body[:, i].min() < states.body[:, i].max() <= most
    seen = task.observe(jax.tree.map(lambda leaf: leaf[0], states))
    np.testing.assert_array_equal(seen[:5], states.qpos[0, 1:])


@pytest.mark.proves
def test_the_policy_earns_in_mjx_what_its_notes_say():
    returns = evaluate(h.HopperTask(), load_policy(h.POLICY_FILE), seed=11, episodes=128)
    assert returns.mean() == pytest.approx(policy_notes(h.POLICY_FILE)["mean_return"], rel=0.08)


@pytest.mark.slow
def test_the_engines_agree_until_contacts_make_them_part(native):
    features = {"friction": np.float32(0.9)}
    c, x = native(features, KEY), jax.jit(native.with_backend("mjx"))(features, KEY)
    for name in ("x", "height", "pitch"):
        np.testing.assert_allclose(x[name][:13], c[name][:13], atol=2e-3)
    assert float(x["x"][-1]) == pytest.approx(float(c["x"][-1]), rel=0.2)


@pytest.mark.parametrize(("earned", "status"), [(499.0, 1), (501.0, 0)])
def test_a_policy_that_did_not_learn_is_not_written(earned, status, tmp_path, capsys, monkeypatch):
    policy, out = load_policy(h.POLICY_FILE), tmp_path / "policy.npz"
    trained = Training(policy, np.array([8192]), np.array([np.nan]))
    monkeypatch.setattr(training, "train", lambda *task, **options: trained)
    monkeypatch.setattr(training, "evaluate", lambda *task, **options: np.full(256, earned))
    assert train_hopper.TRAINING.main(None, ["--seed", "5", "--out", str(out)]) == status
    assert ("nothing written" in capsys.readouterr().out) == (status == 1)
    assert out.exists() == (status == 0)
    if status == 0:
        assert policy_notes(out) == {
            "task": "hopper",
            "algorithm": "PPO",
            "seed": 5,
            "steps": 8192,
            "mean_return": earned,
        }


@pytest.mark.slow
def test_a_row_is_the_same_simulation_in_any_batch():
    """Falls differ visibly by the last digit of a network's output."""
    problem = specs.upright.on_backend("native")
    u = np.random.default_rng(0).random((130, problem.space.dim), np.float32)
    features = jax.tree.map(np.asarray, jax.jit(jax.vmap(problem.space.unflatten))(u))
    keys = jax.random.split(KEY, 130)
    whole = problem.system.simulate_batch(features, keys)
    for count in (1, 5):
        few = jax.tree.map(lambda leaf, count=count: leaf[:count], features)
        trace = problem.system.simulate_batch(few, keys[:count])
        np.testing.assert_array_equal(trace["pitch"], whole["pitch"][:count])


@pytest.mark.slow
def test_replays_are_exact():
    run = vj.falsify(specs.upright, "uniform", 70, batch=64, run_on=vj.RunOn(backend="native"))
    for row in (int(run.best.name), 69):
        assert run.replay(row).rho["spec"] == pytest.approx(run.table.all["rho"][row], abs=1e-6)
