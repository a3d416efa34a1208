import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.systems import blackbox
from verifai_jax.trace import Trace


def test_features_arrive_as_plain_values():
    seen = {}

    def simulate(features):
        seen.update(features)
        return Trace({"x": np.ones(3)}, dt=0.1)

    system = blackbox(simulate)
    trace = system({"a": jnp.float32(0.5), "n": np.int32(2), "v": jnp.ones(2), "s": "red"}, None)
    assert system.black_box
    assert trace.length == 3
    assert type(seen["a"]) is float
    assert type(seen["n"]) is int
    assert type(seen["v"]) is np.ndarray
    assert seen["s"] == "red"


def test_seed_is_a_function_of_the_key():
    system = blackbox(lambda f, seed: Trace({"seed": np.array([seed])}, dt=1.0), seeded=True)
    seeds = [int(system({}, jax.random.key(i))["seed"][0]) for i in (0, 0, 1)]
    assert seeds[0] == seeds[1] != seeds[2]
    assert int(system({}, 7)["seed"][0]) == 7


def test_refuses_what_cannot_be_called():
    with pytest.raises(ValueError, match=r"needs a function \(features\) -> Trace; got 3"):
        blackbox(3)  # pyright: ignore[reportArgumentType]
