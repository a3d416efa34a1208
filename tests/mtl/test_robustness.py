"""One trace, many traces, bad traces: what `robustness` promises besides the right number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import (
    HorizonError,
    IntervalError,
    always,
    boolean,
    eventually,
    explain,
    hard,
    parse,
    robustness,
    robustness_signal,
    satisfied,
    signal,
    smooth,
    smoothing_error,
)
from verifai_jax.mtl import formula as ast

NESTED = parse("G[0,2] (x > 0 -> F[0,1] ((y > 0) U[0.1,0.5] (x < y)))")


@pytest.fixture
def batch():
    rng = np.random.default_rng(0)
    return {name: rng.normal(size=(530, 40)).astype(np.float32) for name in ("x", "y")}


def one_by_one(batch, lanes, semantics=hard):
    run = jax.jit(lambda x, y: robustness(NESTED, Trace({"x": x, "y": y}, dt=0.1), semantics))
    return np.stack([run(batch["x"][i], batch["y"][i]) for i in lanes])


@pytest.mark.slow
@pytest.mark.parametrize("semantics", [hard, smooth(0.1)], ids=["hard", "smooth"])
def test_a_batch_equals_its_traces_one_by_one(batch, semantics):
    def rho(x, y):
        return robustness(NESTED, Trace({"x": x, "y": y}, dt=0.1), semantics)

    # 530 lanes are three chunks, the last of which overlaps the one before.
    some = [0, 1, 176, 177, 352, 353, 354, 529]
    expected = one_by_one(batch, some, semantics)
    rows = jax.jit(jax.vmap(rho))(batch["x"], batch["y"])
    columns = jax.jit(jax.vmap(rho, in_axes=1))(batch["x"].T, batch["y"].T)
    np.testing.assert_allclose(rows[np.array(some)], expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(rows, columns)
    value, gradient = jax.jit(jax.vmap(jax.value_and_grad(rho)))(batch["x"], batch["y"])
    np.testing.assert_allclose(value, rows, rtol=1e-5, atol=1e-6)
    assert gradient.shape == (530, 40)
    single = jax.jit(jax.grad(rho))
    for i in some:
        expected = single(batch["x"][i], batch["y"][i])
        np.testing.assert_allclose(gradient[i], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_signal_that_all_lanes_share_has_a_gradient_for_each(batch):
    x, y = batch["x"][:5], batch["y"][0]

    def rho(x, y):
        return robustness(NESTED, Trace({"x": x, "y": y}, dt=0.1), smooth(0.2))

    shared = jax.vmap(jax.grad(rho, 1), in_axes=(0, None))(x, y)
    spread = jax.vmap(jax.grad(rho, 1))(x, jnp.stack([y] * 5))
    np.testing.assert_allclose(shared, spread, rtol=1e-5, atol=1e-6)
    pooled = jax.grad(lambda y: jax.vmap(rho, in_axes=(0, None))(x, y).sum())(y)
    np.testing.assert_allclose(pooled, spread.sum(axis=0), rtol=1e-4, atol=1e-5)


def test_lanes_within_lanes_and_a_temperature_for_each(batch):
    x = batch["x"][:6].reshape(2, 3, 40)
    taus = jnp.array([0.1, 0.2, 0.4])
    formula = parse("G[0,2] (F[0,1] (x > 0))")

    def rho(x, tau):
        return robustness(formula, Trace({"x": x}, dt=0.1), smooth(tau))

    values = jax.vmap(jax.vmap(rho), in_axes=(0, None))(x, taus)
    for i in range(2):
        for j in range(3):
            np.testing.assert_allclose(values[i, j], rho(x[i, j], taus[j]), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_the_whole_signal_in_batches_with_its_gradient(batch):
    x, y = batch["x"][:4], batch["y"][:4]
    formula = parse("F[0,1] (x > y)")

    def rho(x, y):
        return robustness_signal(formula, Trace({"x": x, "y": y}, dt=0.1), smooth(0.2))

    values = jax.vmap(rho)(x, y)
    assert values.shape == (4, 40)
    weights = jnp.linspace(-1, 1, 40)
    gradient = jax.vmap(jax.grad(lambda x, y: rho(x, y) @ weights))(x, y)
    for i in range(4):
        np.testing.assert_allclose(values[i], rho(x[i], y[i]), rtol=1e-5, atol=1e-6)
        jacobian = jax.jacrev(rho)(x[i], y[i])
        np.testing.assert_allclose(gradient[i], weights @ jacobian, rtol=1e-4, atol=1e-5)


def test_annealing_does_not_recompile():
    compiled = []

    @jax.jit
    def rho(x, semantics):
        compiled.append(1)
        return robustness("G (x > 0)", Trace({"x": x}, dt=0.1), semantics)

    x = jnp.array([1.0, 0.5, 2.0])
    values = [float(rho(x, smooth(tau))) for tau in (1.0, 0.1, 0.01)]
    assert len(compiled) == 1
    np.testing.assert_allclose(values[-1], 0.5, atol=1e-6)
    assert values == sorted(values)


@pytest.mark.thorough
def test_samples_after_the_end_never_count():
    x = np.array([1.0, 2.0, 0.5, -7.0, -7.0])
    ended = Trace({"x": x}, dt=1.0, valid=3)
    short = Trace({"x": x[:3]}, dt=1.0)
    for text in ("G (x > 0)", "F[1,4] G[0,1] (x > 0)", "(x > 0) U[1,4] (x < 0.6)", "X X X (x > 0)"):
        for end in ("hold", "truncate"):
            value, expected = (robustness(text, t, end=end) for t in (ended, short))
            assert value == expected, (text, end)
    lengths = jnp.array([1, 3, 5])
    values = jax.vmap(
        lambda k: robustness("G (x > 0)", Trace({"x": jnp.asarray(x)}, dt=1.0, valid=k))
    )(lengths)
    np.testing.assert_array_equal(values, [1.0, 0.5, -7.0])


def test_strict_refuses_a_horizon_beyond_the_trace():
    trace = Trace({"x": np.ones(5)}, dt=0.5)
    assert robustness("G[0,1] F[0,1] (x > 0)", trace, end="strict") == 1.0
    with pytest.raises(HorizonError, match=r"looks 2\.5 s ahead, but the trace lasts 2 s"):
        robustness("G[0,1.5] F[0,1] (x > 0)", trace, end="strict")
    with pytest.raises(HorizonError, match="has no end"):
        robustness("G (x > 0)", trace, end="strict")
    values = jax.vmap(
        lambda k: robustness(
            "G[0,1] (x > 0)", Trace({"x": jnp.ones(5)}, dt=0.5, valid=k), end="strict"
        )
    )(jnp.array([2, 3, 5]))
    np.testing.assert_array_equal(values, [np.nan, 1.0, 1.0])


def test_at_zero_the_comparison_decides():
    trace = Trace({"x": np.zeros(3)}, dt=1.0)
    verdicts = {
        c: bool(satisfied(f"G (x {c} 0)", trace)) for c in (">=", ">", "<=", "<", "==", "!=")
    }
    assert verdicts == {">=": True, ">": False, "<=": True, "<": False, "==": True, "!=": False}
    assert not satisfied("G x", trace)
    assert all(robustness(f"G (x {c} 0)", trace) == 0 for c in verdicts)


def test_a_boolean_signal_is_plus_or_minus_one():
    trace = Trace({"req": np.array([True, False, True])}, dt=1.0)
    assert robustness("G req", trace) == -1.0
    assert robustness("F[1,2] req", trace) == 1.0
    assert not satisfied("X req", trace)


def test_vectors():
    trace = Trace({"p": np.array([[3.0, 4.0], [0.0, 0.0]]), "x": np.zeros(2)}, dt=1.0)
    assert robustness("norm(p) >= 4", trace) == 1.0
    assert robustness("X (norm(p) <= 1)", trace) == 1.0
    assert robustness("p[1] - p[0] > 0", trace) == 1.0
    gradient = jax.grad(
        lambda p: robustness("X (norm(p) <= 1)", Trace({"p": p}, dt=1.0), smooth(0.1))
    )(jnp.asarray(trace["p"]))
    assert np.isfinite(gradient).all()
    with (
        unchecked(),
        pytest.raises(TypeError, match=r"'p' is a vector of 2 components .* p\[0\], or norm\(p\)"),
    ):
        robustness("p > 0", trace)
    with unchecked(), pytest.raises(TypeError, match=r"'x' is a scalar: x\[0\] needs a vector"):
        robustness("x[0] > 0", trace)
    with (
        unchecked(),
        pytest.raises(TypeError, match=r"'p' has 2 components, counted from 0; got p\[2\]"),
    ):
        robustness("p[2] > 0", trace)


@pytest.mark.parametrize(
    ("text", "power"),
    [
        ("x**2 > y", lambda x: x**2),
        ("x ** -3 > y", lambda x: x**-3.0),
        ("-x**3 > y", lambda x: -(x**3)),
        ("2**x > y", lambda x: 2**x),
        ("x**x > y", lambda x: x**x),
        ("abs(x)**0.5 > y", lambda x: abs(x) ** 0.5),
        ("x**0.5 > y", lambda x: x**0.5),
        ("x**0 > y", lambda x: x**0),
        ("(-2)**x > y", lambda x: (-2.0) ** x),
        ("x**(1 + 2 ** 2) > y", lambda x: x**5),
    ],
)
def test_powers_are_those_of_numpy(text, power):
    x, y = np.array([-3.0, -1.5, -1.0, 0.5, 1.0, 2.0]), np.linspace(-2, 2, 6)
    with np.errstate(all="ignore"), jax.enable_x64(True):
        values = robustness_signal(text, Trace({"x": x, "y": y}, dt=0.5))
        np.testing.assert_allclose(values, power(x) - y, rtol=1e-12)
    assert parse(str(parse(text))) == parse(text)


@pytest.mark.parametrize(("k", "at_zero"), [(0, 0.0), (1, 1.0), (2, 0.0), (3, 0.0), (1.5, 0.0)])
def test_gradients_of_powers_are_finite_at_zero_and_below(k, at_zero):
    def rho(x):
        return robustness(f"x**{k} > 0", Trace({"x": x[None]}, dt=1.0))

    assert jax.grad(rho)(jnp.float32(0.0)) == at_zero
    if k != 1.5:
        np.testing.assert_allclose(jax.grad(rho)(jnp.float32(-2.0)), k * (-2.0) ** (k - 1))


def test_a_power_is_explained():
    why = explain("G (x**2 < 0.5)", Trace({"x": np.array([0.1, -0.9, 0.3])}, dt=1.0))
    assert str(why.predicate) == "x**2 < 0.5"
    assert why.time == 1.0
    assert why.robustness == pytest.approx(0.5 - 0.81, abs=1e-6)


def test_an_interval_off_the_clock_names_the_nearest_multiples():
    trace = Trace({"x": np.ones(5)}, dt=0.02)
    with pytest.raises(IntervalError) as caught:
        robustness("G[0,0.05] (x > 0)", trace)
    message = str(caught.value)
    assert "[0,0.05]" in message
    assert "0.02 s" in message
    assert "the nearest are 0.04 s and 0.06 s" in message
    assert robustness("G[0,0.06] (x > 0)", Trace({"x": np.ones(9)}, dt=0.01)) == 1.0


def test_an_unknown_signal_is_named_with_the_nearest():
    with pytest.raises(
        UnknownNameError, match="the trace has no signal 'thetta'; did you mean 'theta'"
    ):
        robustness("G (thetta > 0)", Trace({"theta": np.ones(5)}, dt=0.02))


def test_wrong_options_are_refused():
    trace = Trace({"x": np.ones(5)}, dt=0.02)
    with (
        unchecked(),
        pytest.raises(ValueError, match="end is 'hold', 'truncate' or 'strict'; got 'wrap'"),
    ):
        robustness("x > 0", trace, end="wrap")
    with unchecked(), pytest.raises(ValueError, match="compat is None or 'pymtl'; got 'rtamt'"):
        robustness("x > 0", trace, compat="rtamt")
    with unchecked(), pytest.raises(TypeError, match="semantics is hard, boolean or smooth"):
        robustness("x > 0", trace, smooth)
    with unchecked(), pytest.raises(TypeError, match="a formula or its text is needed; got 3"):
        robustness(3, trace)
    with unchecked(), pytest.raises(ValueError, match="tau must be positive; got 0"):
        smooth(0)
    with pytest.raises(ValueError, match="a temperature tau or an error"):
        smooth()
    with (
        unchecked(),
        pytest.raises(ValueError, match="bound is 'none', 'lower' or 'upper'; got 'both'"),
    ):
        smooth(1.0, bound="both")


def test_sample_times():
    even = Trace({"x": np.arange(4.0)}, times=np.array([0.0, 0.1, 0.2, 0.3], np.float32))
    assert robustness("F[0,0.2] (x > 0)", even) == 2.0
    uneven = Trace({"x": np.arange(4.0)}, times=np.array([0.0, 0.1, 0.3, 0.4]))
    with pytest.raises(ValueError, match=r"not evenly sampled.*resample\(trace, dt=0\.1"):
        robustness("x > 0", uneven)
    with pytest.raises(ValueError, match="times must increase"):
        robustness("x > 0", Trace({"x": np.ones(3)}, times=np.array([0.0, 2.0, 1.0])))


@pytest.mark.thorough
def test_not_a_number_is_never_a_verdict():
    x = np.array([1.0, np.nan, 2.0])
    trace = Trace({"x": x}, dt=0.5)
    for text in (
        "G (x > 0)",
        "F (x > 0)",
        "!(F (x > 0))",
        "(x > 0) U (x > 5)",
        "G F[0,0.5] (x > 0)",
    ):
        assert np.isnan(robustness(text, trace)), text
        assert np.isnan(robustness(text, trace, smooth(0.1))), text
        assert np.isnan(robustness(text, trace, boolean)), text
    with pytest.raises(ValueError, match=r"no verdict: signal 'x' is NaN at 0\.5 s"):
        satisfied("G (x > 0)", trace)
    # Samples that do not matter do no harm.
    assert robustness("x > 0", trace) == 1.0
    assert satisfied("F[1,1] (x > 0)", trace)
    verdict = jax.jit(lambda x: satisfied("!(G (x > 0))", Trace({"x": x}, dt=0.5)))(x)
    assert not verdict


@pytest.mark.thorough
@pytest.mark.parametrize("scale", [1e-5, 1e5])
@pytest.mark.parametrize("tau", [1e-3, 10.0])
def test_single_precision_is_finite_at_every_scale(scale, tau):
    rng = np.random.default_rng(1)
    signals = {n: (rng.normal(size=40) * scale).astype(np.float32) for n in ("x", "y")}

    @jax.jit
    def run(signals, tau):
        return jax.value_and_grad(lambda s: robustness(NESTED, Trace(s, dt=0.1), smooth(tau)))(
            signals
        )

    value, gradient = run(signals, jnp.float32(tau))
    assert np.isfinite(value)
    assert all(np.isfinite(g).all() for g in gradient.values())
    sides = smoothing_error(NESTED, Trace(signals, dt=0.1))
    exact = float(robustness(NESTED, Trace(signals, dt=0.1)))
    slack = 1e-5 * max(scale, tau)
    assert value - tau * sides.above - slack <= exact <= value + tau * sides.below + slack


def test_smooth_tends_to_hard():
    trace = Trace({n: np.random.default_rng(i).normal(size=40) for i, n in enumerate("xy")}, dt=0.1)
    exact = float(robustness(NESTED, trace))
    errors = [abs(float(robustness(NESTED, trace, smooth(tau))) - exact) for tau in (1, 0.1, 1e-4)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-3


def test_windows_open_on_the_right_for_those_who_migrate():
    trace = Trace({"x": np.array([3.0, 2.0, 1.0, 0.0])}, dt=1.0)
    assert robustness("G[0,2] (x > 0)", trace) == 1.0
    assert robustness("G[0,2] (x > 0)", trace, compat="pymtl") == 2.0
    assert robustness("G[1,1] (x > 0)", trace, compat="pymtl") == 2.0


def test_the_root_alone_reads_only_the_samples_it_needs():
    x = np.concatenate([np.ones(5), np.full(5, np.nan)])
    trace = Trace({"x": x}, dt=0.1)
    assert robustness(always(signal("x") > 0, 0, 0.4), trace) == 1.0
    assert robustness(eventually(always(signal("x") > 0, 0.1, 0.2), 0, 0.2), trace) == 1.0


def test_formulas_are_static_and_equal_by_value():
    calls = []

    @jax.jit
    def rho(x):
        calls.append(1)
        return robustness(always(signal("x") > 0, 0, 1), Trace({"x": x}, dt=0.5))

    assert rho(jnp.ones(3)) == rho(2 * jnp.ones(3)) - 1
    assert len(calls) == 1
    assert hash(parse("G[0,1] (x > 0)")) == hash(always(signal("x") > 0, 0, 1))
    assert parse("x > 0") != parse("x >= 0")
    with unchecked(), pytest.raises(TypeError, match=r"no truth value.*write a < x < b as"):
        bool((signal("x") > 0) and (signal("x") < 1))
    assert isinstance(ast.TRUE & (signal("x") > 0), ast.And)
