import pickle
import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.waveform import Waveform
from verifai_jax.evaluation.engine import Engine

pytest.importorskip("brax")

with warnings.catch_warnings():
    # Brax imports a package that says it is no longer maintained.
    warnings.simplefilter("ignore", DeprecationWarning)
    from brax.envs.base import Wrapper
    from brax.envs.inverted_pendulum import InvertedPendulum

from verifai_jax.systems.environments import brax_joined, episode
from verifai_jax.systems.environments._brax import brax

pytestmark = pytest.mark.filterwarnings("ignore:Brax System")
KEY = jax.random.key(3)


def lean(observation, memory):
    return -memory * observation[1:2] - 0.1, memory + 0.1


@pytest.fixture(scope="module")
def pole():
    """A pole whose gravity changes as time goes by, with a policy that remembers and is late."""
    return brax(
        Wrapper(InvertedPendulum(backend="generalized")),
        lean,
        policy_memory=jnp.array([0.5]),
        steps=6,
        features={"g": "gravity[2]"},
        initial={"angle": "q[hinge]"},
        signals={"angle": 1, "speed": 3},
        exact_step=False,
        observation_delay={"late": 2},
        action_delay=1,
    )


def features(angle, *, g=None):
    g = Waveform(jnp.array([-9.0, -5.0]), hold="linear") if g is None else g
    return {"angle": jnp.float32(angle), "late": jnp.int32(1), "g": g}


@pytest.fixture
def only_joined(monkeypatch):
    """Whatever is simulated is simulated by the one program, or else raises."""
    run = episode._run_joined
    failed = []

    def raises(*arguments):
        try:
            return run(*arguments)
        except Exception as error:
            failed.append(error)
            raise

    monkeypatch.setattr(episode, "_run_joined", raises)
    yield
    assert not failed


def plain(system):
    return replace(system, joined=None)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.02, 0.16])
@pytest.mark.usefixtures("only_joined")
def test_one_program_simulates_what_a_start_and_steps_do(pole, angle):
    found = jax.jit(pole)(features(angle), KEY)
    expected = jax.jit(plain(pole))(features(angle), KEY)
    assert (int(found.valid) == 7) == (angle < 0.1)
    assert int(found.valid) == int(expected.valid)
    assert sorted(found.signals) == sorted(expected.signals)
    for name in expected.signals:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:scatter inputs")  # Of Brax, in double precision.
@pytest.mark.usefixtures("only_joined")
def test_one_program_in_double_precision_at_any_step_and_its_gradient(pole):
    with jax.enable_x64():

        def last(system, factor, angle):
            given = {"angle": angle, "late": jnp.int32(0), "g": -9.0}
            return system.refined(factor)(given, KEY)["angle"][-1]

        found = [jax.jit(lambda f: last(pole, f, 0.02))(jnp.int32(factor)) for factor in (1, 2)]
        slope = jax.jit(jax.grad(lambda angle: last(pole, 2, angle)))(0.02)
        steps = jax.jit(jax.vmap(lambda f, angle: last(plain(pole), f, angle)))
        angles = jnp.array([0.02, 0.02, 0.02001, 0.01999])
        expected = np.asarray(steps(jnp.int32([1, 2, 2, 2]), angles))
        found, slope = np.asarray(found), float(slope)
    assert expected.dtype == np.float64
    np.testing.assert_allclose(found, expected[:2], rtol=1e-9)
    np.testing.assert_allclose(slope, (expected[2] - expected[3]) / 2e-5, rtol=1e-5)
    assert found[0] != found[1]


@pytest.mark.usefixtures("only_joined")
def test_the_program_is_much_smaller(pole):
    given = features(0.02, g=jnp.float32(-9.0))
    sizes = [len(jax.jit(s).lower(given, KEY).as_text()) for s in (pole, plain(pole))]
    assert sizes[0] < 0.75 * sizes[1]


def test_all_its_engines_compile_with_less_effort(pole):
    space = {"angle": vj.Box(0.0, 0.1), "late": vj.Constant(0), "g": vj.Constant(-9.0)}
    for system, effort in ((pole, "little"), (plain(pole), "most")):
        problem = vj.Problem("pole", space, system, "always angle < 1")
        assert Engine(problem, 2).effort == effort
        # Those of derivatives do anyway.
        assert Engine(problem, 2, gradient=True).effort == "little"
        assert Engine(problem, 2, effort="least").effort == "least"


def test_physics_of_another_kind_is_left_as_it_is():
    assert brax_joined.join(InvertedPendulum(backend="spring")) is None

    class Own(InvertedPendulum):
        def pipeline_init(self, *arguments):
            return super().pipeline_init(*arguments)

    assert brax_joined.join(Own(backend="generalized")) is None


def test_an_environment_that_starts_the_physics_twice_is_simulated_as_it_is():
    class Twice(InvertedPendulum):
        def reset(self, rng):
            first = super().reset(rng)
            physics = first.pipeline_state
            return first.replace(pipeline_state=self.pipeline_init(physics.q + 0.01, physics.qd))

    system = brax(Twice(backend="generalized"), lambda seen: 0.1, steps=3, signals={"x": 0})
    assert system.joined is not None
    found, expected = (
        str(jax.make_jaxpr(lambda key, one=one: one({}, key).signals)(KEY))
        for one in (system, plain(system))
    )
    assert len(found) == len(expected)


def test_it_travels_to_other_processes():
    joined = brax_joined.join(InvertedPendulum(backend="generalized"))
    copied = pickle.loads(pickle.dumps(joined))
    assert isinstance(copied, brax_joined.Joined)
