"""The same seed gives the same rows as it always has, for one problem of each kind of system.

`same_seed.json` holds the first rows that commit a84f6c9 gave, on one machine: bits may differ on
another processor, so numbers are compared with a tolerance.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from specs import cartpole, mujoco_cartpole

ROWS = json.loads((Path(__file__).parent / "same_seed.json").read_text())


def noisy(features, key):
    times = jnp.arange(40.0) * 0.1
    wind = jnp.interp(times, jnp.linspace(0, 4, 4), features["w"].knots)
    noise = 0.1 * jax.random.normal(key, (40,))
    x = jnp.sin(features["a"] * times) + features["n"] * 0.1 + noise + wind * 0.1
    return vj.Trace({"x": x, "k": jnp.full(40, features["n"])}, dt=0.1)


def function():
    space = {
        "a": vj.Box(0, 3),
        "n": vj.DiscreteBox(0, 5),
        "c": vj.Categorical("u", "v"),
        "w": vj.Signal(vj.Box(-1, 1), knots=4, hold="linear", duration=4.0),
    }
    spec = {"s": "always x < 1.6", "k": "always k < 5"}
    return vj.Problem("plain", space, noisy, spec)


def zero():
    def system(features, key):
        return vj.Trace({"k": jnp.full(5, features["n"]), "x": jnp.full(5, features["a"])}, dt=1.0)

    space = {"n": vj.DiscreteBox(0, 9), "a": vj.Box(0, 1)}
    return vj.Problem("zero", space, system, "always (k < 7 & x < 2)")


def black_box():
    def decay(features):
        return vj.Trace({"x": features["a"] * np.exp(-np.arange(5) * 0.1)}, dt=0.1)

    return vj.Problem("b", {"a": vj.Box(-1, 1)}, vj.blackbox(decay), "always x < 0.5")


def environment():
    pytest.importorskip("gymnax")

    def lean(observation):
        return (observation[2] > 0).astype(int)

    system = vj.gymnax("CartPole-v1", lean, steps=60, features={"push": "force_mag"})
    return vj.Problem("g", {"push": vj.Box(5, 15)}, system, "always abs(theta) < 0.2")


@pytest.mark.parametrize(
    ("name", "problem", "options"),
    [
        ("function", function, {}),
        ("zero", zero, {}),
        ("ode", lambda: cartpole.balance, {}),
        ("black box", black_box, {"search": "cross_entropy", "budget": 300}),
        pytest.param("gymnax", environment, {}, marks=pytest.mark.slow),
        pytest.param(
            "native",
            lambda: mujoco_cartpole.balance,
            {"backend": "native"},
            marks=pytest.mark.proves,  # Compiled as a user does: the policy's rounding decides.
        ),
    ],
)
def test_rows_of_a_seed_stay_what_they_were(name, problem, options):
    expected = ROWS[name]
    count = len(expected["rho"])
    options = {"search": "uniform", "budget": count, "confirm": False, **options}
    table = vj.falsify(problem(), **options).table.all.head(count)
    for column, values in expected.items():
        if isinstance(values[0], float):
            np.testing.assert_allclose(table[column], values, rtol=1e-4, atol=1e-5, err_msg=column)
        else:
            assert table[column].tolist() == values, column
