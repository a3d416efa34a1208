"""A change that is made where a lane of a batch needs it, and costs nothing elsewhere."""

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.systems.any_lane import changed_if_needed


def changed(needed, value, by):
    return changed_if_needed(lambda value, by: value + by, needed, value, by)


def test_it_is_made_in_all_lanes_where_one_needs_it_and_in_none_elsewhere():
    by, value = jnp.array([0.0, 3.0]), jnp.array([1.0, 1.0])
    # By the contract a lane that needs none has a change that changes nothing.
    made = jax.vmap(changed)(jnp.array([False, True]), value, by)
    left = jax.vmap(changed)(jnp.array([False, False]), value, by)
    assert np.array_equal(made, [1, 4])
    assert np.array_equal(left, [1, 1])
    assert changed(jnp.array(True), value[0], by[1]) == 4


def test_derivatives_are_those_of_the_change_where_none_needs_it_too():
    for mode in (jax.jacfwd, jax.jacrev):
        slope = mode(lambda by: changed(jnp.array(False), jnp.float32(1), by))(jnp.float32(2))
        assert slope == 1
