"""Detectors: two ways to convolve that agree, training, files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.perception import (
    DetectorFileError,
    Labels,
    detector,
    load_detector,
    save_detector,
    score,
    train_detector,
)

SHAPE = (8, 16)


def squares(count: int, seed: int) -> tuple[np.ndarray, Labels]:
    """Return images with a bright square, or none, at some column."""
    rng = np.random.default_rng(seed)
    images = rng.uniform(0.2, 0.4, (count, *SHAPE, 3)).astype(np.float32)
    column, present = rng.integers(1, 13, count), rng.random(count) < 0.7
    for row in np.nonzero(present)[0]:
        images[row, 3:6, column[row] : column[row] + 3] = 0.9
    return images, Labels(present, column[:, None].astype(np.float32))


@pytest.fixture(scope="module")
def network():
    return detector(jax.random.key(1), SHAPE, kinds=2, values=3, channels=(4, 5, 6), hidden=(7,))


@pytest.mark.slow
def test_slices_and_convolutions_agree(network):
    images = jax.random.uniform(jax.random.key(0), (3, *SHAPE, 3))
    with jax.default_matmul_precision("highest"):
        one_by_one = jax.jit(jax.vmap(network))(images)
        together = network.predict(images, size=2)
    for a, b in zip(one_by_one, together, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    assert together.kinds.shape == (3, 2)
    assert together.values.shape == (3, 3)


@pytest.mark.slow
def test_training_learns_where_the_square_is():
    images, labels = squares(600, 0)
    new = detector(jax.random.key(0), SHAPE, channels=(6, 8), hidden=(16,))
    trained, losses = train_detector(images, labels, network=new, steps=250, learning_rate=5e-3)
    quality = score(trained, *squares(300, 1), tolerance=1.0)
    assert losses[-20:].mean() < losses[:20].mean() / 4
    assert quality.recall > 0.9
    assert quality.precision > 0.9
    again, _ = train_detector(images, labels, network=new, steps=3)
    other, _ = train_detector(images, labels, network=new, steps=3)
    assert all(map(np.array_equal, jax.tree.leaves(again), jax.tree.leaves(other)))
    assert f"{quality.error_rate:.1%} wrong" in str(quality)


@pytest.mark.thorough
def test_a_file_keeps_a_detector_in_half_precision(network, tmp_path):
    save_detector(tmp_path / "network.npz", network)
    read = load_detector(tmp_path / "network.npz")
    assert jax.tree.structure(read) == jax.tree.structure(network)
    for a, b in zip(jax.tree.leaves(network), jax.tree.leaves(read), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-3)
    assert (tmp_path / "network.npz").stat().st_size < 2 * network.weights + 4000


def test_files_that_hold_no_detector_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("no zip")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    np.savez(tmp_path / "pickle.npz", about=np.array([{"format": 1}], dtype=object))
    for name in ("text", "other", "pickle"):
        with pytest.raises(DetectorFileError, match=rf"{name}.npz is not a detector"):
            load_detector(tmp_path / f"{name}.npz")


def test_mistakes_are_named(network):
    images, labels = squares(4, 0)
    with pytest.raises(ValueError, match=r"4 convolutions.*at least 16 pixels.*got 8 x 16"):
        detector(jax.random.key(0), SHAPE, channels=(1, 1, 1, 1))
    with pytest.raises(ValueError, match=r"labels.present has 3 rows for 4 images"):
        train_detector(images, labels._replace(present=np.ones(3)))
    with pytest.raises(ValueError, match=r"\(n, height, width, 3\); got \(8, 16, 3\)"):
        train_detector(images[0], labels)
    with pytest.raises(ValueError, match=r"images of shape \(8, 16, 3\); got \(8, 15, 3\)"):
        network.predict(jnp.zeros((2, 8, 15, 3)))
    with pytest.raises(ValueError, match=r"did you mean 'steps'"):
        train_detector(images, labels, step=3)
