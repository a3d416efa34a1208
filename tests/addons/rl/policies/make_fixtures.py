"""Make the files of this folder with the frameworks themselves, with what they give.

    python -m venv frameworks
    frameworks/bin/pip install torch stable-baselines3 onnx onnxruntime onnxscript safetensors
    frameworks/bin/python tests/addons/rl/policies/make_fixtures.py

For each file `NAME.*` there is an `NAME.expected.npz` with `observations` and `actions`; of those
that remember, of one episode after the other, `[episode, time, ...]`.
"""

from pathlib import Path

import gymnasium
import numpy as np
import onnxruntime
import stable_baselines3 as sb3
import torch
from safetensors.torch import save_file
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

HERE = Path(__file__).parent / "files"
HERE.mkdir(exist_ok=True)
torch.manual_seed(0)
rng = np.random.default_rng(0)


def expect(name, observations, actions):
    np.savez_compressed(HERE / f"{name}.expected.npz", observations=observations, actions=actions)


class Space(gymnasium.Env):
    """An environment of these spaces in which nothing happens."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), float(rng.normal()), False, False, {}


box = gymnasium.spaces.Box(-10.0, 10.0, (4,), np.float32)
force = gymnasium.spaces.Box(np.array([-2.0, -1.0], np.float32), np.array([2.0, 3.0], np.float32))
pixels = gymnasium.spaces.Box(0, 255, (3, 40, 40), np.uint8)


def stir(model):
    """Change all weights, so that none is what a constructor makes."""
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.3)
    return model


def of_sb3(name, kind, spaces, **options):
    environment = DummyVecEnv([lambda: Space(*spaces)])
    options["policy_kwargs"] = dict(options["policy_kwargs"])  # SAC writes into it.
    model = stir(kind(options.pop("policy", "MlpPolicy"), environment, seed=0, **options))
    model.save(HERE / f"{name}.zip")
    observations = np.stack([spaces[0].sample() for _ in range(64)])
    expect(name, observations, model.predict(observations, deterministic=True)[0])


spaces = gymnasium.spaces
box.seed(0), force.seed(0), pixels.seed(0)
small = {"net_arch": [16, 8]}
of_sb3("ppo", sb3.PPO, (box, force), policy_kwargs=small)
of_sb3("ppo_relu", sb3.PPO, (box, force), policy_kwargs={**small, "activation_fn": nn.ReLU})
of_sb3("a2c_discrete", sb3.A2C, (box, spaces.Discrete(3)), policy_kwargs=small)
of_sb3(
    "ppo_categories",
    sb3.PPO,
    (spaces.Discrete(7), spaces.MultiDiscrete([3, 2])),
    policy_kwargs=small,
)
of_sb3(
    "ppo_binary",
    sb3.PPO,
    (spaces.MultiDiscrete([3, 4]), spaces.MultiBinary(3)),
    policy_kwargs=small,
)
off = {"policy_kwargs": small, "buffer_size": 10}
of_sb3("sac", sb3.SAC, (box, force), **off)
of_sb3("td3", sb3.TD3, (box, force), **off)
of_sb3("dqn", sb3.DQN, (box, spaces.Discrete(4)), **off)
of_sb3("sac_sde", sb3.SAC, (box, force), use_sde=True, **off)

environment = VecNormalize(DummyVecEnv([lambda: Space(box, force)]), clip_obs=1.5)
model = stir(sb3.PPO("MlpPolicy", environment, seed=0, policy_kwargs=small, n_steps=32))
environment.reset()
for _ in range(50):
    environment.step(np.zeros((1, 2), np.float32))
model.save(HERE / "ppo_normalised.zip")
environment.save(HERE / "vec_normalize.pkl")
observations = np.stack([box.sample() for _ in range(64)])
seen = environment.normalize_obs(observations)
expect("ppo_normalised", observations, model.predict(seen, deterministic=True)[0])


class Cnn(nn.Module):
    def __init__(self):
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(1, 4, 3, stride=2, padding=1),
            nn.BatchNorm2d(4),
            nn.ELU(),
            nn.MaxPool2d(2),
            nn.Conv2d(4, 8, 3, groups=2),
            nn.GELU(),
            nn.AvgPool2d(2, ceil_mode=True),
            nn.Flatten(),
            nn.LazyLinear(3),
            nn.Softplus(),
        )

    def forward(self, x):
        return self.body(x)


class Mixed(nn.Module):
    """Operators of all kinds: slices, gathers, norms, softmax, where."""

    def __init__(self):
        super().__init__()
        self.first, self.norm = nn.Linear(6, 8), nn.LayerNorm(8)
        self.last = nn.Linear(8, 4)

    def forward(self, x):
        a, b = x[:, :3], x[:, 3:]
        y = torch.cat([torch.where(a > 0, a, 0.1 * b), torch.clamp(b, -0.5, 0.5)], dim=-1)
        y = nn.functional.selu(self.norm(nn.functional.silu(self.first(y))))
        weights = torch.softmax(self.last(y).reshape(-1, 2, 2), dim=-1)
        z = (weights * y[:, :4].view(-1, 2, 2)).sum(-1)
        return torch.tanh(z) - y.mean(-1, keepdim=True) + x[:, [4, 1]].abs().sqrt()


class Recurrent(nn.Module):
    def __init__(self, kind):
        super().__init__()
        self.cell = kind(3, 5, num_layers=2)
        self.norm, self.head = nn.LayerNorm(5), nn.Linear(5, 2)
        self.is_lstm = kind is nn.LSTM

    def forward(self, x, *state):
        y, after = self.cell(x, state if self.is_lstm else state[0])
        return (self.head(self.norm(y)), *(after if self.is_lstm else (after,)))


def export(name, module, shape, dynamo=False, opset=17):
    module.eval()
    file = HERE / f"{name}.onnx"
    example = torch.zeros(1, *shape)
    module(example)
    torch.onnx.export(
        module, (example,), file, dynamo=dynamo, input_names=["observation"], opset_version=opset,
        **({} if dynamo else {"dynamic_axes": {"observation": {0: "batch"}}}), external_data=False,
    )  # fmt: skip
    observations = rng.normal(size=(32, *shape)).astype(np.float32)
    session = onnxruntime.InferenceSession(str(file))
    (entry,) = session.get_inputs()
    actions = np.concatenate([session.run(None, {entry.name: o[None]})[0] for o in observations])
    expect(name, observations, actions)


mlp = nn.Sequential(nn.Linear(6, 16), nn.ELU(), nn.Linear(16, 16), nn.LeakyReLU(), nn.Linear(16, 2))
export("mlp", mlp, (6,))
export("mlp_dynamo", mlp, (6,), dynamo=True, opset=18)
export("cnn", Cnn(), (1, 24, 20))
export("mixed", Mixed(), (6,))
for name, kind in (("lstm", nn.LSTM), ("gru", nn.GRU)):
    module = Recurrent(kind).eval()
    states = tuple(torch.zeros(2, 1, 5) for _ in range(1 + (kind is nn.LSTM)))
    names = ["h", "c"][: len(states)]
    torch.onnx.export(
        module, (torch.zeros(1, 1, 3), *states), HERE / f"{name}.onnx", dynamo=False,
        input_names=["observation", *names], output_names=["action", *(f"{n}_out" for n in names)],
        opset_version=17,
    )  # fmt: skip
    observations = rng.normal(size=(2, 6, 3)).astype(np.float32)
    actions = []
    for episode in observations:
        memory, rows = states, []
        for observation in episode:
            with torch.no_grad():
                row, *memory = module(torch.as_tensor(observation)[None, None], *memory)
            rows.append(row[0, 0].numpy())
        actions.append(rows)
    expect(name, observations, np.array(actions))

save_file(mlp.state_dict(), HERE / "mlp.safetensors")
torch.save(mlp.state_dict(), HERE / "mlp.pt")

# Observations and actions that are matrices.
matrix = spaces.Box(np.full((2, 2), -2, np.float32), np.array([[1, 2], [3, 4]], np.float32))
square = spaces.Box(-1.0, 1.0, (2, 3), np.float32)
square.seed(0)
of_sb3("td3_matrix", sb3.TD3, (square, matrix), **off)
