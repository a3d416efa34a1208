"""The contract suite over systems of every kind, and over ones that break it."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from envs import cartpole
from verifai_jax.core.values.trace import Trace
from verifai_jax.systems.base import Outcome
from verifai_jax.testing import check_system

SPACE = vj.FeatureSpace({"x0": vj.Box(-1, 1), "theta0": vj.Box(-0.3, 0.3)})


def ramp(features, key):
    return Trace({"x": features["x0"] * jnp.linspace(0, 1, 5)}, dt=0.25)


@pytest.mark.slow
def test_ode():
    check_system(cartpole.cartpole(duration=1.0, terminate=True), SPACE)


def test_black_boxes():
    check_system(vj.blackbox(lambda f: Trace({"x": np.full(3, f["x0"])}, dt=1.0)), SPACE)

    def whole(features, seeds):
        return vj.stack_traces({"x": np.repeat(features["x0"][:, None], 3, axis=1)}, dt=1.0)

    check_system(vj.blackbox(whole, vectorised=True, seeded=True), SPACE)


class Host:
    black_box: ClassVar[bool] = True

    def __call__(self, features, key=None):
        return ramp(features, key)

    def simulate_each(self, features, seeds):
        for i in reversed(range(len(features))):
            yield i, Outcome(ramp(features[i], seeds[i]))


class Twice(Host):
    def simulate_each(self, features, seeds):
        for i in range(len(features) - 1):
            yield i, Outcome(ramp(features[i], seeds[i]))


class Other(Host):
    def simulate_batch(self, features, keys):
        return jax.vmap(lambda f, k: ramp({"x0": 2 * f["x0"]}, k))(features, keys)


class WrongForm(Host):
    def abstract(self, features):
        return jax.eval_shape(lambda: Trace({"x": jnp.zeros(9)}, dt=0.25))


def test_host_system():
    check_system(Host(), SPACE)


CALLS = iter(range(100))


@pytest.mark.parametrize(
    ("system", "law"),
    [
        (lambda f, key: 3, "must return a Trace; got int"),
        (lambda f, key: Trace({"x": jnp.ones(2) * next(CALLS)}, dt=1.0), "same trace for the same"),
        (Twice(), "each of 4 indices once; got"),
        (Other(), "in a batch, and called alone: signal 'x' differs by"),
        (WrongForm(), r"abstract must give the signals' shapes \{'x': \(5,\)\}; got"),
        (
            lambda f, key: dataclasses.replace(ramp(f, key), valid=jnp.int32(2), held=True),
            "must repeat its last valid sample; 'x' does not",
        ),
        (
            lambda f, key: dataclasses.replace(
                ramp({"x0": f["x0"] * jnp.inf}, key), finite=("x",)
            ),
            "signal 'x' is vouched for as finite and is not",
        ),
    ],
)  # fmt: skip
def test_what_breaks_it_is_named(system, law):
    with pytest.raises(AssertionError, match=law):
        check_system(system, SPACE)
