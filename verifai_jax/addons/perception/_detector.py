"""Small convolutional networks that detect an object, its kind and its position.

    network = detector(jax.random.key(0), shape=(24, 48), values=1)
    seen = network(image)                     # Detection: presence (a logit), kinds, values
    network.predict(images)                   # of a batch, as NumPy arrays
    save_detector("wide.npz", network)        # float16
    network = load_detector("wide.npz")

Convolutions are nine strided slices and a product (im2col): on CPUs the gradient of XLA's own
convolution takes twenty times as long inside a loop of JAX as outside.
"""

import dataclasses
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.addons.perception.camera import STATIC, described
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_archives import read_arrays

FORMAT = "verifai_jax detector 1"


class Detection(NamedTuple):
    """The output of a detector, for one image; batches have leading axes.

    - `presence`: logit of the probability that the object is present; positive above one half.
    - `kinds`: logits of its kinds, `[kinds]`.
    - `values`: estimates of its numbers (a distance, the corners of a box), `[values]`.
    """

    presence: Float[Array, "*batch"] | Float[np.ndarray, "*batch"]
    kinds: Float[Array, "*batch kinds"] | Float[np.ndarray, "*batch kinds"]
    values: Float[Array, "*batch values"] | Float[np.ndarray, "*batch values"]


class DetectorFileError(ValueError):
    """An error for a file without a detector."""


Layer = tuple[Array, Array]
"""Weights and biases."""


