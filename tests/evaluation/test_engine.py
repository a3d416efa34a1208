"""The compiled evaluation: what it carries, packs, differentiates, and at what precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.evaluation.differentiation import Derivative
from verifai_jax.evaluation.engine import Engine, engine_for
from verifai_jax.evaluation.row import Packing, streaming_monitor
from verifai_jax.evaluation.verdicts import trace_verdict

KEY = run_keys(0)[1]
SPACE = {"start": vj.Box(0.5, 1.5), "drag": vj.Box(-0.5, 1.0)}


def falling(terminate=None):
    return vj.ode(
        lambda t, s, c, f: {"h": s["v"], "v": -1.0 - f["drag"] * s["v"]},
        lambda f, key: {"h": f["start"], "v": 0.0},
        dt=0.1,
        duration=2.0,
        terminate=terminate,
    )


def points(n, d, seed=0):
    return np.random.default_rng(seed).random((n, d), np.float32)


@pytest.mark.thorough
@pytest.mark.parametrize("terminate", [None, lambda s, f: s["h"] < 0], ids=["whole", "ends"])
def test_a_streaming_monitor_says_what_the_stored_trace_says(terminate):
    formulas = {
        "above": "always h >= 0.2",
        "window": "always[0.3, 1.1] (v >= -1 | h > 1)",
        "soon": "eventually[0.5, 1] h < 0.5",
        "until": "(h > 0) until v < -0.8",
    }
    problem = vj.Problem("fall", SPACE, falling(terminate), formulas)
    monitor = streaming_monitor(problem)
    assert monitor is not None
    features = jax.vmap(problem.space.unflatten)(points(64, 2))
    rho, status = jax.jit(jax.vmap(lambda f: monitor(f, KEY)))(features)
    wanted = jax.jit(jax.vmap(lambda f: trace_verdict(problem, problem.system(f, KEY))))(features)
    np.testing.assert_array_equal(status, wanted[1])
    # Two programs, of which a compiler may join other products and sums.
    np.testing.assert_allclose(rho, wanted[0], rtol=1e-6, atol=1e-6)


@pytest.mark.thorough
def test_a_streaming_monitor_reports_what_is_not_finite():
    system = vj.ode(
        lambda t, s, c, f: {"h": jnp.where(f["start"] > 1, jnp.inf, 0.0)},
        lambda f, key: {"h": f["start"]},
        signals=lambda t, s, c, f: {"h": s["h"], "gap": jnp.log(f["drag"] + 0 * s["h"])},
        dt=0.5,
        duration=1.0,
    )
    problem = vj.Problem("bad", SPACE, system, "always (h > 0 & gap < 9)")
    assert streaming_monitor(problem) is not None
    table = vj.falsify(problem, "uniform", 64, batch=64).table.all
    bad = (table["start"] > 1) | (table["drag"] < 0)
    assert bad.any()
    assert (~bad).any()
    assert (table["status"] == np.where(bad, "nonfinite", "ok")).all()


@pytest.mark.parametrize(
    ("spec", "why"),
    [
        ("always (h > 1 -> eventually[0, 1.5] h < 1)", "a window that is moved at every step"),
        ("always eventually h < 1", "looks ahead without end"),
    ],
)
def test_what_is_dear_to_carry_is_stored(spec, why):
    assert streaming_monitor(vj.Problem("fall", SPACE, falling(), spec)) is None, why


def test_packing_is_lossless():
    row = {
        "a": jnp.float32(jnp.nan),
        "n": jnp.arange(3, dtype=jnp.int32) - 7,
        "yes": jnp.array([True, False]),
        "m": jnp.full((2, 2), -0.0),
        "half": jnp.float16(1.5),
    }
    packing = Packing()
    packed = jax.jit(jax.vmap(packing.pack))(jax.tree.map(lambda x: jnp.stack([x, x]), row))
    assert set(packed) == {"uint32", "uint8", "uint16"}
    back = packing.unpack(packed, 1)
    for name, leaf in row.items():
        assert back[name].dtype == leaf.dtype
        np.testing.assert_array_equal(back[name], np.asarray(leaf)[None])
    assert np.signbit(back["m"]).all()


@pytest.mark.thorough
def test_float64_simulates_and_judges_in_float64():
    problem = vj.Problem("fall", SPACE, falling(), "always[0, 2] h >= 0")
    single = vj.falsify(problem, "uniform", 32, batch=32)
    double = vj.falsify(problem, "uniform", 32, batch=32, precision="float64")
    assert double.precision == "float64"
    rho = double.table.all["rho"]
    assert rho.dtype == np.float64
    np.testing.assert_allclose(rho, single.table.all["rho"], atol=1e-5)
    assert not np.array_equal(rho, rho.astype(np.float32))
    # In the run's own precision unless another is asked for.
    replayed = double.replay(3)
    assert abs(replayed.rho["spec"] - rho[3]) < 1e-14
    assert jnp.zeros(1).dtype == jnp.float32  # Nothing of it stays behind.


@pytest.mark.thorough
def test_float64_also_in_gradients_and_on_the_host():
    problem = vj.Problem("fall", SPACE, falling(), "always[0, 2] h >= 0")
    gradient = engine_for(problem, 8, True, "float64").evaluate(points(8, 2), KEY, 0, 0.05).gradient
    assert gradient is not None
    assert gradient.dtype == np.float64

    def simulate(features):
        return Trace({"h": np.array([1.0 + 1e-12 * features["drag"]])}, dt=1.0)

    host = vj.Problem("host", SPACE, vj.blackbox(simulate), "h >= 1")
    table = vj.falsify(host, "uniform", 4, batch=4, precision="float64").table.all
    np.testing.assert_allclose(table["rho"], 1e-12 * table["drag"], rtol=1e-3)


def test_refuses_other_precisions():
    problem = vj.Problem("fall", SPACE, falling(), "h >= 0")
    with pytest.raises(ValueError, match="precision must be 'float32' or 'float64'; got 'half'"):
        vj.falsify(problem, "uniform", 4, precision="half")


@pytest.mark.thorough
@pytest.mark.parametrize("d", [3, 4, 8, 11, 20])
def test_forward_and_reverse_agree(d):
    weights = jnp.linspace(-1, 1, d)

    def objective(u):
        return jnp.sin(weights @ u) + jnp.prod(u), {"sum": u.sum()}

    u = jnp.asarray(points(1, d)[0])
    wanted = jax.grad(lambda u: objective(u)[0])(u)
    for derivative in (Derivative(d), Derivative(d).by("forward")):
        gradient, auxiliary = jax.jit(lambda u, f=derivative: f(objective, u))(u)
        np.testing.assert_allclose(gradient, wanted, atol=1e-6)
        np.testing.assert_allclose(auxiliary["sum"], u.sum(), rtol=1e-6)
    assert Derivative(d).reverse
    assert Derivative(d, forward_up_to=11).reverse == (d > 11)
    assert not Derivative(1).reverse


class Iterated:
    """x* = cos(x* + a.u) by a loop that ends by itself, as a constraint solver's does."""

    reverse_hint = "give it a fixed number of iterations"

    def __call__(self, features, key=None):
        shift = jnp.stack([features[name] for name in sorted(features)]).mean()

        def more(carry):
            x, _, count = carry
            return jnp.cos(x + shift), jnp.abs(jnp.cos(x + shift) - x), count + 1

        # At a shift of 1 float32 goes round in a circle that is wider than the tolerance.
        x, *_ = jax.lax.while_loop(
            lambda c: (c[1] > 1e-6) & (c[2] < 200), more, (jnp.zeros(()), jnp.ones(()), 0)
        )
        return Trace({"x": x[None]}, dt=1.0)


