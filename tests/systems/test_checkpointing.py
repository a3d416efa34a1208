import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.systems.checkpointing import MAX_PLAIN_STEPS, checkpointed_scan


def step(carry, k):
    carry = 0.99 * carry + 0.01 * jnp.sin(carry + 0.1 * k)
    return carry, {"carry": carry, "k": k}


@pytest.mark.thorough
@pytest.mark.parametrize("length", [5, 600, 613])
def test_is_one_scan(length):
    start = jnp.array([0.3, -1.0])

    def ends(scan):
        def last(start):
            carry, outputs = scan(start)
            return carry.sum() + outputs["carry"][length // 2].sum(), outputs

        (_, outputs), gradient = jax.value_and_grad(last, has_aux=True)(start)
        return outputs, gradient

    outputs, gradient = jax.jit(lambda: ends(lambda s: checkpointed_scan(step, s, length)))()
    wanted, slope = jax.jit(lambda: ends(lambda s: jax.lax.scan(step, s, jnp.arange(length))))()
    assert (length > MAX_PLAIN_STEPS) == (length != 5)
    np.testing.assert_array_equal(outputs["k"], np.arange(length))
    np.testing.assert_allclose(outputs["carry"], wanted["carry"], rtol=1e-6)
    np.testing.assert_allclose(gradient, slope, rtol=1e-5)


def test_keeps_less_for_the_way_back():
    def memory(scan):
        def last(start):
            return scan(start)[0].sum()

        start = jax.ShapeDtypeStruct((1000,), jnp.float32)
        return jax.jit(jax.grad(last)).lower(start).compile().memory_analysis().temp_size_in_bytes

    plain = memory(lambda s: jax.lax.scan(step, s, jnp.arange(2000)))
    assert memory(lambda s: checkpointed_scan(step, s, 2000)) < plain / 5
