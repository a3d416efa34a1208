"""Training of detectors on labelled images.

images, labels = jax.lax.map(example, points)             # rendered, with `Labels`
network, losses = train_detector(images, labels, steps=1000, seed=0)
score(network, test_images, test_labels)                  # precision, recall, error rate
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.addons.perception._detector import Detection, Detector, Layer, detector
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.display.progress import say_done, shows_progress
from verifai_jax.core.messages.errors import suggests_options


class Labels(NamedTuple):
    """The truth about images.

    - `present`: whether the object is in the image.
    - `values`: its values, `[n, values]`; ignored if it is absent.
    - `kinds`: its kind, from 0; None if there is only one kind.
    """

    present: Bool[Array, " n"] | Float[Array, " n"] | np.ndarray
    values: Float[Array, "n values"] | np.ndarray
    kinds: Int[Array, " n"] | np.ndarray | None = None


@suggests_options
@shows_progress("training a detector", "steps")
def train_detector(
    images: Float[Array, "n height width 3"] | np.ndarray,
    labels: Labels,
    *,
    network: Detector | None = None,
    steps: int = 1000,
    batch: int = 64,
    learning_rate: float = 2e-3,
    noise: float = 0.02,
    seed: int = 0,
    progress: bool | None = None,
) -> tuple[Detector, Float[np.ndarray, " steps"]]:
    """Train a detector with Adam and a cosine schedule of the learning rate.

    One step is compiled; the loop runs in Python, because convolutions inside JAX loops are slow on
    CPUs. Rows are drawn without replacement, epoch by epoch.

    **Arguments:**
    - `images`: colours in [0, 1].
    - `labels`: the labels of each image.
    - `network`: a detector to train further; None for a new one with default layers.
    - `steps`, `batch`: number of steps, and images in each.
    - `learning_rate`: the learning rate of the first step.
    - `noise`: standard deviation of noise added to each pixel in each step.
    - `seed`: the seed of the weights, the order of the images and the noise.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Returns:** the network, and the loss of each step.
    **Raises:** `ValueError` if images and labels do not match.
    """
    images = jnp.asarray(images, jnp.float32)
    labels = _checked(images, labels)
    count, shape = len(images), (images.shape[1], images.shape[2])
    new, order, pixels = jax.random.split(jax.random.key(seed), 3)
    if network is None:
        kinds = 0 if labels.kinds is None else int(np.max(labels.kinds)) + 1
        trained = detector(new, shape, kinds=kinds, values=labels.values.shape[1])
        trained = standardized(trained, labels)
    elif network.shape != shape:
        raise ValueError(f"the network sees images of {network.shape} pixels; got {shape}")
    else:
        trained = network
    batch = min(batch, count)
    optimizer = optax.adam(optax.cosine_decay_schedule(learning_rate, steps, 0.02))
    update = _step_of(optimizer, noise)
    state = optimizer.init(_trained(trained))
    rows = np.random.default_rng(int(jax.random.randint(order, (), 0, 2**31 - 1)))
    losses, queue = [], np.zeros(0, int)
    for step in range(steps):
        while len(queue) < batch:
            queue = np.concatenate([queue, rows.permutation(count)])
        chosen, queue = queue[:batch], queue[batch:]
        part = jax.tree.map(lambda leaf, at=chosen: leaf[at], (images, labels))
        trained, state, loss = update(trained, state, *part, jax.random.fold_in(pixels, step))
        losses.append(loss)
        say_done(step + 1, steps)
    return trained, np.asarray(jax.device_get(losses), np.float32)


def _checked(images: Array, labels: Labels) -> Labels:
    if images.ndim != 4 or images.shape[-1] != 3:
        raise ValueError(f"images must have shape (n, height, width, 3); got {images.shape}")
    values = jnp.asarray(labels.values, jnp.float32)
    if values.ndim == 1:
        values = values[:, None]
    present = jnp.asarray(labels.present, jnp.float32)
    kinds = None if labels.kinds is None else jnp.asarray(labels.kinds, jnp.int32)
    for name, leaf in (("present", present), ("values", values), ("kinds", kinds)):
        if leaf is not None and len(leaf) != len(images):
            raise ValueError(f"labels.{name} has {len(leaf)} rows for {len(images)} images")
    if not len(images):
        raise ValueError("there are no images to train on")
    return Labels(present, values, kinds)


def standardized(network: Detector, labels: Labels) -> Detector:
    """Return a detector with values scaled by the mean and deviation over present objects."""
    there = np.asarray(labels.present) > 0.5
    if not there.any():
        return network
    values = np.asarray(labels.values)[there]
    scale = np.maximum(values.std(axis=0), 1e-3)
    return dataclasses.replace(
        network, centre=jnp.asarray(values.mean(axis=0)), scale=jnp.asarray(scale)
    )


def _trained(network: Detector) -> tuple[tuple[Layer, ...], tuple[Layer, ...]]:
    """Return the leaves that are trained: not those that standardise."""
    return network.convolutions, network.dense


def _step_of(optimizer: optax.GradientTransformation, noise: float):
    """Return one compiled step of training."""

    @partial(jax.jit, donate_argnums=(1,))
    def step(
        network: Detector, state: optax.OptState, images: Array, labels: Labels, key: Key[Array, ""]
    ) -> tuple[Detector, optax.OptState, Float[Array, ""]]:
        noisy = images + noise * jax.random.normal(key, images.shape)

        def loss(trained: tuple) -> Float[Array, ""]:
            convolutions, dense = trained
            now = dataclasses.replace(network, convolutions=convolutions, dense=dense)
            return jnp.mean(losses_of(now, now.batch(noisy), labels))

        value, gradient = jax.value_and_grad(loss)(_trained(network))
        updates, state = optimizer.update(gradient, state)
        convolutions, dense = optax.apply_updates(_trained(network), updates)  # pyright: ignore
        return dataclasses.replace(network, convolutions=convolutions, dense=dense), state, value

    return step


def losses_of(network: Detector, seen: Detection, labels: Labels) -> Float[Array, " n"]:
    """Return the loss of each image: cross-entropy, and the Huber loss of the standardised values.

    Values and kinds count only if the object is present.
    """
    present = jnp.asarray(labels.present, jnp.float32)
    loss = optax.sigmoid_binary_cross_entropy(seen.presence, present)
    error = optax.huber_loss((seen.values - labels.values) / network.scale)
    loss = loss + 2.0 * present * jnp.sum(error, axis=-1)
    if labels.kinds is not None:
        named = optax.softmax_cross_entropy_with_integer_labels(seen.kinds, labels.kinds)
        loss = loss + present * named
    return loss


@dataclasses.dataclass(frozen=True)
class Score(InNotebook):
    """The quality of a detector on a test set.

    - `images`: number of images.
    - `precision`: share of the detections that are right; NaN without any.
    - `recall`: share of the objects that are detected.
    - `error`: median absolute error of each value, over detected objects.
    - `wrong`: for each image, whether presence is wrong, or a value by more than the tolerance.
    """

    images: int
    precision: float
    recall: float
    error: Float[np.ndarray, " values"]
    wrong: Bool[np.ndarray, " n"]

    @property
    def error_rate(self) -> float:
        """Share of the images with a wrong output."""
        return float(np.mean(self.wrong))

    def __str__(self) -> str:
        """Return the figures in one line."""
        return (
            f"{self.images} images: precision {self.precision:.1%}, recall {self.recall:.1%}, "
            f"{self.error_rate:.1%} wrong"
        )


def score(
    network: Detector, images: Float[Array, "n height width 3"] | np.ndarray, labels: Labels, *,
    tolerance: float = 0.2,
) -> Score:  # fmt: skip
    """Compare a detector's output with the truth.

    **Arguments:**
    - `tolerance`: absolute error of a value above which it counts as wrong.
    """
    labels = _checked(jnp.asarray(images), labels)
    seen = network.predict(images)
    there, found = np.asarray(labels.present) > 0.5, np.asarray(seen.presence) > 0
    both = there & found
    error = np.abs(np.asarray(seen.values) - np.asarray(labels.values))
    wrong = (there != found) | (both & (error > tolerance).any(axis=1))
    if labels.kinds is not None:
        wrong |= both & (np.asarray(seen.kinds).argmax(axis=1) != np.asarray(labels.kinds))
    nothing = np.full(error.shape[1], np.nan)
    return Score(
        len(there),
        float(both.sum() / found.sum()) if found.any() else float("nan"),
        float(both.sum() / there.sum()) if there.any() else float("nan"),
        np.median(error[both], axis=0) if both.any() else nothing,
        wrong,
    )
