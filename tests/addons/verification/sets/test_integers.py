"""Whole numbers stay in their sets, whatever wraps around, and are refused by name otherwise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_integers import ONE, escapes

from verifai_jax.addons.verification.sets import Form, Interpreter, MissingRule, Whole


def ends(function, low, high, kind="int32", x64=False):
    """Return the ends of a function's set over one box of an array of integers."""
    with jax.enable_x64(x64):
        kind = np.dtype(kind)
        low, high = np.array([low], np.int64), np.array([high], np.int64)
        form = jax.ShapeDtypeStruct(low.shape[1:], kind)
        (value,) = Interpreter(1, 1)(jax.make_jaxpr(function)(form), [Whole(low, high, kind)])
        return np.squeeze(value.low).tolist(), np.squeeze(value.high).tolist()


FULL = -(2**31), 2**31 - 1


@pytest.mark.parametrize(
    ("function", "low", "high", "expected"),
    [
        (jnp.sum, [2**30, 2**30], [2**30, 2**30 + 1], FULL),
        (jnp.sum, [-5, 2], [3, 4], (-3, 7)),
        (jnp.prod, [1000, 1000, 1000], [2000, 2000, 2000], FULL),
        (jnp.prod, [-2, 3], [1, 5], (-10, 5)),
        (lambda x: jnp.dot(x, x[::-1]), [2**16, 1], [2**16, 2**16], FULL),
        (lambda x: jnp.cumsum(x)[1], [2**31 - 2, 0], [2**31 - 2, 2], FULL),
        (lambda x: x[0] ** 3, [-3], [2], (-27, 8)),
        (lambda x: x[0] ** 4, [-3], [400], FULL),
        (lambda x: jnp.abs(x[0]), [-(2**31)], [0], FULL),
        (lambda x: jax.lax.div(x[0], x[1]), [6, 2], [9, 3], (2, 4)),
        (lambda x: jax.lax.div(x[0], x[1]), [-9, -1], [9, 1], FULL),
        (lambda x: jax.lax.div(x[0], x[1]), [-(2**31), -1], [-5, -1], FULL),
        (lambda x: x[0] & x[1], [-4, 5], [9, 7], (0, 7)),
        (lambda x: x[0].astype("int8"), [0], [127], (0, 127)),
        (lambda x: x[0].astype("int8"), [0], [128], (-128, 127)),
        (lambda x: (x[0] * 1e9).astype("int32"), [2], [3], FULL),
        (lambda x: (x[0] * 0.5).astype("uint8"), [0], [9], (0, 4)),
        (lambda x: (x[0] * 0.5).astype("uint8"), [-9], [9], (0, 255)),
        (lambda x: x[0] > x[1], [-(2**31), 2**31 - 1], [-(2**31), 2**31 - 1], (0, 0)),
    ],
)
def test_what_may_leave_its_type_is_any_number_of_it(function, low, high, expected):
    assert ends(function, low, high) == expected


def test_whole_numbers_of_64_bits_are_bounded_too():
    full = -(2**63), 2**63 - 1
    assert ends(jnp.prod, [2**40, 2**10], [2**41, 2**10], "int64", True) == (2**50, 2**51)
    assert ends(jnp.prod, [2**40, 2**30], [2**41, 2**30], "int64", True) == full
    assert ends(lambda x: x[0] - x[1], [-(2**62), 0], [0, 2**62], "int64", True) == full
    with pytest.raises(MissingRule, match=r"64 bits without a sign, by the operation convert"):
        ends(lambda x: x.astype("uint64"), [1], [2], "int64", True)


@pytest.mark.parametrize(
    ("function", "operation"),
    [(lambda x: x << 2, "shift_left"), (jax.lax.population_count, "population_count"),
     (lambda x: jax.lax.reduce_and(x, (0,)), "reduce_and"),
     (lambda x: jnp.zeros(4, int).at[x].add(1), "scatter-add")],
)  # fmt: skip
def test_an_operation_without_a_rule_is_named(function, operation):
    with pytest.raises(MissingRule, match=operation):
        ends(function, [1, 2], [3, 4])


def test_a_count_of_threshold_crossings_wraps_as_in_the_machine():
    def count(x):
        return jnp.sum((x > jnp.linspace(0, 1, 130)).astype(jnp.int8), dtype=jnp.int8)

    program = jax.make_jaxpr(count)(jax.ShapeDtypeStruct((), jnp.float32))
    unit = Form.leaf(np.array([0.0, 0.0]), np.array([0.5, 1.0]), np.ones(1), np.dtype("float32"))
    (value,) = Interpreter(2, 1)(program, [unit])
    assert (value.low.tolist(), value.high.tolist()) == ([0, -128], [65, 127])


@pytest.mark.slow
@pytest.mark.parametrize("block", range(4))
def test_random_programs_of_whole_numbers_contain_their_values(block):
    """Measured on 700 programs: none escapes."""
    found = [text for seed in range(12) for text in escapes(12 * block + seed)]
    assert [text for text in found if not text.startswith("refused")] == []
    assert len(ONE) > 30
