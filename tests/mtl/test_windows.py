"""The kernels, sample by sample against their definitions; both forms, both directions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.mtl import parallel, sequential, windows

LENGTH = 13
FORMS = [sequential, parallel]
BOTH = pytest.mark.parametrize("form", FORMS, ids=["sequential", "parallel"])
DIRECTIONS = pytest.mark.parametrize("reverse", [True, False], ids=["ahead", "behind"])
TAUS = pytest.mark.parametrize("tau", [None, 0.3], ids=["hard", "smooth"])


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def lanes():
    return np.random.default_rng(3).normal(size=(LENGTH, 2))


def total(values, tau):
    return values.max(axis=0) if tau is None else tau * np.log(np.exp(values / tau).sum(axis=0))


def slices(n, reverse):
    for i in range(LENGTH):
        yield slice(i, min(i + n, LENGTH)) if reverse else slice(max(0, i - n + 1), i + 1)


def value_and_pullback(function, weights, *arguments):
    """Value and gradient of the weighted sum, compiled once."""

    @jax.jit
    def run(*arguments):
        value, pullback = jax.vjp(function, *arguments)
        return value, pullback(jnp.asarray(weights))

    return run(*arguments)


@pytest.mark.thorough
@DIRECTIONS
@TAUS
@pytest.mark.parametrize(
    ("form", "n"),
    [(sequential, n) for n in (2, 3, 6, 7, 12, 13, 20)] + [(parallel, n) for n in (2, 7, 20)],
    ids=lambda value: getattr(value, "__name__", str(value)).rpartition(".")[2],
)
def test_windows(form, reverse, tau, n, lanes):
    expected = np.stack([total(lanes[s], tau) for s in slices(n, reverse)])
    weights = np.random.default_rng(n).normal(size=lanes.shape)
    value, (gradient,) = value_and_pullback(
        lambda x: windows.windowed(x, n, 1, tau, reverse, form), weights, lanes
    )
    np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-12)
    pulled = np.zeros_like(lanes)
    for i, s in enumerate(slices(n, reverse)):
        above = lanes[s] - expected[i]
        pulled[s] += weights[i] * (above == 0 if tau is None else np.exp(above / tau))
    np.testing.assert_allclose(gradient, pulled, rtol=1e-9, atol=1e-12)


def until_by_definition(f, g, tau):
    u = [g[-1]]
    for a, b in zip(f[-2::-1], g[-2::-1], strict=True):
        inner = -total(np.stack([-a, -u[-1]]), tau)
        u.append(total(np.stack([b, inner]), tau))
    return np.stack(u[::-1])


@pytest.mark.thorough
@BOTH
@DIRECTIONS
@TAUS
def test_until(form, reverse, tau, lanes):
    f, g = lanes, np.random.default_rng(4).normal(size=lanes.shape)
    turn = slice(None, None, 1 if reverse else -1)
    weights = np.random.default_rng(5).normal(size=lanes.shape)
    value, (df, dg) = value_and_pullback(
        lambda f, g: windows.until(f, g, tau, reverse, form), weights, f, g
    )
    np.testing.assert_allclose(value[turn], until_by_definition(f[turn], g[turn], tau), rtol=1e-12)
    step = 1e-6
    for k in range(LENGTH):
        for argument, pulled in ((0, df), (1, dg)):
            ends = []
            for sign in (1, -1):
                pair = [f.copy(), g.copy()]
                pair[argument][k] += sign * step
                ends.append(until_by_definition(pair[0][turn], pair[1][turn], tau)[turn])
            slope = (weights * (ends[0] - ends[1])).sum(axis=0) / (2 * step)
            np.testing.assert_allclose(pulled[k], slope, rtol=1e-6, atol=1e-8)


@TAUS
def test_until_at_the_root_alone(tau, lanes):
    g = np.random.default_rng(4).normal(size=lanes.shape)

    @jax.jit
    def run(f, g):
        whole = jax.value_and_grad(lambda f, g: windows.until(f, g, tau)[0].sum(), (0, 1))
        first = jax.value_and_grad(lambda f, g: windows.until_first(f, g, tau).sum(), (0, 1))
        return whole(f, g), first(f, g), windows.until_first(f, g, tau).sum()

    (expected, pulled), (value, gradient), plain = run(lanes, g)
    np.testing.assert_allclose([value, plain], expected, rtol=1e-14)
    np.testing.assert_allclose(gradient, pulled, rtol=1e-14)


@pytest.mark.thorough
@DIRECTIONS
@TAUS
def test_a_tie_gives_its_gradient_away_once(reverse, tau):
    flat = jnp.zeros((LENGTH, 1))
    for function in (
        lambda x: windows.windowed(x, 4, 1, tau, reverse, sequential),
        lambda x: windows.until(x, x, tau, reverse, sequential),
    ):
        gradient = jax.grad(lambda x, function=function: function(x).sum())(flat)
        np.testing.assert_allclose(gradient.sum(), LENGTH, rtol=1e-12)


@pytest.mark.thorough
@BOTH
@TAUS
def test_not_a_number_goes_through(form, tau, lanes):
    lanes[5, 0] = np.nan
    value = windows.windowed(jnp.asarray(lanes), 4, 1, tau, True, form)
    np.testing.assert_array_equal(np.isnan(value[:, 0]), np.isin(np.arange(LENGTH), range(2, 6)))
    assert not np.isnan(value[:, 1]).any()
    value = windows.until(jnp.asarray(lanes), jnp.asarray(lanes), tau, True, form)
    assert np.isnan(value[:6, 0]).all()
    assert not np.isnan(value[:, 1]).any()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("form", "scale", "tau"),
    [(sequential, scale, tau) for scale in (1e-5, 1e5) for tau in (1e-3, 10.0)]
    + [(parallel, 1e5, 1e-3)],
)
def test_single_precision_stays_finite(form, scale, tau):
    x = np.random.default_rng(0).normal(size=(LENGTH, 2)).astype(np.float32) * np.float32(scale)
    g = x[::-1]
    ones = np.ones_like(x)
    tau32 = jnp.float32(tau)
    value, (gradient,) = value_and_pullback(
        lambda x: windows.windowed(x, 4, 1, tau32, True, form), ones, x
    )
    assert value.dtype == jnp.float32
    assert np.isfinite(value).all()
    np.testing.assert_allclose(np.sum(gradient), x.size, rtol=1e-3)
    exact = np.stack([total(x[s].astype(float), None) for s in slices(4, True)])
    assert (value >= exact - 1e-5 * scale).all()
    value, gradients = value_and_pullback(
        lambda f, g: windows.until(f, g, tau32, True, form), ones, x, g
    )
    assert np.isfinite(value).all()
    assert all(np.isfinite(d).all() for d in gradients)
    np.testing.assert_allclose(sum(np.sum(d) for d in gradients), x.size, rtol=1e-3)
