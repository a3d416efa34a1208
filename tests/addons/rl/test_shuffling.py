import itertools

import jax
import numpy as np
import pytest
from scipy import stats

from verifai_jax.addons.rl.on_policy import permutation


def orders(n, count):
    keys = jax.random.split(jax.random.key(7), count)
    return np.asarray(jax.jit(jax.vmap(lambda key: permutation(key, n)))(keys))


def test_each_order_is_as_frequent():
    found = [*map(tuple, orders(4, 24_000).tolist())]
    counts = [found.count(order) for order in itertools.permutations(range(4))]
    assert sum(counts) == len(found)
    assert stats.chisquare(counts).pvalue > 1e-3


@pytest.mark.thorough
@pytest.mark.parametrize("n", [1, 2, 96, 1024])
def test_each_number_is_as_frequent_in_each_position(n):
    found = orders(n, 2048)
    assert (np.sort(found, axis=1) == np.arange(n)).all()
    # The mean position of each number, in standard deviations.
    positions = np.argsort(found, axis=1).mean(axis=0)
    spread = np.sqrt((n**2 - 1) / 12 / len(found)) or 1.0
    assert np.abs(positions - (n - 1) / 2).max() < 5 * spread


def test_equal_keys(monkeypatch):
    draw = jax.random.bits
    monkeypatch.setattr(jax.random, "bits", lambda *arguments: draw(*arguments) >> 24)
    order = np.asarray(permutation(jax.random.key(0), 1000))
    assert sorted(order.tolist()) == list(range(1000))
