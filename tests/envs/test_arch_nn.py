import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from envs.arch import neural_network_controller as nn
from specs.arch import neural_network_controller as specs
from verifai_jax.core.values.waveform import Waveform


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64():
        yield


@pytest.fixture(scope="module")
def simulate():
    """Simulates references that are constant for a third of 40 s."""
    with jax.enable_x64():
        system = nn.neural_network_controller()
        run = jax.jit(lambda knots: system({"Ref": Waveform(knots, "constant")}))
        return lambda *knots: run(jnp.asarray(knots, jnp.float64))


def at(trace, times):
    return np.asarray(trace["Pos"])[np.rint(100 * np.array(times)).astype(int)]


def test_a_constant_reference_gives_what_others_computed(simulate):
    trace = simulate(2.0, 2.0, 2.0)
    times = [0, 0.1, 0.2, 0.5, 1, 1.5, 2, 3, 5, 40]
    wanted = [0.5, 1.050671, 2.000541, 3.297451, 2.676211, 2.093480]
    wanted += [2.013367, 2.007240, 2.004900, 2.006554]
    np.testing.assert_allclose(at(trace, times), wanted, rtol=0, atol=1e-6)
    assert np.max(trace["Pos"]) == pytest.approx(3.3245, abs=5e-5)
    assert np.argmax(trace["Pos"]) == 57


def test_steps_of_the_reference_are_followed_as_closely_as_the_loop_allows(simulate):
    trace = simulate(1.2, 2.8, 1.1)
    assert at(trace, [1])[0] == pytest.approx(1.366161, abs=1e-6)
    # Near its reference the loop is chaotic: what follows depends on the last bit, and so on the
    # version of XLA. Positions of 64 starts that are 1e-12 apart spread by up to 0.045, and their
    # margins by 0.016.
    times = [5, 13.3, 15, 26.6, 30, 40]
    wanted = [1.200993, 1.201941, 2.806120, 2.803133, 1.101366, 1.116840]
    np.testing.assert_allclose(at(trace, times), wanted, rtol=0, atol=0.045)
    margin = float(vj.mtl.robustness(specs.nn.formulas["spec"], trace))
    assert margin == pytest.approx(0.01437, abs=0.016)


def test_a_change_of_the_last_digits_moves_the_position_by_a_hundredth():
    states = nn.initial({})
    shifted = states._replace(position=states.position + 1e-12)
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), states, shifted)

    def step(state, k):
        state = jax.vmap(lambda s: nn.advance(k, s, {"Ref": 1.2}))(state)
        return state, state.position

    _, positions = jax.jit(lambda both: jax.lax.scan(step, both, jnp.arange(600)))(both)
    apart = np.abs(np.asarray(positions[:, 0] - positions[:, 1]))
    assert np.max(apart[:100]) < 1e-10
    assert np.max(apart) > 1e-3


def test_controller_and_plant_are_those_of_a_plain_program(simulate):
    pos, vel, before, u1, u2 = 0.5, 0.0, 0.0, 0.0, 0.0
    span, wanted = 3.9954019738068035 - 0.00127134724712792, []
    for _ in range(150):
        wanted.append(pos)
        yn = 2 * (pos - 0.00127134724712792) / span - 1
        rn = 2 * (2.5 - 0.00127134724712792) / span - 1
        x = np.array([yn, before, u1, u2])
        n1 = nn.LW6_2 * (nn.LW2_1 @ np.tanh(nn.IW1_1 @ x + nn.B1) + nn.B2)
        n2 = nn.LW6_5 * nn.LW5_4 * nn.IW5_3 * (nn.LW4_3 @ np.tanh(nn.IW3_2 @ x + nn.B3) + nn.B4)
        current = np.clip(((rn - n1) / n2 + 1) * (nn.MAXP - nn.MINP) / 2 + nn.MINP, -1, 4)
        before, u1, u2 = yn, 2 * (current - nn.MINP) / (nn.MAXP - nn.MINP) - 1, u1
        for _ in range(100):  # The midpoint rule, with a tenth of the step.

            def slope(p, v, i=current):
                return v, 15 * i**2 * np.sign(i) / (3 * p) - 9.8 - 12 * v / 3

            dp, dv = slope(pos, vel)
            dp, dv = slope(pos + 5e-5 * dp, vel + 5e-5 * dv)
            pos, vel = pos + 1e-4 * dp, vel + 1e-4 * dv
    found = np.asarray(simulate(2.5, 2.5, 2.5)["Pos"][:150])
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    system = nn.neural_network_controller(1.0)

    def outcome(x):
        position = system({"Ref": Waveform(x, "constant")})["Pos"]
        return jnp.stack([position[45], position[-1]])

    x, step = jnp.array([1.8, 2.3]), 1e-6
    jacobian = jax.jit(jax.jacfwd(outcome))(x)
    shifts = step * jnp.eye(2)
    beside = jax.jit(jax.vmap(outcome))(jnp.concatenate([x + shifts, x - shifts]))
    ahead, behind = jnp.split(beside, 2)
    np.testing.assert_allclose(jacobian, ((ahead - behind) / (2 * step)).T, rtol=1e-5, atol=1e-7)
