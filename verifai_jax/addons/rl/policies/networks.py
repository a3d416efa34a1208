"""Networks of the usual forms, as pure functions of their weights."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from verifai_jax.addons.rl.policies.errors import PolicyError
from verifai_jax.core.messages.errors import check_names

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": jnp.tanh, "relu": jax.nn.relu, "elu": jax.nn.elu, "selu": jax.nn.selu,
    "gelu": lambda x: jax.nn.gelu(x, approximate=False), "silu": jax.nn.silu,
    "swish": jax.nn.silu, "leakyrelu": lambda x: jax.nn.leaky_relu(x, 0.01),
    "sigmoid": jax.nn.sigmoid, "softplus": jax.nn.softplus, "identity": lambda x: x,
}  # fmt: skip
"""Functions between layers, by the lower-case names of PyTorch's classes."""
Layers = tuple[tuple[Float[Array, "inputs outputs"], Float[Array, " outputs"]], ...]


def activation_name(name: str) -> str:
    """Return the name in `ACTIVATIONS` of an activation, such as `LeakyReLU`; refuse others."""
    plain = name.lower().replace("_", "")
    check_names("activation", [plain], ACTIVATIONS)
    return plain


@dataclass(frozen=True)
class Mlp:
    """A multilayer perceptron, with an activation after each layer except the last.

    - `activation`: a name of `ACTIVATIONS`.
    - `categories`: if given, integer observations become one-hot vectors of these lengths.
    - `pixels`: whether observations are images `[channels, height, width]` from 0 to 255, which
      first pass through the three convolutions of Mnih et al. (2015).
    """

    activation: str
    categories: tuple[int, ...] = ()
    pixels: bool = False

    def example(self, weights: PyTree) -> np.ndarray | None:
        """Return zeros in the form of an observation; None for images, of unknown size."""
        if self.pixels:
            return None
        return np.zeros(len(self.categories) or weights[0][0].shape[0])

    def __call__(self, weights: PyTree, observation: Array, memory: None) -> tuple[Array, None]:
        """Return the outputs of the last layer."""
        layers, x = weights, observation
        if self.pixels:
            convolutions, layers = weights
            x = _nature(convolutions, jnp.asarray(x, float) / 255)
        return self.dense(layers, self.flat(x, layers[0][0].shape[0])), None

    def flat(self, x: Array, size: int) -> Array:
        """Return an observation as the numbers that the first layer takes.

        **Raises:** `PolicyError` for another count of numbers.
        """
        if self.categories:
            parts = zip(jnp.reshape(x, len(self.categories)), self.categories, strict=True)
            x = jnp.concatenate([(one == jnp.arange(n)).astype(float) for one, n in parts])
        elif x.ndim and x.shape[-1] != size:
            x = jnp.reshape(x, -1)
        if not x.ndim or x.shape[-1] != size:
            raise PolicyError(
                f"the network takes observations of {size} numbers; got shape {list(x.shape)}"
            )
        return x

    def dense(self, layers: Layers, x: Array) -> Array:
        """Return the outputs of the layers."""
        for i, (weight, bias) in enumerate(layers):
            # The linear layer after convolutions has the activation of those.
            f = jax.nn.relu if self.pixels and i == 0 else ACTIVATIONS[self.activation]
            x = x @ weight + bias
            x = x if i == len(layers) - 1 else f(x)
        return x


@dataclass(frozen=True)
class LstmMlp(Mlp):
    """Layers of LSTM as PyTorch has them, and a perceptron on the state of the last one."""

    def example(self, weights: PyTree) -> np.ndarray:
        """Return zeros in the form of an observation."""
        return np.zeros(len(self.categories) or weights[0][0][0].shape[0])

    def __call__(self, weights: PyTree, observation: Array, memory: PyTree) -> tuple[Array, PyTree]:
        """Return the outputs, and the states `(h, c)` of all layers of LSTM."""
        cells, layers = weights
        x, after = self.flat(observation, cells[0][0].shape[0]), []
        for (kernel, recurrent, bias), (h, c) in zip(cells, memory, strict=True):
            i, f, new, o = jnp.split(x @ kernel + h @ recurrent + bias, 4, axis=-1)
            c = jax.nn.sigmoid(f) * c + jax.nn.sigmoid(i) * jnp.tanh(new)
            x = jax.nn.sigmoid(o) * jnp.tanh(c)
            after.append((x, c))
        return self.dense(layers, x), tuple(after)


def _nature(convolutions: Layers, image: Float[Array, "c h w"]) -> Float[Array, " k"]:
    x = image[None]
    for (kernel, bias), stride in zip(convolutions, (4, 2, 1), strict=True):
        x = jax.lax.conv(x, kernel, (stride, stride), "VALID") + bias[:, None, None]
        x = jax.nn.relu(x)
    return jnp.reshape(x, -1)
