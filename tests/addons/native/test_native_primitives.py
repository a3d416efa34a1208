"""Every translated primitive against XLA, on usual numbers and on unusual ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax import lax

from verifai_jax.addons.native.native_code.library import library_name, load
from verifai_jax.addons.native.native_code.source import translate
from verifai_jax.addons.native.native_code.values import Untranslatable
from verifai_jax.systems.any_lane import changed_if_needed

pytestmark = pytest.mark.thorough

KEY = np.array([3, 7], np.uint32)
ODD = [0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-30, 2.0**31, -(2.0**31), 0.5,
       -0.5, 1.5, 2.5, -2.5, 88.5, -87.0, 89.5, 1e-8, 0.7071, 3.0, 50.25]  # fmt: skip


def rows_of(d, count=512):
    """Return rows of ordinary numbers, the first ones with unusual ones."""
    rng = np.random.default_rng(0)
    rows = (rng.normal(size=(count, d)) * rng.choice([0.3, 2, 30], (count, 1))).astype(np.float32)
    for i, (a, b) in enumerate(np.stack(np.meshgrid(ODD, ODD), -1).reshape(-1, 2)[: count // 2]):
        rows[i, : min(d, 2)] = [a, b][:d]
    return rows


def forms(d):
    return (
        jax.ShapeDtypeStruct((d,), jnp.float32),
        jax.ShapeDtypeStruct((2,), jnp.uint32),
        jax.ShapeDtypeStruct((), jnp.int32),
        jax.ShapeDtypeStruct((), jnp.float32),
        jax.ShapeDtypeStruct((4,), jnp.float32),
    )


def bits(value):
    value = jnp.asarray(value)
    value = value.astype(jnp.uint32) if value.dtype == bool else value.view(jnp.uint32)
    return value.ravel()


def both(function, d, name, rows=None):
    """Return what a function of (row, key words, number) gives natively and by XLA, as float."""

    def packed(row, words, number, temperature, numbers):
        results = jax.tree.leaves(function(row, words, number, temperature, numbers))
        return jnp.concatenate([bits(each) for each in results])

    program = jax.make_jaxpr(packed)(*forms(d))
    (form,) = program.out_avals
    library = load(library_name(name), form.shape[0], lambda: translate(program))
    rows = rows_of(d) if rows is None else rows
    numbers, warm = np.arange(4, dtype=np.float32), np.linspace(0, 1, len(rows), dtype=np.float32)
    ours = library(rows, KEY, 5, warm, numbers, 2)
    axes = (0, None, 0, 0, None)
    theirs = jax.jit(jax.vmap(packed, axes))(rows, KEY, 5 + jnp.arange(len(rows)), warm, numbers)
    return np.asarray(ours), np.asarray(theirs), program


def check(function, d, name, ulps=0, rows=None):
    """Compare all results: the same NaN, the same infinities, and close numbers."""
    ours, theirs, _ = both(function, d, name, rows)
    with np.errstate(invalid="ignore"):
        a, b = (each.view(np.float32).astype(float) for each in (ours, theirs))
    exact = ours == theirs
    missing = np.isnan(a) & np.isnan(b)
    with np.errstate(invalid="ignore", over="ignore"):
        close = np.abs(a - b) <= ulps * (np.spacing(np.abs(b).astype(np.float32)) + 1e-37)
    wrong = ~(exact | missing | (close if ulps else (a == b)))
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise AssertionError(
            f"{wrong.sum()} of {wrong.size}: row {row}, result {column}: "
            f"{a[row, column]!r} instead of {b[row, column]!r}"
        )


def test_unary_functions():
    def function(row, *_):
        x, small = row[0], jnp.tanh(row[1])
        return (
            jnp.abs(x), -x, jnp.sign(x), jnp.floor(x), jnp.ceil(x), jnp.round(x),
            lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO), jnp.sqrt(x), lax.rsqrt(x),
            jnp.isfinite(x), x**2, x**3, lax.integer_pow(x, -2), lax.integer_pow(x, 0),
            lax.square(x), 1 / x, small * 0,
        )  # fmt: skip

    check(function, 2, "unary", 2)


def test_transcendental_functions():
    def function(row, *_):
        x = row[0]
        return jnp.exp(x), jnp.log(x), jnp.tanh(x), jax.nn.sigmoid(x), jnp.arctan(x), jnp.log1p(x)

    check(function, 1, "transcendental", 16)


def test_trigonometric_functions():
    rows = np.concatenate([rows_of(1), np.float32([[1e5], [3e6], [np.pi], [np.pi / 2]])])

    def function(row, *_):
        near_zero = 1e-6
        sine, cosine = jnp.sin(row[0]), jnp.cos(row[0])
        return jnp.round(sine / near_zero), jnp.round(cosine / near_zero), jnp.isnan(sine)

    ours, theirs, _ = both(function, 1, "trigonometric", rows)
    a, b = ours[:, :2].view(np.float32), theirs[:, :2].view(np.float32)
    assert np.array_equal(np.isnan(a), np.isnan(b))
    assert np.array_equal(ours[:, 2], theirs[:, 2])
    assert np.nanmax(np.abs(a - b)) <= 1


def test_functions_of_a_restricted_range():
    def function(row, *_):
        x = jnp.clip(row[0], -3, 3)
        inside = x / 3.2
        return (
            jnp.arcsin(inside), jnp.arccos(inside), jnp.sinh(x), jnp.cosh(x), jnp.arcsinh(x),
            jnp.arctanh(inside), jnp.cbrt(x), lax.erf(x), jnp.exp2(x), jnp.tan(inside),
            jnp.arctan2(x, row[1]), lax.erf_inv(inside), jnp.arccosh(4 + x),
        )  # fmt: skip

    ours, theirs, _ = both(function, 2, "restricted")
    a, b = ours.view(np.float32), theirs.view(np.float32)
    assert np.array_equal(np.isnan(a), np.isnan(b))
    assert np.allclose(a, b, rtol=1e-5, atol=1e-6, equal_nan=True)


def test_powers():
    def function(row, *_):
        x, y = row
        return x**y, jnp.abs(x) ** 0.8, jnp.expm1(x)

    ours, theirs, _ = both(function, 2, "powers")
    a, b = ours.view(np.float32), theirs.view(np.float32)
    assert np.array_equal(np.isnan(a), np.isnan(b))
    with np.errstate(over="ignore"):
        assert np.allclose(a, b, rtol=1e-5, atol=1e-37, equal_nan=True)


def test_binary_functions_and_comparisons():
    def function(row, *_):
        x, y = row
        return (
            x + y, x - y, x * y, x / y, jnp.maximum(x, y), jnp.minimum(x, y), jnp.clip(x, -1.5, y),
            x < y, x <= y, x > y, x >= y, x == y, x != y, jnp.where(x < y, x, 2.0),
            jnp.where(x < 1, 3.0, y), lax.rem(x, y), jnp.nextafter(x, y), jnp.maximum(x, 1.0),
            jnp.minimum(0.0, y), (x < 1) & (y < 2), (x < 1) | ~(y < 2), (x < 1) ^ (y < 2),
        )  # fmt: skip

    check(function, 2, "binary", 1)


def test_what_does_not_change_in_a_loop_divides_by_its_reciprocal():
    def f(row, *_):
        return lax.scan(lambda x, n: (x + n, x / row[1]), row[0], jnp.arange(3.0))[1]

    # Numbers near the largest have a reciprocal that is too small to be normal.
    rows = rows_of(2)
    check(f, 2, "f9a", 1, rows[np.abs(rows[:, 1]) < 1e37])


def test_bounds_that_are_constants():
    def f(row, *_):
        x, y = row
        return (
            jnp.maximum(0.5, x), jnp.minimum(x, -0.5), jnp.clip(y, -1, 1), lax.clamp(-1.0, x, y),
            jnp.maximum(jnp.nan, x), jnp.minimum(x, y), jnp.maximum(x, y),
        )  # fmt: skip

    check(f, 2, "f9b")


def test_whole_numbers():
    rows = np.random.default_rng(1).integers(-9, 9, (256, 2)).astype(np.float32)

    def function(row, words, number, *_):
        a, b = row.astype(jnp.int32)
        u, v = row.astype(jnp.uint32)
        big = a * 123456789
        return (
            a + b, a - b, a * b, lax.div(a, b), lax.rem(a, b), jnp.maximum(a, b), lax.div(u, v),
            lax.rem(u, v), jnp.abs(a), jnp.sign(a), -a, a & b, a | b, a ^ b, ~a, a < b, a == b,
            jnp.clip(a, -2, b), big, big >> 3, lax.shift_right_logical(big, 3), a << 2, u >> 40,
            a.astype(jnp.float32), u.astype(jnp.float32), (a < b).astype(jnp.float32), a != 0,
            (a < b).astype(jnp.int32), number, words[1] + u, lax.select_n(
                jnp.clip(a, 0, 2), 1.0 * row[0], 2.0 * row[1], 3.0
            ), a // 3, a % 3,
        )  # fmt: skip

    check(function, 2, "whole", 0, rows)


def test_conversions_to_whole_numbers_saturate():
    check(lambda row, *_: (row[0].astype(jnp.int32), row[1].astype(bool)), 2, "saturate")


def test_arrays_are_moved():
    def function(row, words, number, temperature, numbers):
        m = jnp.outer(row, numbers[:3] + 1)
        return (
            m.T, m[::-1], m[1:, ::2], jnp.concatenate([m, m[:1]]), jnp.stack([row, row], 1),
            jnp.pad(row, (2, 1), constant_values=7.0), lax.pad(row, 9.0, [(1, -1, 2)]),
            m.reshape(-1), jnp.broadcast_to(row[:, None], (4, 2)), jnp.tile(row, 2),
            jnp.roll(row, 1),
            jnp.arange(5) + number, temperature, jnp.eye(4) * row,
        )  # fmt: skip

    check(function, 4, "moved", 1)


def test_sums_and_the_like():
    def function(row, *_):
        m = row.reshape(3, 4)
        return (
            m.sum(1), m.max(0), m.min(), m.prod(1), jnp.all(m > 0, 1), jnp.any(m > 0, 0),
            jnp.argmax(m, 1), jnp.argmin(row), jnp.cumsum(row[:3]), lax.cummax(row),
            lax.cummin(row, reverse=True), jnp.mean(m),
        )  # fmt: skip

    rows = np.round(rows_of(12, 256) * 4) / 4
    check(function, 12, "sums", 64, rows[100:])
    check(lambda row, *_: (row.max(), row.min(), jnp.argmax(row), jnp.argmin(row)), 12, "most", 0)


@pytest.mark.slow
def test_matrix_products():
    rng = np.random.default_rng(2)
    wide, narrow = rng.normal(size=(40, 36)).astype(np.float32), rng.normal(size=(36, 3))

    def function(row, *_):
        hidden = jnp.tanh(row @ wide[:6])
        more = jax.nn.relu(wide @ hidden)
        m = row.reshape(2, 3)
        return hidden @ narrow.astype(np.float32), more[:5], m @ m.T, jnp.outer(hidden, row).sum(0)

    ours, theirs, _ = both(function, 6, "products", rows_of(6)[300:])
    a, b = ours.view(np.float32), theirs.view(np.float32)
    assert np.allclose(a, b, rtol=1e-4, atol=1e-4)


def test_elements_by_number():
    table = jnp.asarray(np.random.default_rng(3).normal(size=40).astype(np.float32))

    def function(row, words, number, temperature, numbers):
        i = jnp.clip(row[0] * 10, -100, 100).astype(jnp.int32)
        long = jnp.concatenate([row] * 6)
        return (
            table[i], table[:7][i], row[i], long[i], long.at[i].set(0.0), row.at[i].add(2.0),
            lax.dynamic_slice(row, (i,), (2,)), lax.dynamic_update_slice(row, row[:2], (i,)),
            table.at[i].get(mode="fill", fill_value=5.0), numbers[i], row.reshape(2, 2)[:, i],
            jnp.round(jnp.interp(row[0], jnp.arange(7.0), table[:7]), 3),
            lax.dynamic_index_in_dim(table, i),
        )  # fmt: skip

    check(function, 4, "elements", 64, np.nan_to_num(rows_of(4), posinf=3, neginf=-3))


@pytest.mark.slow
def test_loops_and_branches():
    def function(row, words, number, temperature, numbers):
        def step(carry, x):
            y, k, line = carry
            y = jnp.where(y > 5, y * 0.5, y + x)
            extra = lax.cond(k % 3 == 0, lambda: jnp.sin(y), lambda: y * 0.25 + line[0])
            line = jnp.concatenate([y[None], line[:-1]])
            return (y, k + 1, line), (extra, line[-1])

        start = (row[0], jnp.int32(0), jnp.zeros(40))
        (y, k, line), (outs, last) = lax.scan(step, start, jnp.linspace(0, 1, 50))
        _, back = lax.scan(lambda c, x: (c + x, c * x), row[1], outs, reverse=True)
        nested = lax.fori_loop(
            0, 4, lambda i, c: lax.fori_loop(0, 3, lambda j, d: d * 0.9 + i - j, c), row[2]
        )
        halved = lax.while_loop(lambda v: v > 1, lambda v: v * 0.5, jnp.clip(row[3], 0, 100))
        counted = lax.while_loop(lambda v: v[0] < 5, lambda v: (v[0] + 1, v[1] + row[0]), (0, 0.0))
        once = changed_if_needed(lambda v, by: (v[0] * by, v[1]), row[0] > 0, (row[1], row), row[2])
        by_lane = lax.cond(row[0] > 0, lambda v: v * 2, lambda v: v - 1, row[1])
        chosen = lax.switch(
            jnp.clip(row[2], -1, 4).astype(int), [lambda v=v: row * v for v in (1.0, 2.0, 3.0)]
        )
        swapped = lax.fori_loop(0, 5, lambda i, ab: (ab[1], ab[0]), (row[0], row[1]))
        return (
            y,
            k,
            line[:3],
            outs,
            last[-3:],
            back,
            nested,
            halved,
            counted,
            by_lane,
            chosen,
            swapped,
            *jax.tree.map(lambda new, old: jnp.where(row[0] > 0, new, old), once, (row[1], row)),
        )

    rows = np.clip(np.nan_to_num(rows_of(4)), -50, 50)
    ours, theirs, _ = both(function, 4, "loops", rows)
    a, b = ours.view(np.float32), theirs.view(np.float32)
    assert np.array_equal(ours[:, 1], theirs[:, 1])
    assert np.allclose(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_branch_keeps_what_is_used_after_it():
    """A branch changes the memory of its loop as it lies, where nothing else needs the old one."""

    def pushed(line, new):
        return jnp.concatenate([new[None], line[:-1]])

    def function(row, words, number, temperature, numbers):
        def push(needed, line, new):
            moved, _ = changed_if_needed(lambda v, _: (pushed(v[0], new), v[1]), needed,
                                         (line, new), new)  # fmt: skip
            return jnp.where(needed, moved, line) if needed is not True else moved

        def once(needed, line, new):
            return changed_if_needed(lambda v, x: jnp.where(needed, pushed(v, x), v), needed,
                                     line, new)  # fmt: skip

        def step(carry, x):
            alone, twice, kept, shared, inner, chosen, large = carry
            needed, value = row[0] > x, row[1] + x
            alone = once(needed, alone, value)
            twice = once(row[2] > x, once(needed, twice, value), 2 * value)
            before, kept = kept, once(needed, kept, value)
            shared = once(needed, shared, value), once(row[2] > x, shared, -value)
            inner, _ = lax.scan(lambda c, y: (once(needed, c, y + inner[1]), y), inner,
                                jnp.arange(3.0))  # fmt: skip
            chosen = lax.cond(row[3] > x, lambda v: v + 1, lambda v: once(needed, v, value), chosen)
            large = once(needed, large, value)
            after = (alone, twice, kept, jnp.maximum(*shared), inner, chosen, large)
            return after, (before.sum() + push(needed, before, x).sum(), large[-1])

        start = tuple(row[0] * jnp.ones(n) for n in (3, 3, 3, 3, 3, 3, 40))
        return lax.scan(step, start, jnp.arange(-16.0, 17.0) / 8)

    # Of few binary digits, so that nothing is rounded.
    rows = np.round(64 * np.clip(np.nan_to_num(rows_of(4)), -3, 3)) / 64
    ours, theirs, _ = both(function, 4, "kept", rows)
    assert np.array_equal(ours.view(np.float32), theirs.view(np.float32))


@pytest.mark.slow
def test_random_numbers_are_those_of_jax():
    def function(row, words, number, *_):
        key = jax.random.fold_in(jax.random.wrap_key_data(words, impl="threefry2x32"), number)
        one, two = jax.random.split(key)

        def step(key, _):
            key, sub = jax.random.split(key)
            return key, jax.random.uniform(sub)

        _, drawn = lax.scan(step, two, length=3)
        return (
            jax.random.bits(one, (5,)), jax.random.uniform(two, (2,)),
            jax.random.randint(one, (3,), 0, 9),
            jax.random.bernoulli(two), drawn, jax.random.key_data(jax.random.split(key, 3)[1]),
        )  # fmt: skip

    check(function, 1, "random")
    ours, theirs, _ = both(
        lambda row, words, number, *_: jax.random.normal(
            jax.random.wrap_key_data(words, impl="threefry2x32"), (4,)
        ) * row[0], 1, "normal", np.ones((64, 1), np.float32),
    )  # fmt: skip
    assert np.allclose(ours.view(np.float32), theirs.view(np.float32), atol=1e-5)


def test_derivatives():
    def objective(row):
        def step(carry, x):
            carry = jnp.tanh(carry * row[1]) + jnp.maximum(row[2], x) * jnp.sin(carry)
            return carry, carry**2

        last, outs = lax.scan(step, row[0], jnp.linspace(-1, 1, 30))
        picked = outs[jnp.clip(row[3] * 5, 0, 29).astype(int)]
        return last + outs.min() + picked + jnp.sum(row.at[1].multiply(3.0) ** 2)

    def function(row, *_):
        return jax.value_and_grad(objective)(row), jax.jvp(objective, (row,), (jnp.ones(4),))

    rows = np.random.default_rng(4).normal(size=(256, 4)).astype(np.float32)
    ours, theirs, _ = both(function, 4, "derivatives", rows)
    assert np.allclose(ours.view(np.float32), theirs.view(np.float32), rtol=1e-3, atol=1e-3)


STEPS = {
    "sum": lambda a, b: a + b,
    "difference": lambda a, b: a - b,
    "product": lambda a, b: a * b,
    "quotient": lambda a, b: a / (1 + jnp.abs(b)),
    "least": jnp.minimum,
    "greatest": jnp.maximum,
    "choice": lambda a, b: jnp.where(a < b, a * 0.5, b),
    "sine": lambda a, b: jnp.sin(a + b),
    "tanh": lambda a, b: jnp.tanh(a) + b,
    "turn": lambda a, b: jnp.roll(a, 1) - b[::-1],
    "total": lambda a, b: a.sum() * 0.2 + b,
    "rise": lambda a, b: jnp.exp(-jnp.abs(a)) * b,
}


@pytest.mark.slow
@settings(max_examples=6, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    st.lists(st.tuples(st.sampled_from(sorted(STEPS)), st.integers(0, 9), st.integers(0, 9)),
             min_size=12, max_size=40),
    st.integers(3, 40),
    st.integers(0, 5),
)  # fmt: skip
def test_programs_of_random_steps(steps, size, loops):
    def once(values):
        for name, i, j in steps:
            values = [*values, STEPS[name](values[i % len(values)], values[j % len(values)])]
        return jnp.clip(values[-1], -3, 3), jnp.clip(values[-2], -3, 3)

    def function(row, words, number, temperature, numbers):
        start = (jnp.resize(row, size), jnp.resize(numbers - row, size))
        for _ in range(1 if loops == 0 else 0):
            start = once(start)
        return lax.fori_loop(0, loops, lambda i, v: once(v), start)

    rows = np.random.default_rng(5).normal(size=(100, 4)).astype(np.float32)
    ours, theirs, _ = both(function, 4, f"random steps {steps} {size} {loops}", rows)
    a, b = ours.view(np.float32), theirs.view(np.float32)
    # Programs that repeat may be chaotic.
    assert np.mean(np.isclose(a, b, rtol=1e-3, atol=1e-3, equal_nan=True)) > 0.98


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda row: jnp.sort(row), "the operation sort"),
        (lambda row: jnp.linalg.cholesky(jnp.eye(2) + row[0]), "the operation cholesky"),
        (lambda row: jax.pure_callback(lambda x: x, row, row), "the operation pure_callback"),
        (lambda row: row.astype(jnp.float16), "numbers of type float16"),
        (lambda row: lax.fori_loop(0, 9, lambda i, m: m @ m, jnp.outer(row, row))[0], None),
    ],
)
def test_what_is_not_translated_is_refused(function, words):
    def packed(row, *_):
        return bits(function(row).astype(jnp.float32))

    program = jax.make_jaxpr(packed)(*forms(3))
    if words is None:
        assert "run(" in translate(program)
        return
    with pytest.raises(Untranslatable, match=words):
        translate(program)
