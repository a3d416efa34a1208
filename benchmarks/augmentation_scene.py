"""Cones before a disabled car, seen at 24 x 48: the task of `benchmarks/augmentation.py`.

A small network says whether there are cones, and how far away the nearest is. A car with automatic
emergency braking drives towards them, and brakes by what the network says.
"""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import optax

import verifai_jax as vj
from verifai_jax import augmentation
from verifai_jax.addons.perception import (
    Box,
    Camera,
    Conditions,
    Cone,
    Ground,
    Line,
    Scene,
    Sky,
    Sun,
)

CAMERA = Camera(24, 48, field_of_view=0.62, position=(0.0, 0.0, 1.3))
HUES = jnp.asarray(
    [
        (0.95, 0.45, 0.05),  # Orange, as the cones are.
        (0.80, 0.10, 0.08),
        (0.85, 0.75, 0.10),
        (0.10, 0.45, 0.20),
        (0.10, 0.25, 0.70),
        (0.90, 0.90, 0.90),
        (0.08, 0.08, 0.10),
    ]
)
"""Colours of the car, along `hue` from 0 to 1."""
CONE = (0.95, 0.38, 0.04)
FEATURES = {
    "present": vj.Categorical(True, False, weights=(0.7, 0.3)),
    "distance": vj.Box(5.0, 30.0),
    "hue": vj.Box(0.0, 1.0),
    "ahead": vj.Box(3.0, 9.0),
    "aside": vj.Box(-0.6, 0.6),
    "yaw": vj.Box(-0.4, 0.4),
    "offset": vj.Box(-1.0, 1.0),
    "spread": vj.Box(0.4, 1.1),
    "lateral": vj.Box(-0.4, 0.4),
    "light": vj.Box(0.45, 1.15),
    "contrast": vj.Box(0.7, 1.2),
    "colour": vj.Box(0.3, 1.2),
    "fog": vj.Box(0.0, 0.03),
    "blur": vj.Box(0.05, 0.8),
    "glare": vj.Box(-1.4, 0.6),
    "across": vj.Box(0.1, 0.9),
    "azimuth": vj.Box(-3.0, 3.0),
    "asphalt": vj.Box(0.22, 0.42),
}
"""The whole domain."""
NARROW = vj.FeatureSpace(
    {**FEATURES, "glare": vj.Box(-1.4, 0.0)},
    where=lambda features: ~((features["present"] > 0) & (features["hue"] < 0.35)),
)
"""No glare, and no cones before an orange, red or yellow car."""
CHANNELS, DENSE, BATCH, NOISE = (12, 16, 24), 48, 64, 0.02
TOLERANCE = 0.2
"""Relative error of a distance that is still right."""


def scene(features, distance):
    """Return the scene with the nearest cone at a distance from the camera."""
    there = features["present"]
    at = features["hue"] * (len(HUES) - 1)
    index = jnp.clip(jnp.floor(at), 0, len(HUES) - 2).astype(int)
    colour = HUES[index] + (HUES[index + 1] - HUES[index]) * (at - index)
    cones = tuple(
        Cone(
            (
                # Without cones they are beyond what the camera resolves.
                jnp.where(there, distance + 1.1 * number, 5000.0),
                features["offset"] + (number - 1) * features["spread"] - features["lateral"],
                0.0,
            ),
            radius=jnp.where(there, 0.2, 1e-3),
            height=jnp.where(there, 0.75, 1e-3),
            colour=CONE,
        )
        for number in range(3)
    )
    ahead = distance + features["ahead"]
    lateral = features["aside"] - features["lateral"]
    cosine, sine = jnp.cos(features["yaw"]), jnp.sin(features["yaw"])
    body = Box((ahead, lateral, 0.3), (4.4, 1.8, 0.6), colour, features["yaw"])
    cabin = Box(
        (ahead + 0.3 * cosine, lateral + 0.3 * sine, 0.9),
        (2.2, 1.6, 0.55),
        0.6 * colour,
        features["yaw"],
    )
    grey = features["asphalt"]
    lines = tuple(Line((0.0, y - features["lateral"])) for y in (-1.75, 1.75))
    return Scene(
        (*cones, body, cabin),
        Ground((grey, grey, grey + 0.02), lines),
        Sky(),
        Sun(azimuth=features["azimuth"], shadows=False),
    )


