"""SC against a program in NumPy and SciPy, the values of its fact sheet, and its falsifiability."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from envs.arch import steam_condenser as model
from specs.arch import steam_condenser as specs
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.values.waveform import Waveform

REFERENCE = {0: 90, 1: 89.967437, 2: 89.888320, 3: 88.703232, 5: 86.490329, 10: 87.304953,
             20: 87.302569, 30: 87.292889, 35: 87.293300}  # fmt: skip


@pytest.fixture(scope="module")
def simulate():
    system = model.steam_condenser()
    run = jax.jit(jax.vmap(lambda knots: system({"steam": Waveform(knots, "constant")}, None)))
    return lambda knots: run(jnp.atleast_2d(jnp.asarray(knots)))


def derivative(t, y, steam):
    """The equations again, as one vector, by the sheet: tables by searching, sums by hand."""
    pressure, temperature, sensor, flow, *lags = y
    table = np.array([[50, 81.3167, 2305.42], [60, 85.9258, 2293.64], [70, 89.9315, 2283.30],
                      [80, 93.4854, 2274.05], [90, 96.6870, 2265.65], [100, 99.6059, 2257.92],
                      [110, 102.2923, 2250.76]])  # fmt: skip
    i = min(max(int(np.searchsorted(table[:, 0], pressure)) - 1, 0), 5)
    share = (pressure - table[i, 0]) / 10
    _, boiling, latent = table[i] + share * (table[i + 1] - table[i])
    mean = (temperature - 60) / np.log((boiling - 60) / (boiling - temperature))
    q = mean / (0.0872924756541668 / flow**0.8 + 0.00073786772008033)
    x = (sensor - (90 if t < 2 else 87) + 3.7742393716738434) * 2 / 9.5739824941763819 - 1
    o = np.tanh(x * model.IW + model.LW @ lags + model.B1)
    u = (model.LW2 @ o + model.B2 + 1) * (66.879264965962932 + 30.855068745036114) / 2
    wanted = min(max(u - 30.855068745036114 + 107.8880952381, 0), 200)
    moves = [o[j] - 10 * lags[j] for j in range(3)]
    moves += [lags[j] - 10 * lags[3 + j] for j in range(3)]
    heating = (q / 4.2 + (60 - temperature) * flow) / 500
    filling = (steam - q / latent) * boiling * 0.461526 / 3
    return [filling, heating, (pressure - sensor) / 0.5, wanted - flow, *moves]


@pytest.mark.slow
def test_values_of_the_sheet(simulate):
    pressure = np.asarray(simulate([4.0, 4.0])["P"][0])
    for time, expected in REFERENCE.items():
        assert pressure[time * 100] == pytest.approx(expected, abs=2e-4)


@pytest.mark.slow
def test_a_program_with_an_adaptive_solver():
    knots, dt = np.random.default_rng(3).choice([3.99, 4.01], 6), 6.0 / 6
    with in_precision("float64"):
        system = model.steam_condenser(duration=6.0)
        trace = jax.jit(lambda k: system({"steam": Waveform(k, "constant")}))(jnp.asarray(knots))
        trace = {name: np.asarray(value) for name, value in trace.signals.items()}
    state = [90, 80, 90, 107.8880952381, *[0] * 6]
    for i, steam in enumerate(knots):
        found = solve_ivp(derivative, (i * dt, (i + 1) * dt - 1e-12), state, args=(steam,),
                          rtol=1e-10, atol=1e-10, method="DOP853")  # fmt: skip
        state = found.y[:, -1]
        assert trace["P"][round((i + 1) * dt * 100)] == pytest.approx(state[2], abs=1e-6)
        assert trace["F"][round((i + 1) * dt * 100)] == pytest.approx(state[3], abs=1e-6)


@pytest.mark.proves
def test_many_pieces_break_it_and_twenty_do_not():
    """The steepest input of n pieces at the best instant, by linear responses, then simulated."""
    system = model.steam_condenser()
    published = {20: 0.0203, 35: 0.0029, 70: -0.00033}
    with in_precision("float64"):
        run = jax.jit(jax.vmap(lambda k: system({"steam": Waveform(k, "constant")})["P"][3000:]))
        usual = np.full((141, 140), 4.0)
        pushed = np.asarray(run(usual + 1e-3 * np.eye(141, 140)))
        responses, inputs = (pushed[:140] - pushed[140]) / 1e-3, usual.copy()
        for row, pieces in enumerate(published):
            each = responses.reshape(pieces, -1, responses.shape[1]).sum(1)
            instant = np.argmax(pushed[140] + 0.01 * np.abs(each).sum(0))
            steepest = np.where(each[:, instant] > 0, 4.01, 3.99)
            inputs[row] = np.repeat(steepest, 140 // pieces)
        worst = 87.5 - np.asarray(run(inputs))[:3].max(axis=1)
    np.testing.assert_allclose(worst, list(published.values()), atol=1e-4)


def test_the_formula_says_what_the_sheet_says():
    assert specs.sc.formulas["spec"].horizon() == 35
    assert specs.sc_instance1.space.dim == 200
