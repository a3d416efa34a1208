"""Train the networks shipped as `cones_wide.npz` and `cones_narrow.npz`.

The same seed gives the same weights.

    python -m envs.train_cones
    python -m envs.train_cones narrow --seed 3 --steps 500 --out my_network.npz

`wide` sees all that the camera may see in the problems of specs/cones.py, `narrow` no car whose
colour is near that of the cones, and no glare. Nothing is written, and the exit status is 1, if a
network did not learn what it was shown.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from envs.cones import (
    NETWORKS,
    NOTHING,
    ORANGE,
    SCENERY,
    WEATHER,
    Pose,
    distance_of_nearest,
    render,
)
from verifai_jax.addons.perception import Detector, Labels, Score, score, train_detector
from verifai_jax.features import Box, Categorical, FeatureSpace

ROAD = {
    "ahead": Box(3.0, 36.0),
    "offset": Box(-0.5, 0.5),
    "heading": Box(-0.08, 0.08),
    "present": Categorical(0, 1, weights=(0.3, 0.7)),
}
"""Where the camera is, and whether there are cones."""

SPACES = {
    "wide": FeatureSpace({**SCENERY, **WEATHER, **ROAD}),
    "narrow": FeatureSpace(
        {**SCENERY, **WEATHER, **ROAD, "car_hue": Box(ORANGE + 0.03, 0.8), "glare": Box(-0.7, 0.0)}
    ),
}
IMAGES = {"wide": 6000, "narrow": 3000}
STEPS = {"wide": 1500, "narrow": 800}
TOLERANCE = float(np.log(1.2))
"""A distance that is wrong by a fifth counts as wrong."""
LEARNED = 0.15
"""Share of wrong judgements on images like those of its training at which it has learned."""


def example(features: dict) -> tuple[Float[Array, "height width 3"], Labels]:
    """Render one image, and return it with its label: the logarithm of the distance."""
    pose = Pose(-features["ahead"], features["offset"], features["heading"])
    present = features["present"] > 0
    distance = distance_of_nearest(features, pose)
    seen = present & (distance < NOTHING)
    return render(features, pose, present), Labels(seen, jnp.log(distance)[None])


_examples = jax.jit(lambda features: jax.lax.map(example, features, batch_size=8))


def data(space: str, count: int, seed: int) -> tuple[Float[np.ndarray, "n h w 3"], Labels]:
    """Return labelled images drawn from one of `SPACES`."""
    features = SPACES[space].sample(jax.random.key(seed), count)
    return jax.device_get(_examples(features))


def trained(
    name: str, *, seed: int = 0, steps: int | None = None, images: int | None = None
) -> Detector:
    """Return a network trained on images of one of `SPACES`."""
    images_of, labels = data(name, images or IMAGES[name], 1000 + seed)
    network, _ = train_detector(images_of, labels, steps=steps or STEPS[name], seed=seed)
    return network


def quality(network: Detector, space: str, count: int = 3000, seed: int = 1) -> Score:
    """Return the score of a network on images that it was not trained on."""
    return score(network, *data(space, count, seed), tolerance=TOLERANCE)


def main(arguments: list[str] | None = None) -> int:
    """Train, test, write the weights, and return the exit status."""
    from verifai_jax.addons.perception import save_detector

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("names", nargs="*", default=list(NETWORKS), metavar="wide|narrow")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--out", type=Path, help="the file, where one network is named")
    chosen = parser.parse_args(arguments)
    if unknown := set(chosen.names) - set(NETWORKS):
        parser.error(f"there is no network {', '.join(sorted(unknown))}; there are wide and narrow")
    if chosen.out and len(chosen.names) != 1:
        parser.error("--out is the file of one network: name wide or narrow")
    for name in chosen.names:
        started = time.perf_counter()
        network = trained(name, seed=chosen.seed, steps=chosen.steps)
        seconds = time.perf_counter() - started
        own = quality(network, name)
        print(f"{name}: {network.weights} weights in {seconds:.1f} s; on its own images, {own}")
        print(f"  on all images, {quality(network, 'wide')}")
        if own.error_rate > LEARNED:
            print(f"not learned: {LEARNED:.0%} wrong at most; nothing written")
            return 1
        save_detector(chosen.out or NETWORKS[name], network)
        print(f"weights written to {chosen.out or NETWORKS[name]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
