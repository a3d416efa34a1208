"""Coefficients of Taylor series: those of points are JAX's, those of boxes contain them."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.jet import jet

from verifai_jax.addons.verification.sets.form import Form
from verifai_jax.addons.verification.sets.interpreter import Interpreter
from verifai_jax.addons.verification.sets.series import CURVED, Rates
from verifai_jax.addons.verification.sets.values import constant
from verifai_jax.core.compute.precision import in_precision

ORDER = 4
MATRIX = np.random.default_rng(0).normal(size=(3, 3)) / 2


def polynomial(t, x):
    return x * x[::-1] - 0.5 * x**3 + t * x[0] * x


def ratio(t, x):
    return x / (2 + x[1] ** 2) - 1 / (1.5 + x) + x[0] / 3


def turned(t, x):
    return jnp.sin(x) * jnp.cos(x[0] + t) - jnp.sinh(x) / jnp.cosh(x)


def network(t, x):
    return jnp.tanh(MATRIX @ jax.nn.sigmoid(MATRIX @ x)) + jnp.exp(-x) * jnp.log(2 + x)


def rooted(t, x):
    inside = jnp.concatenate([x[:1], jnp.stack([x[1], x[2]])]).reshape(3, 1).T[0]
    return jnp.sqrt(2 + inside) ** 1.5 + jax.lax.rsqrt(3 + x) + jnp.cumsum(x) + jnp.log1p(x).sum()


def rarer(t, x):
    y = 0.3 * x
    return jnp.arctanh(y) + jnp.arcsinh(y) + jax.scipy.special.erf(y) + jnp.expm1(y) + (
        jnp.arccosh(2 + y) + jnp.arctan2(y, 1.5 + y[1]) + jax.scipy.special.erfc(y)
    )  # fmt: skip


def twice(t, x):
    """The same number as both operands, and as the exponent."""
    y = 1.5 + x
    return y**y + jnp.arctan2(y, y) + (x * t) * (x * t) + jnp.square(x)


def held(t, x):
    """A rate that does not vary: its state is linear in time."""
    return jnp.concatenate([x[1:], jnp.ones(1)]) * jnp.array([1.0, 1.0, 0.5])


def constant_rates(t, x):
    return jnp.array([1.0, 2.0, -0.5])


def chosen(t, x):
    return jnp.where(jnp.array([True, False, True]), x * x, t * x)


CASES = [
    polynomial, ratio, chosen, held, constant_rates, *(
        pytest.param(each, marks=pytest.mark.thorough)
        for each in (turned, network, rooted, rarer, twice)
    ),
]  # fmt: skip


def coefficients(function, low, high):
    program = jax.make_jaxpr(function)(0.3, low[0])
    dtype = np.dtype(np.float64)
    consts = [constant(each, np.dtype(each.dtype)) for each in program.consts]
    state = Form.leaf(low, high, np.eye(3), dtype)
    time = Form.between(np.full(1, 0.3), np.full(1, 0.3), dtype)
    with np.errstate(all="ignore"):
        rates = Rates(program.jaxpr, ORDER)
        return [row[0] for row in rates(Interpreter(len(low), 3), consts, [time, state], ORDER)]


def derivatives(function, points):
    """Return the rates' coefficients along solutions, by JAX's own Taylor mode."""

    def of(x):
        found = [function(0.3, x)]
        for order in range(1, ORDER + 1):
            clock = [1.0, *[0.0] * (order - 1)]
            found.append(jet(function, (0.3, x), (clock, found[:order]))[1][-1])
        return [each / math.factorial(k) for k, each in enumerate(found)]

    return [np.asarray(each) for each in jax.jit(jax.vmap(of))(points)]


@pytest.mark.thorough
@pytest.mark.parametrize("function", CASES)
def test_coefficients_are_those_of_jax(function):
    random = np.random.default_rng(1)
    with in_precision("float64"):
        low = random.uniform(-0.4, 0.4, (4, 3))
        width = random.uniform(0, 0.2, (4, 3))
        points, boxes = coefficients(function, low, low), coefficients(function, low, low + width)
        inside = low + random.random((50, 4, 3)) * width
        values = derivatives(function, np.concatenate([low[None], inside]).reshape(-1, 3))
        for k in range(ORDER + 1):
            seen, slack = values[k].reshape(51, 4, 3), 1e-13 * (1 + np.abs(values[k]).max())
            least, greatest = points[k].bounds()
            assert np.all((least <= seen[0] + slack) & (seen[0] - slack <= greatest))
            assert np.all(greatest - least < 1e-7 * (1 + np.abs(seen[0])))
            least, greatest = boxes[k].bounds()
            assert np.all((least <= seen + slack) & (seen - slack <= greatest))


def test_all_functions_have_derivatives_of_sets():
    """JAX may write the derivative of a function by another one without a rule."""
    missing = CURVED - {"integer_pow", "pow", "atan2", "square"}
    domain = {"acosh": 1.5, "log": 0.5, "rsqrt": 0.5, "sqrt": 0.5}
    with in_precision("float64"):
        for name in sorted(missing):
            low = np.full((1, 3), domain.get(name, 0.2))
            function = getattr(jax.lax, name)
            found = coefficients(lambda t, x, of=function: of(x), low, low + 0.01)
            assert all(np.isfinite(each.bounds()).all() for each in found), name