@described
class Detector:
    """A network of convolutions with stride two and dense layers; a pytree of its weights.

    - `convolutions`: weights `[9 * channels in, channels out]` and biases.
    - `dense`: weights and biases of the hidden layers and the last one.
    - `centre`, `scale`: those of the values, `[values]`; the last layer gives standardised values.
    - `kinds`: number of kinds to distinguish; 0 if there is only one.
    - `shape`: height and width of its images.
    """

    convolutions: tuple[Layer, ...]
    dense: tuple[Layer, ...]
    centre: Array
    scale: Array
    kinds: int = dataclasses.field(metadata=STATIC)
    shape: tuple[int, int] = dataclasses.field(metadata=STATIC)

    def __call__(self, image: Float[Array, "height width 3"]) -> Detection:
        """Detect in one image of colours in [0, 1]."""
        x = image - 0.5
        for weights, bias in self.convolutions:
            x = jax.nn.relu(_patches(x) @ weights + bias)
        return self._outputs(x.reshape(-1))

    def batch(self, images: Float[Array, "n height width 3"]) -> Detection:
        """Detect in a batch with XLA's convolutions: for training, outside of JAX loops."""
        x = images - 0.5
        for weights, bias in self.convolutions:
            kernel = weights.reshape(3, 3, x.shape[-1], -1)
            x = jax.lax.conv_general_dilated(
                x, kernel, (2, 2), ((1, 1), (1, 1)), dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
            x = jax.nn.relu(x + bias)
        return self._outputs(x.reshape(len(images), -1))

    def predict(self, images: np.ndarray | Array, size: int = 256) -> Detection:
        """Detect in any number of images, `size` at a time, and return NumPy arrays."""
        images = np.asarray(images, np.float32)
        if images.shape[1:] != (*self.shape, 3):
            raise ValueError(
                f"this detector sees images of shape {(*self.shape, 3)}; got {images.shape[1:]}"
            )
        size = min(size, max(len(images), 1))
        parts = []
        for first in range(0, max(len(images), 1), size):
            part = images[first : first + size]
            # One shape, so that one program serves all batches.
            filled = np.pad(part, ((0, size - len(part)), (0, 0), (0, 0), (0, 0)))
            parts.append(jax.device_get(_batch(self, filled)))
        presence, kinds, values = (np.concatenate(leaves) for leaves in zip(*parts, strict=True))
        count = len(images)
        return Detection(presence[:count], kinds[:count], values[:count])

    @property
    def weights(self) -> int:
        """Number of weights and biases."""
        return sum(leaf.size for leaf in jax.tree.leaves((self.convolutions, self.dense)))

    def _outputs(self, x: Float[Array, "*batch features"]) -> Detection:
        for weights, bias in self.dense[:-1]:
            x = jax.nn.relu(x @ weights + bias)
        weights, bias = self.dense[-1]
        out = x @ weights + bias
        values = self.centre + self.scale * out[..., 1 + self.kinds :]
        return Detection(out[..., 0], out[..., 1 : 1 + self.kinds], values)


_batch = jax.jit(lambda network, images: network.batch(images))


def detector(
    key: Key[Array, ""], shape: tuple[int, int], *, kinds: int = 0, values: int = 1,
    channels: Sequence[int] = (12, 16, 24), hidden: Sequence[int] = (48,),
) -> Detector:  # fmt: skip
    """Return a detector with random weights (He et al., "Delving deep into rectifiers", 2015).

    **Arguments:**
    - `key`: the key of the weights.
    - `shape`: height and width of the images.
    - `kinds`: number of kinds of objects to distinguish.
    - `values`: number of values to estimate for an object.
    - `channels`: the numbers of channels of the convolutions, each of which halves the image.
    - `hidden`: numbers of units of the dense layers.
    **Raises:** `ValueError` for images that are too small for this number of convolutions.
    """
    height, width = shape
    if min(height, width) < 2 ** len(channels):
        raise ValueError(
            f"{len(channels)} convolutions, each of which halves the image, need images of "
            f"at least {2 ** len(channels)} pixels each way; got {height} x {width}"
        )
    keys = iter(jax.random.split(key, len(channels) + len(hidden) + 1))

    def layer(inputs: int, outputs: int, gain: float = 2.0) -> Layer:
        weights = jax.random.normal(next(keys), (inputs, outputs)) * (gain / inputs) ** 0.5
        return weights, jnp.zeros(outputs)

    sizes = (3, *channels)
    convolutions = [layer(9 * a, b) for a, b in itertools.pairwise(sizes)]
    for _ in channels:
        height, width = -(-height // 2), -(-width // 2)
    sizes = (height * width * sizes[-1], *hidden)
    dense = [layer(a, b) for a, b in itertools.pairwise(sizes)]
    dense.append(layer(sizes[-1], 1 + kinds + values, gain=0.1))
    return Detector(
        tuple(convolutions), tuple(dense), jnp.zeros(values), jnp.ones(values), kinds, shape
    )


def _patches(x: Float[Array, "height width channels"]) -> Float[Array, "rows columns patch"]:
    """Return the 3 x 3 neighbourhoods of every other pixel, side by side."""
    height, width, _ = x.shape
    rows, columns = -(-height // 2), -(-width // 2)
    x = jnp.pad(x, ((1, 1), (1, 1), (0, 0)))
    parts = [
        x[i : i + 2 * rows - 1 : 2, j : j + 2 * columns - 1 : 2] for i in range(3) for j in range(3)
    ]
    return jnp.concatenate(parts, axis=-1)


def save_detector(path: str | Path, network: Detector) -> None:
    """Write a detector in half precision, without pickles."""
    layers = {"convolution": network.convolutions, "dense": network.dense}
    arrays: dict[str, Any] = {
        f"{name}{number}_{part}": np.asarray(value, np.float16)
        for name, group in layers.items()
        for number, layer in enumerate(group)
        for part, value in zip(("weights", "bias"), layer, strict=True)
    }
    about = {"format": FORMAT, "kinds": network.kinds, "shape": list(network.shape)}
    arrays["values"] = np.stack([network.centre, network.scale]).astype(np.float32)
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)


def load_detector(path: str | Path) -> Detector:
    """Read a detector written by `save_detector`.

    **Raises:** `DetectorFileError` for any other file.
    """
    try:
        arrays = read_arrays(Path(path), str(path))
        about = json.loads(str(arrays["about"]))
        if about["format"] != FORMAT:
            raise DetectorFileError(f"{path} has the format {about['format']!r}, not {FORMAT!r}")
        centre, scale = map(jax.device_put, np.asarray(arrays["values"], np.float32))
        kinds, (height, width) = int(about["kinds"]), map(int, about["shape"])
        layers = _layers(arrays, "convolution"), _layers(arrays, "dense")
        network = Detector(*layers, centre, scale, kinds, (height, width))
        seen = jax.eval_shape(network, jax.ShapeDtypeStruct((height, width, 3), np.float32))
        if (seen.kinds.shape, seen.values.shape) != ((kinds,), centre.shape):
            raise ValueError("its last layer does not fit its kinds and values")
        return network
    except FileNotFoundError:
        raise
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError,
            OverflowError) as error:  # fmt: skip
        if isinstance(error, DetectorFileError):
            raise
        raise DetectorFileError(
            f"{path} is not a detector that save_detector wrote: {' '.join(str(error).split())}"
        ) from error


def _layers(arrays: dict[str, np.ndarray], name: str) -> tuple[Layer, ...]:
    count = sum(key.startswith(name) and key.endswith("_bias") for key in arrays)
    return tuple(
        (
            jax.device_put(np.asarray(arrays[f"{name}{number}_weights"], np.float32)),
            jax.device_put(np.asarray(arrays[f"{name}{number}_bias"], np.float32)),
        )
        for number in range(count)
    )
