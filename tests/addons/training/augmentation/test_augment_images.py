"""An augmentation of small images: a convolutional network, image transformations, the montage."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax import augmentation

pytestmark = pytest.mark.thorough

ROWS, COLUMNS = jnp.mgrid[0:8, 0:16]
SPACE = {
    "height": vj.Box(1.5, 5.5),
    "place": vj.Box(2.5, 12.5),
    "length": vj.Box(0.8, 2.5),
    "light": vj.Box(0.2, 1.0),
    "bar": vj.Categorical("flat", "upright"),
}


def render(features):
    """Return an image of a bar on a dark ground."""
    across, down = jnp.abs(COLUMNS - features["place"]), jnp.abs(ROWS - features["height"])
    upright = features["bar"] == 1
    along, beside = jnp.where(upright, down, across), jnp.where(upright, across, down)
    bar = jnp.clip(features["length"] - along + 0.5, 0, 1) * jnp.clip(1.0 - beside, 0, 1)
    return (0.1 + 0.9 * features["light"] * bar)[:, :, None]


def label(features):
    return (features["bar"] == 1).astype(jnp.float32)


def logits(weights, images):
    kernel, dense = weights["kernel"], weights["dense"]
    found = jax.lax.conv_general_dilated(
        images, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    return jax.nn.relu(found - 0.1).sum((1, 2)) @ dense


@jax.jit
def step(weights, images, labels):
    def loss(weights):
        return jnp.mean(jax.nn.softplus(logits(weights, images) * (1 - 2 * labels)))

    return jax.tree.map(lambda w, g: w - 0.05 * g, weights, jax.grad(loss)(weights))


def train(images, labels, weights, steps, key):
    if weights is None:
        one, two = jax.random.split(key)
        kernel = 0.3 * jax.random.normal(one, (3, 3, 1, 6))
        weights = {"kernel": kernel, "dense": 0.1 * jax.random.normal(two, (6,))}
    places = np.asarray(jax.random.randint(key, (steps, 32), 0, len(images)))
    for some in places:
        weights = step(weights, images[some], labels[some])
    return weights


TASK = vj.SupervisedTask(
    "bars",
    SPACE,
    render,
    label,
    train,
    logits,
    lambda logit, label: logit * (1 - 2 * label),
    transform=augmentation.combine(
        augmentation.flip(), augmentation.shift(1), augmentation.brightness(0.2)
    ),
)


@pytest.mark.slow
def test_images_are_added_and_shown(tmp_path):
    options = {"initial": 128, "added": 32, "steps": (300, 50)}
    result = vj.augment(
        TASK, ("none", "standard", "counterexamples"), seeds=2, test=256, hard=0, budget=512,
        **options,
    )  # fmt: skip
    assert result.complete
    assert set(result.table["status"]) == {"trained"}
    base = result.table.loc[result.table["arm"] == "base", "error"]
    assert (base < 0.45).all(), "it learns something"
    assert (base > 0).all(), "and not everything"
    assert result.added["bar"].isin(["flat", "upright"]).all()
    examples = result.examples("counterexamples", 1)
    assert examples.inputs.shape == (len(examples), 8, 16, 1)
    wrong = logits(result.weights["base", 1], jnp.asarray(examples.inputs))
    margins = np.asarray(wrong) * (1 - 2 * examples.labels)
    assert (margins > 0).all()
    known = result.added.query("arm == 'counterexamples' and seed == 1")["wrongness"]
    np.testing.assert_allclose(margins, known, atol=1e-5)
    changed = result.examples("standard", 0)
    rows = changed.rows
    plain = jax.vmap(render)(TASK.space.features_of({n: rows[n].to_numpy() for n in rows}))
    assert np.abs(changed.inputs - np.asarray(plain)).max() > 0.05
    for arm in ("standard", "counterexamples"):
        picture = tmp_path / f"{arm}.png"
        result.montage(picture, arm, seed=1, count=20)
        assert picture.stat().st_size > 5000
