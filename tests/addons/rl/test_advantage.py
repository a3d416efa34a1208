import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.rl.advantage import Ends, advantages

NONE = jnp.zeros(3, bool)


def estimate(terminated=NONE, truncated=NONE, gae_lambda=0.5):
    return np.asarray(
        advantages(
            reward=jnp.array([1.0, 2.0, 3.0]),
            value=jnp.array([10.0, 20.0, 30.0]),
            next_value=jnp.array([20.0, 30.0, 40.0]),
            ends=Ends(terminated, truncated),
            discount=0.5,
            gae_lambda=gae_lambda,
        )
    )


# By hand: delta = r + 0.5 next_value - value = [1, -3, -7], then A_t = delta_t + 0.25 A_{t+1}.


def test_going_on():
    np.testing.assert_allclose(estimate(), [1 + 0.25 * -4.75, -3 + 0.25 * -7, -7])


def test_termination_has_no_value_behind_it():
    # delta_1 = 2 - 20, and step 0 still sees it; step 1 sees nothing of step 2.
    got = estimate(terminated=jnp.array([False, True, False]))
    np.testing.assert_allclose(got, [1 + 0.25 * -18, -18, -7])


def test_truncation_keeps_the_value_of_the_state_it_cut_off():
    got = estimate(truncated=jnp.array([False, True, False]))
    np.testing.assert_allclose(got, [1 + 0.25 * -3, -3, -7])


def test_terminated_at_the_time_limit_is_terminated():
    both = jnp.array([False, True, False])
    np.testing.assert_allclose(estimate(both, both), estimate(both))


@pytest.mark.parametrize(("gae_lambda", "first"), [(0.0, 1.0), (1.0, 1 - 1.5 - 1.75)])
def test_extremes_of_lambda(gae_lambda, first):
    # 0: the one-step error. 1: discounted rewards and last value, less the value.
    assert estimate(gae_lambda=gae_lambda)[0] == pytest.approx(first)
    if gae_lambda == 1:
        assert first == pytest.approx(1 + 0.5 * 2 + 0.25 * 3 + 0.125 * 40 - 10)
