"""Transformations of images that keep their labels: the usual augmentation of training data.

    transform = combine(flip(), shift(4), brightness(0.3), contrast(0.3))
    SupervisedTask(..., transform=transform)

Images have shape `[n, height, width, channels]` or `[n, height, width]`, with values from 0 to 1.
Labels pass unchanged: if a label is a position, your transformation must move it along.

Source: Shorten and Khoshgoftaar, A survey on image data augmentation for deep learning, Journal of
Big Data 6 (2019).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from verifai_jax.addons.training.augmentation.task import Inputs, Labels, Transformation
from verifai_jax.core.messages.checks import check_count, check_fraction


def combine(*transformations: Transformation) -> Transformation:
    """Return the transformation that applies these one after the other.

    **Raises:** `TypeError` for anything that is not a function.
    """
    for transformation in transformations:
        if not callable(transformation):
            raise TypeError(f"a transformation is a function; got {transformation!r}")

    def apply(inputs: Inputs, labels: Labels, key: Key[Array, ""]) -> tuple[Inputs, Labels]:
        for i, transformation in enumerate(transformations):
            inputs, labels = transformation(inputs, labels, jax.random.fold_in(key, i))
        return inputs, labels

    return apply


def flip(share: float = 0.5) -> Transformation:
    """Return the transformation that mirrors this share of the images left to right.

    **Raises:** `ValueError` for a share out of range.
    """
    check_fraction("share", share, zero=True, one=True)

    def apply(inputs: Inputs, labels: Labels, key: Key[Array, ""]) -> tuple[Inputs, Labels]:
        images = _images(inputs)
        mirrored = _each(jax.random.bernoulli(key, share, images.shape[:1]), images)
        return jnp.where(mirrored, images[:, :, ::-1], images), labels

    return apply


def shift(pixels: int) -> Transformation:
    """Return a transformation that shifts each image by its own number of `pixels` at most.

    Pixels that enter at an edge repeat the edge.

    **Raises:** `ValueError` unless it is a positive integer.
    """
    check_count("pixels", pixels)

    def move(
        image: Float[Array, "height width *channels"], by: Array
    ) -> Float[Array, "height width *channels"]:
        height, width = image.shape[:2]
        rows = jnp.clip(jnp.arange(height) + by[0], 0, height - 1)
        columns = jnp.clip(jnp.arange(width) + by[1], 0, width - 1)
        return image[rows][:, columns]

    def apply(inputs: Inputs, labels: Labels, key: Key[Array, ""]) -> tuple[Inputs, Labels]:
        images = _images(inputs)
        by = jax.random.randint(key, (len(images), 2), -pixels, pixels + 1)
        return jax.vmap(move)(images, by), labels

    return apply


def brightness(max_change: float) -> Transformation:
    """Return a transformation that multiplies images by a factor of `1 +- max_change` at most.

    **Raises:** `ValueError` for a share out of range.
    """
    return _scaled(max_change, jnp.zeros_like)


def contrast(max_change: float) -> Transformation:
    """Return a transformation that scales images around their mean by `1 +- max_change` at most.

    **Raises:** `ValueError` for a share out of range.
    """

    def mean(images: Array) -> Array:
        return images.mean(axis=tuple(range(1, images.ndim)), keepdims=True)

    return _scaled(max_change, mean)


def _scaled(max_change: float, middle: Callable[[Array], Array]) -> Transformation:
    """Return a transformation that scales images around a middle, and keeps them in [0, 1]."""
    check_fraction("max_change", max_change)

    def apply(inputs: Inputs, labels: Labels, key: Key[Array, ""]) -> tuple[Inputs, Labels]:
        images = _images(inputs)
        factor = jax.random.uniform(
            key, images.shape[:1], minval=1 - max_change, maxval=1 + max_change
        )
        around = middle(images)
        return jnp.clip(around + (images - around) * _each(factor, images), 0.0, 1.0), labels

    return apply


def _images(inputs: Inputs) -> Float[Array, "n height width *channels"]:
    """Return inputs as an array of images."""
    shape = getattr(inputs, "shape", None)
    if shape is None or len(shape) not in (3, 4):
        given = type(inputs).__name__ if shape is None else f"shape {list(shape)}"
        raise ValueError(
            "transformations of images need inputs [n, height, width] or "
            f"[n, height, width, channels]; got {given}"
        )
    images = jnp.asarray(inputs)
    if not jnp.issubdtype(images.dtype, jnp.floating):
        raise ValueError(
            f"transformations of images need values from 0 to 1; got {images.dtype}: divide by 255"
        )
    return images


def _each(values: Array, images: Array) -> Array:
    """Return one value an image in a shape that fits the images."""
    return values.reshape((-1,) + (1,) * (images.ndim - 1))
