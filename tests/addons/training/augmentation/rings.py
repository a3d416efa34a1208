"""A tiny task without images: a small network learns which points lie in a ring."""

from functools import cache

import jax
import jax.numpy as jnp

import verifai_jax as vj

WIDTH, STEPS, BATCH = 12, 120, 32


def inside(features):
    """The label: 1 in the ring, 0 elsewhere."""
    radius = jnp.hypot(features["x"], features["y"])
    return jnp.where((radius > 0.35) & (radius < 0.8), 1.0, 0.0)


def point(features):
    """The input: the two coordinates."""
    return jnp.stack([features["x"], features["y"]])


def logits(weights, inputs):
    (first, bias), (second, offset) = weights
    return (jnp.tanh(inputs @ first + bias) @ second + offset)[:, 0]


def wrongness(logit, label):
    """Positive where the sign of the logit is wrong."""
    return -logit * (2 * label - 1)


@cache
def descent():
    """Gradient descent with momentum over batches `[steps, batch]`, compiled once."""

    def loss(weights, inputs, labels):
        return jnp.mean(jax.nn.softplus(wrongness(logits(weights, inputs), labels)))

    def step(state, batch):
        weights, speed = state
        speed = jax.tree.map(lambda v, g: 0.9 * v - 0.1 * g, speed, jax.grad(loss)(weights, *batch))
        return (jax.tree.map(jnp.add, weights, speed), speed), None

    @jax.jit
    def run(weights, inputs, labels):
        rest = jax.tree.map(jnp.zeros_like, weights)
        return jax.lax.scan(step, (weights, rest), (inputs, labels))[0][0]

    return run


def train(inputs, labels, weights, steps, key):
    """Train in portions of one length, so that one program serves all sets."""
    if weights is None:
        one, two = jax.random.split(key)
        first = 2.0 * jax.random.normal(one, (2, WIDTH))
        second = jax.random.normal(two, (WIDTH, 1)) / WIDTH**0.5
        weights = ((first, jnp.zeros(WIDTH)), (second, jnp.zeros(1)))
    for number in range(steps // STEPS):
        places = jax.random.randint(jax.random.fold_in(key, number), (STEPS, BATCH), 0, len(inputs))
        weights = descent()(weights, inputs[places], labels[places])
    return weights


def rings(name="rings", **options):
    """Return the task."""
    parts = {
        "space": {"x": vj.Box(-1, 1), "y": vj.Box(-1, 1)},
        "render": point,
        "label": inside,
        "train": train,
        "predict": logits,
        "wrongness": wrongness,
        "present": lambda label: label > 0.5,
        "detected": lambda logit: logit > 0,
    }
    return vj.SupervisedTask(name, **{**parts, **options})


SMALL = {
    "initial": 64,
    "added": 24,
    "steps": (5 * STEPS, 5 * STEPS),
    "budget": 256,
    "test": 512,
    "hard": 64,
}
"""Options of a study that takes a second."""
