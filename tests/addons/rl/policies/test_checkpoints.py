"""Every tensor of a checkpoint is used or named, against forward passes in NumPy."""

import base64
import itertools
import json
import pickle
import struct
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file

from verifai_jax.addons.rl.policies import PolicyError, policy
from verifai_jax.core.messages.errors import UnknownNameError

FILES = Path(__file__).parent / "files"
RNG = np.random.default_rng(0)
OBSERVATION = np.array([3.0, -1.0, 40.0, 0.5], np.float32)


def actor(prefix="actor", sizes=(4, 8, 2), step=2):
    layers = {}
    for i, (n, m) in enumerate(itertools.pairwise(sizes)):
        layers[f"{prefix}.{step * i}.weight"] = RNG.normal(size=(m, n)).astype(np.float32)
        layers[f"{prefix}.{step * i}.bias"] = RNG.normal(size=m).astype(np.float32)
    return layers


def forward(tensors, names, x):
    for name in names:
        x = tensors[f"{name}.weight"] @ x + tensors[f"{name}.bias"]
        x = x if name == names[-1] else np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
    return x


def saved(tmp_path, tensors):
    save_file({n: np.ascontiguousarray(a) for n, a in tensors.items()}, tmp_path / "a.safetensors")
    return tmp_path / "a.safetensors"


MEAN, VAR = np.float32([1, -2, 30, 0]), np.float32([4, 1, 100, 0.25])
COUNT = {"count": np.array(5)}
TRAINERS = {
    "rsl_rl": (
        {"_mean": MEAN[None], "_var": VAR[None], "_std": np.sqrt(VAR)[None], **COUNT},
        "actor_obs_normalizer",
        (OBSERVATION - MEAN) / (np.sqrt(VAR) + 1e-2),
    ),
    "rsl_rl before": ({"_mean": MEAN, "_var": VAR, "_std": np.sqrt(VAR)}, "obs_norm_state_dict",
                      (OBSERVATION - MEAN) / (np.sqrt(VAR) + 1e-2)),
    "rl_games": (
        {"running_mean": MEAN, "running_var": VAR / 100, **COUNT},
        "model.running_mean_std",
        np.clip((OBSERVATION - MEAN) / np.sqrt(VAR / 100 + 1e-5), -5, 5),
    ),
    "skrl": (
        {"running_mean": MEAN, "running_variance": VAR, "current_count": np.array(5)},
        "state_preprocessor",
        np.clip((OBSERVATION - MEAN) / (np.sqrt(VAR) + 1e-8), -5, 5),
    ),
}  # fmt: skip


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_normaliser_beside_the_network_is_applied(tmp_path, caplog, trainer):
    statistics, prefix, scaled = TRAINERS[trainer]
    tensors = {
        **actor(), **actor("critic", (4, 8, 1)), "std": np.ones(2, np.float32),
        **{f"{prefix}.{name}": array for name, array in statistics.items()},
        "critic_obs_normalizer._mean": MEAN, "critic_obs_normalizer._std": VAR,
    }  # fmt: skip
    file = saved(tmp_path, tensors)
    wanted = forward(tensors, ["actor.0", "actor.2"], scaled)
    for options in ({}, {"layers": ["actor.0", "actor.2"]}):
        got = policy(file, activation="elu", **options).act(OBSERVATION)
        np.testing.assert_allclose(got, wanted, rtol=2e-5)
    assert f"as by {trainer.split()[0]}" in caplog.text
    assert "critic.0.weight" in caplog.text
    plain = policy(file, activation="elu", normalise=(0, 1)).act(OBSERVATION)
    np.testing.assert_allclose(
        plain, forward(tensors, ["actor.0", "actor.2"], OBSERVATION), rtol=2e-5
    )


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"obs.mean": MEAN, "obs.std": VAR}, "a normaliser of an unknown form, obs.mean, obs.std"),
        ({"n._mean": MEAN[:2], "n._std": VAR[:2]}, "for 2 numbers, and the network takes 4"),
        ({"a._mean": MEAN, "a._std": VAR, "b._mean": MEAN, "b._std": VAR}, "several normalisers"),
        ({"n._mean": MEAN, "n._std": -VAR}, "are no mean and scale"),
        (
            {
                "bn.running_mean": MEAN,
                "bn.running_var": VAR,
                "bn.num_batches_tracked": COUNT["count"],
            },
            "a normaliser of an unknown form",
        ),
        ({"rnn.weight_ih_l0": VAR}, "also holds rnn.weight_ih_l0, which nothing uses"),
        ({"gain": VAR}, "also holds gain, which nothing uses: name them in layers="),
    ],
)
def test_what_nothing_uses_is_refused_by_its_name(tmp_path, more, words):
    file = saved(tmp_path, {**actor(), **more})
    with pytest.raises(PolicyError, match=words):
        policy(file, activation="elu", layers=["actor.0", "actor.2"])
    ignored = sorted({name.partition(".")[0] for name in more})
    got = policy(file, activation="elu", ignore=ignored, layers=["actor.0", "actor.2"])
    assert got.normaliser is None
    with pytest.raises(UnknownNameError, match="did you mean"):
        policy(file, activation="elu", ignore=["actr.0.weight"])


def test_layers_by_their_names(tmp_path):
    tensors = {**actor("net", (4, 8, 8)), **actor("mu", (8, 2), 0)}
    tensors = {n.replace("mu.0", "mu"): a for n, a in tensors.items()}
    got = policy(saved(tmp_path, tensors), activation="elu").act(OBSERVATION)
    np.testing.assert_allclose(
        got, forward(tensors, ["net.0", "net.2", "mu"], OBSERVATION), rtol=2e-5
    )
    two = {**actor("student", (4, 4)), **actor("teacher", (4, 4))}
    with pytest.raises(PolicyError, match="do not determine the order of its layers"):
        policy(saved(tmp_path, two), activation="elu")
    with pytest.raises(PolicyError, match=r"no tensor actor\.0\.weight; its layers are student\.0"):
        policy(saved(tmp_path, two), activation="elu", layers=["actor.0"])