@pytest.mark.slow
def test_a_loop_without_reverse_mode_is_differentiated_forward():
    space = {f"f{i}": vj.Box(0, 1) for i in range(6)}
    problem = vj.Problem("loop", space, Iterated(), "x <= 0.5")
    run = vj.falsify(problem, "gradient", 64, batch=16)
    assert len(run.table.counterexamples)
    assert len(run.notes) == 1
    assert "gradient by 6 forward sweeps" in run.notes[0]
    assert run.notes[0].endswith("give it a fixed number of iterations")
    assert run.notes[0] in run.summary()
    u = points(4, 6)
    gradient = engine_for(problem, 16, True).evaluate(u, KEY, 0, 0.05).gradient
    assert gradient is not None
    # Implicit function theorem: dx = -sin(x + s) (dx + ds).
    x = np.float64(0.7) + np.zeros(4)
    for _ in range(200):
        x = np.cos(x + u.mean(axis=1))
    slope = -np.sin(x + u.mean(axis=1)) / (1 + np.sin(x + u.mean(axis=1)))
    np.testing.assert_allclose(gradient, np.repeat(-slope[:, None] / 6, 6, axis=1), atol=1e-4)


@pytest.mark.slow
def test_gradients_that_are_not_finite_are_reported_by_row():
    def system(features, key):
        # At the left of the space the square root has an infinite slope.
        root = jnp.sqrt(jnp.maximum(features["a"] - 0.5, 0.0))
        return Trace({"x": (root + features["b"])[None]}, dt=1.0)

    problem = vj.Problem("root", {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}, system, "x >= 0.1")
    run = vj.falsify(problem, "gradient", 64, batch=32)
    table = run.table.all
    assert (table["status"] == "ok").all()
    assert not table["gradient_finite"].all()
    assert table.loc[table["a"] > 0.5, "gradient_finite"].all()
    lost = int((~table["gradient_finite"]).sum())
    asked = int(table["differentiated"].sum())
    assert lost <= asked < 64
    text = f"gradient     not finite in {lost} of the {asked} simulations that were differentiated"
    assert text in run.summary()
    assert "gradient_finite" not in vj.falsify(problem, "uniform", 8).table.all


def test_a_second_run_of_the_same_shapes_compiles_nothing():
    traces = []

    def system(features, key):
        traces.append(1)
        return falling()(features, key)

    problem = vj.Problem("fall", SPACE, system, "always[0, 2] h >= 0")
    vj.falsify(problem, "uniform", 100, batch=64)
    traced = len(traces)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: compiled.append(event)
    )
    vj.falsify(problem, "uniform", 164, batch=64, seed=1)
    # Checking may trace the system once more, abstractly.
    assert len(traces) <= traced + 1
    backend = [event for event in compiled if event.endswith("backend_compile_duration")]
    assert backend == []


def test_status_survives_packing():
    def system(features, key):
        return Trace({"x": jnp.ones(2)}, dt=1.0, status=jnp.int32(Status.TIMEOUT))

    evaluation = Engine(vj.Problem("late", SPACE, system, "x > 0"), 3).evaluate(
        points(3, 2), KEY, 0
    )
    assert evaluation.status.tolist() == [Status.TIMEOUT] * 3
    assert np.isnan(evaluation.rho).all()
