import jax
import numpy as np
import pytest

from verifai_jax.addons.rl.on_policy import permutation


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2, 96, 1024, 1600, 2048])
def test_the_orders_of_jax(n):
    keys = jax.random.split(jax.random.key(7), 100)
    ours = jax.jit(lambda keys: jax.lax.map(lambda key: permutation(key, n), keys))(keys)
    theirs = jax.jit(jax.vmap(lambda key: jax.random.permutation(key, n)))(keys)
    np.testing.assert_array_equal(ours, theirs)


def test_equal_keys(monkeypatch):
    draw = jax.random.bits
    monkeypatch.setattr(jax.random, "bits", lambda *arguments: draw(*arguments) >> 24)
    order = np.asarray(permutation(jax.random.key(0), 1000))
    assert sorted(order.tolist()) == list(range(1000))
