"""Transformations of images against their definitions, and what they refuse."""

import jax
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax import augmentation

KEY = jax.random.key(0)
IMAGES = np.random.default_rng(0).uniform(0.2, 0.8, (6, 4, 5, 3)).astype(np.float32)
LABELS = np.arange(6)


def applied(transformation, images=IMAGES):
    found, labels = transformation(images, LABELS, KEY)
    assert labels is LABELS
    return np.asarray(found)


def test_a_flip_mirrors_left_to_right():
    np.testing.assert_array_equal(applied(augmentation.flip(1.0)), IMAGES[:, :, ::-1])
    np.testing.assert_array_equal(applied(augmentation.flip(0.0)), IMAGES)
    some = applied(augmentation.flip(0.5))
    mirrored = [np.array_equal(a, b[:, ::-1]) for a, b in zip(some, IMAGES, strict=True)]
    assert 0 < sum(mirrored) < len(IMAGES)


def test_a_shift_moves_each_image_and_repeats_the_edge():
    found = applied(augmentation.shift(1))
    padded = np.pad(IMAGES, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    moves = set()
    for image, around in zip(found, padded, strict=True):
        (move,) = [
            (i, j)
            for i in range(3)
            for j in range(3)
            if np.array_equal(image, around[i : i + 4, j : j + 5])
        ]
        moves.add(move)
    assert len(moves) > 1


def test_brightness_is_one_factor_an_image():
    factors = applied(augmentation.brightness(0.2)) / IMAGES
    first = factors[:, :1, :1, :1]
    np.testing.assert_allclose(factors, np.broadcast_to(first, factors.shape), rtol=1e-5)
    assert np.all((first >= 0.8) & (first <= 1.2))
    assert len(np.unique(np.round(first, 5))) == len(IMAGES)


def test_contrast_keeps_the_mean():
    gray = IMAGES[..., 0]
    found = applied(augmentation.contrast(0.2), gray)
    np.testing.assert_allclose(found.mean(axis=(1, 2)), gray.mean(axis=(1, 2)), rtol=1e-5)
    ratio = found.std(axis=(1, 2)) / gray.std(axis=(1, 2))
    assert np.all((ratio >= 0.79) & (ratio <= 1.21))


def test_several_are_applied_one_after_the_other():
    both = augmentation.combine(augmentation.flip(1.0), augmentation.brightness(0.2))
    found = applied(both)
    alone, _ = augmentation.brightness(0.2)(IMAGES[:, :, ::-1], LABELS, jax.random.fold_in(KEY, 1))
    np.testing.assert_array_equal(found, alone)


def test_what_is_no_image_is_refused():
    with unchecked():
        with pytest.raises(ValueError, match=r"need inputs \[n, height, width\] .*shape \[6, 2\]"):
            augmentation.flip()(np.zeros((6, 2)), LABELS, KEY)
        with pytest.raises(ValueError, match="values from 0 to 1; got uint8: divide by 255"):
            augmentation.shift(2)(np.zeros((6, 4, 5), np.uint8), LABELS, KEY)
        with pytest.raises(ValueError, match="pixels must be an integer of at least 1; got 0"):
            augmentation.shift(0)
        with pytest.raises(TypeError, match="a transformation is a function; got 3"):
            augmentation.combine(3)