def test_a_network_of_the_user_names_what_it_leaves(tmp_path, caplog):
    file = saved(tmp_path, {**actor(), "obs.mean": MEAN})
    loaded = policy(file, network=lambda w, x: w["actor.0.weight"] @ x)
    loaded.act(OBSERVATION)
    assert "network= uses no actor.0.bias, actor.2.bias, actor.2.weight, obs.mean" in caplog.text


def test_numbers_of_two_bytes(tmp_path):
    weight = RNG.normal(size=(2, 4)).astype(np.float32)
    halves = (weight.view(np.uint32) >> 16).astype(np.uint16)
    header = json.dumps(
        {"0.weight": {"dtype": "BF16", "shape": [2, 4], "data_offsets": [0, 16]}}
    ).encode()
    file = tmp_path / "b.safetensors"
    file.write_bytes(struct.pack("<Q", len(header)) + header + halves.tobytes())
    truncated = (halves.astype(np.uint32) << 16).view(np.float32)
    np.testing.assert_allclose(
        policy(file, activation="elu").act(OBSERVATION), truncated @ OBSERVATION, rtol=1e-5
    )


def test_arrays_of_numpy_in_a_file_of_torch_are_tensors_too(tmp_path):
    content = {**actor(), "normalizer": [MEAN, VAR]}
    with zipfile.ZipFile(tmp_path / "a.pt", "w") as archive:
        archive.writestr("a/data.pkl", pickle.dumps(content))
    with pytest.raises(PolicyError, match=r"also holds normalizer\.0, normalizer\.1"):
        policy(tmp_path / "a.pt", activation="elu")


def test_frames_of_normalised_observations():
    both = policy(lambda x: x, normalise=(np.ones(2), 2 * np.ones(2)), stack=2,
                  observation=np.zeros(2))  # fmt: skip
    seen, memory = both.act(jnp.array([3.0, 5.0]), both.initial_memory)
    np.testing.assert_allclose(seen, [0, 0, 1, 2])
    np.testing.assert_allclose(both.act(jnp.array([1.0, 1.0]), memory)[0], [1, 2, 0, 0])
    with pytest.raises(PolicyError, match="is of 3 numbers, and the policy sees 2 observations"):
        policy(lambda x: x, normalise=(np.ones(3), 1), stack=2, observation=np.zeros(2))


def rewritten(tmp_path, name, change):
    """Copy a model of Stable-Baselines3 with other settings."""
    with zipfile.ZipFile(FILES / name) as read, zipfile.ZipFile(tmp_path / name, "w") as write:
        for entry in read.namelist():
            data = read.read(entry)
            if entry == "data":
                settings = json.loads(data)
                change(settings)
                data = json.dumps(settings)
            write.writestr(entry, data)
    return tmp_path / name


def test_classes_that_compute_otherwise_are_refused(tmp_path):
    def recurrent(settings):
        name = b"csb3_contrib.policies\nRecurrentActorCriticPolicy\n."
        settings["policy_class"][":serialized:"] = base64.b64encode(name).decode()

    def custom(settings):
        name = pickle.dumps({"features_extractor_class": Path})
        settings["policy_kwargs"] = {":serialized:": base64.b64encode(name).decode()}

    with pytest.raises(PolicyError, match="RecurrentActorCriticPolicy, but other tensors"):
        policy(rewritten(tmp_path, "ppo.zip", recurrent))
    with pytest.raises(PolicyError, match="a features extractor of the class Path: export"):
        policy(rewritten(tmp_path, "ppo.zip", custom))


class _Saved:
    """What `VecNormalize.save` pickles, in form."""

    def __init__(self, **state):
        vars(self).update(state)


def test_a_normaliser_that_was_switched_off(tmp_path):
    file = tmp_path / "scale.pkl"
    file.write_bytes(pickle.dumps(_Saved(norm_obs=False, obs_rms=None, epsilon=1.0, clip_obs=1.0)))
    loaded = policy(lambda x: x, normalise=file)
    np.testing.assert_array_equal(loaded.act(OBSERVATION), OBSERVATION)


class Remembers:
    def __init__(self):
        self.total = 0.0

    def __call__(self, x):
        self.total = self.total + x[0]
        return -self.total * jnp.ones(1)


class OnHost(Remembers):
    def __call__(self, x):
        self.total += float(x[0])
        return np.float32([self.total])


def test_what_remembers_or_draws_is_no_policy():
    kept = [0.0]

    def appends(x):
        kept.append(x[0])
        return jnp.stack(kept[-2:])

    for function in (Remembers(), OnHost()):
        with pytest.raises(PolicyError, match="keeps attribute 'total' of"):
            policy(function).act(np.ones(2, np.float32))
    with pytest.raises(PolicyError, match="keeps variable 'kept' of appends"):
        policy(appends).act(np.ones(2, np.float32))
    with pytest.raises(PolicyError, match="other numbers each time that it is called"):
        policy(lambda x: x + np.random.default_rng().normal()).act(np.ones(2, np.float32))
    with pytest.raises(PolicyError, match="may lack a return statement"):
        policy(lambda x: None).act(np.ones(2, np.float32))
    # What is made once is no memory.
    cache = {}

    def cached(x):
        if "gain" not in cache:
            cache["gain"] = np.float32(2)
        return cache["gain"] * x

    np.testing.assert_allclose(jax.jit(policy(cached).act)(np.ones(2, np.float32)), [2, 2])
