"""Functions of time by control points: against NumPy, at the knots, under jit, vmap and grad."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from verifai_jax.core.values.waveform import Waveform, set_durations

KNOTS = np.float32([1, -2, 0.5, 4, 4])
LINEAR = Waveform(jnp.asarray(KNOTS), "linear", 2.0)
CONSTANT = Waveform(jnp.asarray(KNOTS), "constant", 2.0)
TIMES = np.linspace(-1, 3, 401).astype(np.float32)


def test_linear_is_interpolation():
    values = jax.jit(jax.vmap(LINEAR))(TIMES)
    np.testing.assert_allclose(values, np.interp(TIMES, np.linspace(0, 2, 5), KNOTS), atol=1e-5)


def test_constant_holds_each_from_its_start_on():
    values = jax.jit(jax.vmap(CONSTANT))(TIMES)
    starts = np.arange(5) * 0.4
    # The clock of a rollout rounds; the start of a piece is in it, up to a millionth.
    places = np.searchsorted(starts, TIMES.astype(np.float64) + 1e-6, side="right") - 1
    np.testing.assert_array_equal(values, KNOTS[np.clip(places, 0, 4)])


@pytest.mark.thorough
@given(st.sampled_from([1, 3, 16, 40]), st.integers(1, 500), st.floats(0.001, 0.1))
@settings(max_examples=60, deadline=None)
def test_pieces_begin_on_the_beat_of_a_rollout(pieces, steps, dt):
    wave = Waveform(jnp.arange(pieces, dtype=jnp.float32), "constant", pieces * steps * dt)
    clock = jnp.arange(pieces, dtype=jnp.float32) * steps * jnp.float32(dt)
    assert jax.vmap(wave)(clock).tolist() == list(range(pieces))


@pytest.mark.thorough
@pytest.mark.parametrize("wave", [LINEAR, CONSTANT], ids=["linear", "constant"])
@pytest.mark.parametrize("factor", [1, 2, 3])
def test_refined_is_the_same_function(wave, factor):
    fine = wave.refined(factor)
    times = TIMES + np.float32(0.0013)
    np.testing.assert_allclose(jax.vmap(fine)(times), jax.vmap(wave)(times), atol=2e-5)
    assert len(fine.knots) == {"linear": 4 * factor + 1, "constant": 5 * factor}[wave.hold]


@pytest.mark.thorough
def test_vectors_and_batches():
    knots = jax.random.normal(jax.random.key(0), (7, 5, 2))
    batch = Waveform(knots, "linear", 2.0)
    values = jax.jit(jax.vmap(lambda wave: wave(0.25)))(batch)
    np.testing.assert_allclose(values, (knots[:, 0] + knots[:, 1]) / 2, atol=1e-6)
    own = jnp.linspace(0, 2, 7)
    values = jax.vmap(lambda wave, time: wave(time))(batch, own)
    assert values.shape == (7, 2)
    np.testing.assert_allclose(values[-1], knots[-1, -1])


@pytest.mark.thorough
def test_gradients_are_those_of_the_interpolation():
    slopes = jax.grad(lambda wave: wave(0.625))(LINEAR)
    np.testing.assert_allclose(slopes.knots, [0, 0.75, 0.25, 0, 0], atol=1e-6)
    assert float(jax.grad(LINEAR)(0.2)) == pytest.approx(-6)
    held = jax.grad(lambda wave: wave(0.5))(CONSTANT)
    np.testing.assert_array_equal(held.knots, [0, 1, 0, 0, 0])


def test_a_duration_is_needed_and_can_be_given():
    unbound = Waveform(jnp.asarray(KNOTS))
    with pytest.raises(ValueError, match=r"Signal\(\.\.\., duration=4.0\).*over\(4.0\)\(time\)"):
        unbound(0.5)
    assert float(unbound.over(2.0)(0.625)) == float(LINEAR(0.625))
    features = {"wind": unbound, "x": 1.0, "short": LINEAR, "many": [unbound]}
    given = set_durations(features, 8.0)
    assert given["wind"].duration == given["many"][0].duration == 8.0
    assert given["short"].duration == 2.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Waveform(KNOTS, times=(0, 2, 1, 3, 4)),
            r"increase.*got \[0, 2, 1, 3, 4",
        ),
        (lambda: Waveform(KNOTS, times=(-1, 2)), "begin at 0 or later"),
        (lambda: Waveform(KNOTS, times="now"), "a list of numbers, in seconds; got 'now'"),
        (lambda: Waveform(KNOTS, "pulse", times=(1.0,)), "needs a width in seconds"),
        (lambda: Waveform(KNOTS, width=1.0), "only pulses have a width; got width=1.0"),
        (lambda: Waveform(KNOTS, "pulse", width=-1.0), "positive number of seconds; got -1.0"),
        (lambda: Waveform(KNOTS, "linaer"), "unknown hold 'linaer'; did you mean 'linear'"),
        (
            lambda: Waveform(np.zeros(3), times=(0, 1, 5)).over(4.0),
            "the times of a Signal must lie in its duration of 4 s; got 5",
        ),
        (lambda: LINEAR.over(0), "duration must be a positive number of seconds; got 0"),
        (lambda: LINEAR.over(float("nan")), "positive number of seconds; got nan"),
        (lambda: LINEAR.over("4"), "positive number of seconds; got '4'"),
    ],
)
def test_what_is_wrong_is_refused_where_it_is_made(make, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("hold", ["linear", "constant"])
@pytest.mark.parametrize("knots", [np.array([1.0, -2.0, 4.0]), np.arange(6.0).reshape(3, 2)])
def test_on_the_host_it_is_the_same_function_in_numpy(hold, knots):
    knots = knots.astype(np.float32)
    host, traced = Waveform(knots, hold, 2.0), Waveform(jnp.asarray(knots), hold, 2.0)
    for time in (-1.0, 0, 0.3, 2 / 3, 1.0, np.float64(1.7), 2.0, 5.0):
        value = host(time)
        assert isinstance(value, np.ndarray | np.float32)
        np.testing.assert_allclose(value, traced(time), rtol=1e-6)


UNEVEN = (0.0, 0.3, 1.0, 1.1, 2.0)


@pytest.mark.thorough
@pytest.mark.parametrize(("times", "count"), [(None, 5), (UNEVEN, 3), (None, 2), (UNEVEN, 5)])
def test_pchip_is_that_of_scipy(times, count):
    """On the host, and traced."""
    rng = np.random.default_rng(count)
    where = np.linspace(0, 2, count) if times is None else np.asarray(times[:count])
    clock, times = np.linspace(-0.5, 2.5, 121), None if times is None else times[:count]
    for knots in (rng.normal(size=count), rng.integers(0, 2, count), rng.normal(size=(count, 2))):
        knots = np.asarray(knots, np.float32)
        oracle = PchipInterpolator(where, knots)(np.clip(clock, where[0], where[-1]))
        wave = Waveform(knots, "pchip", 2.0, times)
        np.testing.assert_allclose([wave(float(t)) for t in clock], oracle, atol=1e-5)
        if count != 5 or knots.ndim == 2:
            traced = jax.jit(jax.vmap(Waveform(knots, "pchip", 2.0, times)))(jnp.asarray(clock))
            np.testing.assert_allclose(traced, oracle, atol=1e-5)


@given(st.lists(st.floats(-1, 1, width=32), min_size=3, max_size=6), st.floats(0, 2))
@settings(max_examples=100, deadline=None)
def test_pchip_never_leaves_what_it_joins(knots, time):
    knots = np.asarray(knots, np.float32)
    value = Waveform(knots, "pchip", 2.0)(time)
    left = min(int(time / 2 * (len(knots) - 1)), len(knots) - 2)
    # At a knot the rounding of the time decides which of two pieces it lies in.
    near = knots[max(left - 1, 0) : left + 3]
    assert near.min() <= value <= near.max()


@pytest.mark.thorough
def test_pchip_has_the_derivatives_of_its_differences():
    knots = jnp.asarray([0.1, 1.0, 0.7, -0.3, -0.2], jnp.float32)
    value = jax.jit(lambda knots, time: Waveform(knots, "pchip", 2.0)(time))
    for time in (0.2, 0.9, 1.3, 1.8):
        slopes = jax.grad(value, argnums=(0, 1))(knots, time)
        for i in range(5):
            step = jnp.zeros(5).at[i].set(1e-2)
            change = (value(knots + step, time) - value(knots - step, time)) / 2e-2
            assert float(slopes[0][i]) == pytest.approx(float(change), abs=2e-3)
        change = (value(knots, time + 1e-2) - value(knots, time - 1e-2)) / 2e-2
        assert float(slopes[1]) == pytest.approx(float(change), abs=2e-2)
    flat = jax.grad(value)(jnp.ones(5), 0.9)
    assert np.isfinite(flat).all()


def test_lines_and_pieces_at_given_times():
    knots = KNOTS
    clock = np.linspace(-1, 3, 401)
    lines, held = (
        Waveform(jnp.asarray(knots), hold, None, UNEVEN) for hold in ("linear", "constant")
    )
    np.testing.assert_allclose(
        jax.jit(jax.vmap(lines))(clock), np.interp(clock, UNEVEN, knots), atol=1e-5
    )
    places = np.searchsorted(np.asarray(UNEVEN), clock + 1e-6, side="right") - 1
    values = jax.jit(jax.vmap(held))(clock)
    np.testing.assert_array_equal(values, knots[np.clip(places, 0, 4)])
    host = Waveform(knots, "constant", None, UNEVEN)
    np.testing.assert_array_equal([host(t) for t in clock.tolist()], knots[np.clip(places, 0, 4)])


@pytest.mark.parametrize(
    ("times", "width"), [(None, None), (None, 0.3), (UNEVEN, None), (UNEVEN, 0.08), ((0.5,), 0.7)]
)
def test_pulses_return_to_zero(times, width):
    knots = KNOTS if times is None else KNOTS[: len(times)]
    starts = np.arange(5) * 0.4 if times is None else np.asarray(times)
    lasts = np.diff(starts).min() / 2 if width is None else width
    clock = np.linspace(-1, 3, 401)
    expected = np.zeros(401)
    for i, start in enumerate(starts):
        following = starts[i + 1] if i + 1 < len(starts) else np.inf
        expected[(clock >= start - 1e-6) & (clock < min(start + lasts, following) - 1e-6)] = knots[
            i
        ]
    wave = Waveform(jnp.asarray(knots), "pulse", 2.0, times, width)
    np.testing.assert_array_equal(jax.jit(jax.vmap(wave))(clock), expected)
    both = Waveform(np.stack([knots, 2 * knots], 1), "pulse", 2.0, times, width)
    np.testing.assert_array_equal(both(0.5), [expected[150], 2 * expected[150]])


@pytest.mark.thorough
@pytest.mark.parametrize("hold", ["linear", "constant"])
def test_given_times_are_refined_between_them(hold):
    wave = Waveform(jnp.asarray(KNOTS), hold, 2.5, UNEVEN)
    fine = wave.refined(3)
    assert len(fine.knots) == len(fine.times) == 13
    times = TIMES + np.float32(0.0013)
    np.testing.assert_allclose(jax.vmap(fine)(times), jax.vmap(wave)(times), atol=3e-5)


@pytest.mark.parametrize("hold", ["pchip", "pulse"])
def test_what_more_points_cannot_represent_is_not_refined(hold):
    with pytest.raises(ValueError, match=f"hold='{hold}' has no refinement"):
        Waveform(jnp.asarray(KNOTS), hold, 2.0).refined(2)


def test_it_is_no_number():
    knots = jnp.ones(3)
    for wrong in (
        lambda: LINEAR * 2,
        lambda: 2 - LINEAR,
        lambda: LINEAR + LINEAR,
        lambda: -LINEAR,
        lambda: LINEAR > 0,
        lambda: float(LINEAR),
        lambda: knots @ LINEAR,
        lambda: np.float32(2) * LINEAR,
        lambda: np.ones(3) / LINEAR,
        lambda: jnp.exp(LINEAR),
        lambda: jax.jit(lambda wave: wave * 2)(LINEAR),
    ):
        with pytest.raises(TypeError, match="call it with a time in seconds"):
            wrong()


def test_text_is_short_and_never_an_array():
    assert repr(LINEAR) == "Waveform(5 knots from -2 to 4, linear, over 2 s)"
    assert repr(Waveform(np.ones((1000, 2)), "constant")) == (
        "Waveform(1000 knots of shape [2], all 1, constant)"
    )
    assert jax.eval_shape(lambda: LINEAR).knots.shape == (5,)
    assert repr(jax.eval_shape(lambda: LINEAR)) == "Waveform(5 knots, linear, over 2 s)"
    jax.jit(lambda wave: (repr(wave), wave(1.0))[-1])(LINEAR)


def test_masked_knots_are_refused():
    knots = np.ma.masked_array([0.0, 9e9, 0.0], mask=[0, 1, 0])
    with pytest.raises(ValueError, match="knots of a Waveform must be numbers; number 1 is masked"):
        Waveform(knots, duration=2.0)
    whole = Waveform(np.ma.masked_array([0.0, 1.0], mask=False), duration=2.0)
    assert type(whole.knots) is np.ndarray