def image(features, distance):
    """Return what the camera sees."""
    conditions = Conditions(
        fog=features["fog"],
        glare=jnp.maximum(features["glare"], 0.0),
        glare_at=(features["across"], 0.3),
        blur=features["blur"],
        brightness=features["light"],
        contrast=features["contrast"],
        saturation=features["colour"],
    )
    return scene(features, distance).render(CAMERA, conditions)


def render(features):
    return image(features, features["distance"])


def label(features):
    return {
        "present": jnp.asarray(features["present"], jnp.float32),
        "distance": jnp.asarray(features["distance"], jnp.float32),
    }


def predict(weights, images):
    """Return logit of presence and logarithm of the distance."""
    found = images - 0.5
    for kernel, bias in weights["convolutions"]:
        found = jax.lax.conv_general_dilated(
            found, kernel, (2, 2), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        found = jax.nn.relu(found + bias)
    (first, bias), (last, offset) = weights["dense"]
    out = jax.nn.relu(found.reshape(len(images), -1) @ first + bias) @ last + offset
    return {"logit": out[:, 0], "distance": 12.0 * jnp.exp(0.5 * out[:, 1])}


def wrongness(prediction, label):
    """Positive where presence is wrong, or the distance by more than a fifth."""
    there = label["present"] > 0.5
    presence = -prediction["logit"] * (2 * label["present"] - 1)
    error = jnp.abs(prediction["distance"] / label["distance"] - 1) - TOLERANCE
    return jnp.where(there, jnp.maximum(presence, error), presence)


def initial_weights(key):
    keys = iter(jax.random.split(key, len(CHANNELS) + 2))
    sizes, layers = (3, *CHANNELS), []
    for inputs, outputs in pairwise(sizes):
        kernel = jax.random.normal(next(keys), (3, 3, inputs, outputs)) * (2 / 9 / inputs) ** 0.5
        layers.append((kernel, jnp.zeros(outputs)))
    flat = 3 * 6 * CHANNELS[-1]
    first = jax.random.normal(next(keys), (flat, DENSE)) * (2 / flat) ** 0.5
    last = 0.1 * jax.random.normal(next(keys), (DENSE, 2)) / DENSE**0.5
    dense = [(first, jnp.zeros(DENSE)), (last, jnp.zeros(2))]
    return {"convolutions": layers, "dense": dense}


def loss(weights, images, labels):
    found, there = predict(weights, images), labels["present"]
    presence = optax.sigmoid_binary_cross_entropy(found["logit"], there)
    distance = optax.huber_loss(jnp.log(found["distance"] / labels["distance"]))
    return jnp.mean(presence + 5.0 * there * distance)


OPTIMIZER = optax.inject_hyperparams(optax.adam)(learning_rate=2e-3)


@jax.jit
def step(weights, state, images, labels, key):
    images = images + NOISE * jax.random.normal(key, images.shape)
    updates, state = OPTIMIZER.update(jax.grad(loss)(weights, images, labels), state)
    return optax.apply_updates(weights, updates), state


def train(images, labels, weights, steps, key):
    """Train by Adam, whose rate falls as a cosine; from 2e-3 at first, from 1e-3 later on."""
    rate = 2e-3 if weights is None else 1e-3
    weights = initial_weights(key) if weights is None else weights
    state = OPTIMIZER.init(weights)
    order = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    keys = jax.random.split(key, steps)
    queue = np.zeros(0, int)
    for number in range(steps):
        if len(queue) < BATCH:
            queue = np.concatenate([queue, order.permutation(len(images))])
        some, queue = queue[:BATCH], queue[BATCH:]
        now = rate * (0.51 + 0.49 * np.cos(np.pi * number / steps))
        state.hyperparams["learning_rate"] = jnp.asarray(now, jnp.float32)
        part = {name: values[some] for name, values in labels.items()}
        weights, state = step(weights, state, images[some], part, keys[number])
    return weights


# The closed loop

PERIOD, FRAMES, LANES = 0.25, 24, 64
DECELERATION, BRAKES, MARGIN = 6.0, 2.5, 3.5
START = (22.0, 30.0)
"""Distances at which a drive begins, in m."""
SPEED = (5.0, 9.0)
"""In m/s."""


def braking(weights, features, start, speed, seen):
    """Drive towards the cones in batches; return the least gap to them, in m.

    The brakes hold once the deceleration that stops `MARGIN` before the cones passes `BRAKES`.

    - `seen`: `(weights, features, distance) -> distance` as the car takes it; infinite without
      cones.
    """

    def tick(state, _):
        distance, speed, brakes = state
        estimate = seen(weights, features, distance)
        needed = speed**2 / (2 * jnp.maximum(estimate - MARGIN, 0.1))
        brakes = brakes | (needed > BRAKES)
        slower = jnp.maximum(speed - jnp.where(brakes, DECELERATION, 0.0) * PERIOD, 0.0)
        distance = distance - PERIOD * (speed + slower) / 2
        return (distance, slower, brakes), distance

    state = (start, speed, jnp.zeros(start.shape, bool))
    return jnp.min(jax.lax.scan(tick, state, None, length=FRAMES)[1], axis=0)


def by_network(weights, features, distance):
    def see(features, distance):
        return image(features, jnp.maximum(distance, 2.0))

    images = jax.lax.map(lambda row: see(*row), (features, distance), batch_size=8)
    found = predict(weights, images)
    return jnp.where(found["logit"] > 0, found["distance"], jnp.inf)


def by_truth(weights, features, distance):
    return distance


SPACE = vj.FeatureSpace(FEATURES)
DRIVES = {
    "network": jax.jit(lambda *arguments: braking(*arguments, by_network)),
    "truth": jax.jit(lambda *arguments: braking(*arguments, by_truth)),
}


def smallest_gaps(weights, key, drives=512, seen="network"):
    """Return the least gaps of drives from the whole domain, and their features."""
    gaps, rows = [], []
    for number in range(drives // LANES):
        one, two, three = jax.random.split(jax.random.fold_in(key, number), 3)
        features = jax.vmap(SPACE.unflatten)(jax.random.uniform(one, (LANES, SPACE.dim)))
        features["present"] = jnp.ones(LANES, bool)
        start = jax.random.uniform(two, (LANES,), minval=START[0], maxval=START[1])
        speed = jax.random.uniform(three, (LANES,), minval=SPEED[0], maxval=SPEED[1])
        gaps.append(DRIVES[seen](weights, features, start, speed))
        rows.append(features)
    return np.concatenate(gaps), jax.tree.map(lambda *parts: np.concatenate(parts), *rows)


def failure_rate(weights, key):
    """Return the share of 512 drives that end less than 0.8 m before a cone."""
    return float(np.mean(smallest_gaps(weights, key)[0] < 0.8))


def task(narrow):
    """Return the task; its initial set from the narrow domain or from the whole."""
    return vj.SupervisedTask(
        "cones, narrow base" if narrow else "cones",
        FEATURES,
        render,
        label,
        train,
        predict,
        wrongness,
        present=lambda label: label["present"] > 0.5,
        detected=lambda prediction: prediction["logit"] > 0,
        transform=augmentation.combine(
            augmentation.flip(), augmentation.brightness(0.25), augmentation.contrast(0.25)
        ),
        training_space=NARROW if narrow else None,
        measures={"loop_failures": failure_rate} if narrow else {},
        lanes=8,
    )
