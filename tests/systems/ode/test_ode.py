import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Status
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.systems.ode import ode

KEY = jax.random.key(0)


def oscillator(time, state, control, features):
    return {"x": state["v"], "v": -(features["w"] ** 2) * state["x"]}


def start(features, key):
    return {"x": features["x0"], "v": 0.0}


def swing(**options):
    return ode(oscillator, start, **{"dt": 0.01, "duration": 1.0, **options})


def pair_oscillator(time, state, control, features):
    return state[1], -(features["w"] ** 2) * state[0]


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("rk4", 4)])
def test_error_shrinks_with_the_order_of_the_method(method, order):
    with jax.enable_x64():
        errors = []
        for steps in (50, 100):
            system = ode(oscillator, start, dt=1 / steps, steps=steps, method=method)
            x = system({"x0": 1.5, "w": 2.0}, KEY)["x"]
            errors.append(abs(float(x[-1]) - 1.5 * np.cos(2.0)))
        assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)


def held_exactly(knots, x, delay=0.0, until=1.0):
    """The end of dx/dt = u - x under a held u, piece by piece."""
    length, time = 1.0 / len(knots), 0.0
    while time < until - 1e-9:
        u = knots[max(int((time - delay) / length + 1e-6), 0)]
        x, time = u + (x - u) * np.exp(-length), time + length
    return x


@pytest.mark.thorough
@pytest.mark.parametrize("substeps", [1, 2])
@pytest.mark.parametrize("delay", [0.0, 0.25])
def test_a_held_input_keeps_the_order_of_the_method(substeps, delay):
    # A last stage that reads the next piece's value leaves an error of order 1.
    knots = [0.5, 0.55, -1.0, 2.0]
    with jax.enable_x64():
        features = {"u": Waveform(jnp.asarray(knots), "constant", 1.0)}
        errors = []
        for steps in (8, 16):
            system = ode(
                lambda t, s, u, f: {"x": f["u"](t - delay) - s["x"]},
                lambda f, key: {"x": 0.3},
                dt=1 / steps,
                duration=1.0,
            )
            x = system.refined(substeps)(features, KEY)["x"]
            errors.append(abs(float(x[-1]) - held_exactly(knots, 0.3, delay)))
        assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.2)


def test_a_held_input_stays_within_a_step():
    def level(dynamics, **options):
        system = ode(dynamics, lambda f, k: {"x": 0.0}, **options)
        return np.asarray(system({"u": Waveform(jnp.asarray([0.5, 1.0]), "constant")}, KEY)["x"])

    # Whether a piece begins at the end of a step or in the middle of one.
    reads = lambda t, s, u, f: {"x": f["u"](t)}  # noqa: E731
    np.testing.assert_allclose(level(reads, dt=0.5, steps=2), [0, 0.25, 0.75])
    np.testing.assert_allclose(level(reads, dt=1 / 3, steps=3), [0, 1 / 6, 1 / 3, 2 / 3], rtol=1e-6)
    # A fixed time is read as it is, in every stage.
    fixed = lambda t, s, u, f: {"x": f["u"](0.5) + 0 * t}  # noqa: E731
    np.testing.assert_allclose(level(fixed, dt=0.5, steps=2), [0, 0.5, 1.0])


@pytest.mark.parametrize("substeps", [1, 3])
def test_pulses_stay_within_a_step(substeps):
    """Two pulses of 0.2 s from 0.1 s and 0.6 s on, integrated without an error of the method."""
    wave = Waveform(jnp.asarray([1.0, -3.0]), "pulse", None, (0.1, 0.6), 0.2)
    system = ode(lambda t, s, c, f: f["u"](t), lambda f, key: 0.0, dt=0.1, duration=1.0,
                 signals=lambda t, s, c, f: {"x": s}).refined(substeps)  # fmt: skip
    x = system({"u": wave}, KEY)["x"]
    expected = [0, 0, 0.1, 0.2, 0.2, 0.2, 0.2, -0.1, -0.4, -0.4, -0.4]
    np.testing.assert_allclose(x, expected, atol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("steps", [(8, 16), (6, 12)])
def test_a_linear_input_converges(steps):
    # The kinks at 0.25, 0.5 and 0.75 are at steps, or within them.
    knots = np.array([0.5, 0.55, -1.0, 2.0, 0.0])

    def system(count):
        wave = Waveform(jnp.asarray(knots), "linear", 1.0)
        loop = ode(lambda t, s, u, f: {"x": wave(t) - s["x"]}, start_x, dt=1 / count, steps=count)
        return float(loop({}, KEY)["x"][-1])

    def start_x(features, key):
        return {"x": jnp.asarray(0.3)}

    with jax.enable_x64():
        exact = system(4096)
        errors = [abs(system(count) - exact) for count in steps]
    order = np.log2(errors[0] / errors[1])
    assert order == pytest.approx(4, abs=0.2) if steps[0] % 4 == 0 else order > 1


def test_a_piece_begins_on_time_among_very_many():
    knots = jnp.arange(3000.0)
    wave = Waveform(knots, "constant", 300.0)
    begins = jnp.arange(3000, dtype=jnp.float32) * 0.1
    np.testing.assert_array_equal(jax.vmap(wave)(begins), knots)


def test_semi_implicit_euler_is_the_hand_computed_step_and_keeps_the_energy():
    with jax.enable_x64():
        system = ode(
            pair_oscillator,
            lambda f, key: (f["x0"], 0.0),
            dt=0.1,
            steps=2000,
            method="semi_implicit_euler",
            signals=lambda t, s, u, f: {"x": s[0], "v": s[1]},
        )
        trace = system({"x0": 1.0, "w": 2.0}, KEY)
        np.testing.assert_allclose(trace["v"][:3], [0, -0.4, -0.784])
        np.testing.assert_allclose(trace["x"][:3], [1, 0.96, 0.8816])
        energy = np.asarray(trace["v"] ** 2 + 4 * trace["x"] ** 2)
        assert energy.min() > 3.5
        assert energy.max() < 4.5


def test_semi_implicit_euler_uses_the_kinematics_it_is_given():
    system = ode(
        lambda t, s, u, f: (2 * s[1], 1.0),
        lambda f, key: (0.0, 0.0),
        dt=0.5,
        steps=2,
        method="semi_implicit_euler",
        signals=lambda t, s, u, f: {"x": s[0]},
    )
    np.testing.assert_allclose(system({}, KEY)["x"], [0, 0.5, 1.5])


def test_trace_has_a_sample_at_the_start_and_after_each_step():
    trace = swing(signals=lambda t, s, u, f: {"t": t, "x": s["x"]})({"x0": 0.5, "w": 1.0}, KEY)
    assert trace.length == 101
    assert trace.dt == 0.01
    assert trace.valid is None
    np.testing.assert_allclose(trace["t"], np.arange(101) * 0.01, rtol=1e-6)
    assert float(trace["x"][0]) == 0.5


def test_time_reaches_the_dynamics_at_each_stage():
    # d x / dt = 4 t^3 is integrated exactly by RK4, whose stages then know the time.
    system = ode(lambda t, s, u, f: {"x": 4 * t**3}, lambda f, k: {"x": 0}, dt=0.5, duration=2.0)
    np.testing.assert_allclose(system({}, KEY)["x"], (np.arange(5) * 0.5) ** 4, rtol=1e-6)


def test_key_reaches_the_initial_state():
    system = ode(
        lambda t, s, u, f: {"x": 0.0},
        lambda f, key: {"x": jax.random.normal(key)},
        dt=0.1,
        steps=1,
    )
    assert float(system({}, KEY)["x"][0]) == float(jax.random.normal(KEY))


def ramp(**options):
    """The control is the time, or what a controller with memory makes of it."""
    defaults = {
        "controller": lambda t, s, f: t,
        "dt": 1.0,
        "steps": 7,
        "method": "euler",
    }
    return ode(lambda t, s, u, f: {"x": u}, lambda f, k: {"x": 0.0}, **{**defaults, **options})


@pytest.mark.parametrize(
    ("period", "control"),
    [
        (1.0, [0, 1, 2, 3, 4, 5, 6, 7]),
        (2.0, [0, 0, 2, 2, 4, 4, 6, 6]),
        (3.0, [0, 0, 0, 3, 3, 3, 6, 6]),
        (7.0, [0, 0, 0, 0, 0, 0, 0, 7]),
    ],
)
@pytest.mark.parametrize("terminate", [None, lambda s, f: s["x"] > 1e6])
def test_control_is_held_for_its_period(period, control, terminate):
    trace = ramp(control_period=period, terminate=terminate)({}, KEY)
    np.testing.assert_array_equal(trace["control"], control)
    np.testing.assert_array_equal(trace["x"], np.concatenate([[0], np.cumsum(control)[:-1]]))


@pytest.mark.parametrize("period", [1.0, 2.0])
def test_controller_remembers(period):
    def integrator(time, state, memory, features):
        return memory, memory + 1.0

    trace = ramp(controller=integrator, controller_memory=0.0, control_period=period)({}, KEY)
    expected = np.arange(8) // int(period)
    np.testing.assert_array_equal(trace["control"], expected)


def test_no_control_step_is_taken_after_the_end():
    # The slope explodes once the duration is over; the state must not notice.
    system = ode(
        lambda t, s, u, f: {"x": jnp.where(t >= 1.0, jnp.inf, 1.0)},
        lambda f, k: {"x": 0.0},
        dt=0.25,
        duration=1.0,
        method="euler",
    )
    trace = system({}, KEY)
    assert int(trace.status) == Status.OK
    np.testing.assert_allclose(trace["x"], [0, 0.25, 0.5, 0.75, 1.0])


@pytest.mark.thorough
@pytest.mark.parametrize(("limit", "valid"), [(2.5, 4), (3.0, 5), (-1.0, 1), (100.0, 8)])
@pytest.mark.parametrize("period", [1.0, 2.0, 3.0])
def test_termination_freezes_everything(limit, valid, period):
    def remembering(time, state, memory, features):
        return {"one": 1.0, "count": memory}, memory + 1.0

    system = ode(
        lambda t, s, u, f: {"x": u["one"]},
        lambda f, k: {"x": 0.0},
        controller=remembering,
        controller_memory=0.0,
        control_period=period,
        dt=1.0,
        steps=7,
        method="euler",
        terminate=lambda s, f: s["x"] > f["limit"],
        signals=lambda t, s, u, f: {"x": s["x"], "t": t, "u": u["count"]},
    )
    trace = system({"limit": limit}, KEY)
    assert int(trace.valid) == valid
    assert trace.held
    held = np.minimum(np.arange(8), valid - 1)
    np.testing.assert_array_equal(trace["x"], held)
    np.testing.assert_array_equal(trace["t"], held)
    np.testing.assert_array_equal(trace["u"], held // int(period))


def test_gradient_is_finite_where_the_dynamics_end_in_a_singularity():
    # Torricelli: a tank that empties; below zero the slope is NaN.
    system = ode(
        lambda t, s, u, f: {"h": -jnp.sqrt(s["h"])},
        lambda f, k: {"h": f["h0"]},
        dt=0.1,
        duration=3.0,
        method="euler",
        terminate=lambda s, f: s["h"] <= 0,
    )

    def level(h0):
        trace = system({"h0": h0}, KEY)
        return jnp.sum(trace["h"]), trace.status

    (_, status), slope = jax.value_and_grad(level, has_aux=True)(1.0)
    assert int(status) == Status.OK
    nudged = [float(level(1.0 + d)[0]) for d in (-1e-3, 1e-3)]
    assert float(slope) == pytest.approx((nudged[1] - nudged[0]) / 2e-3, rel=2e-2)
    forward = jax.jvp(lambda h: level(h)[0], (1.0,), (1.0,))[1]
    assert float(forward) == pytest.approx(float(slope), rel=1e-4)


@pytest.mark.parametrize("terminate", [None, lambda s, f: s["x"] > 5])
def test_a_state_that_blows_up_is_not_finite_and_not_terminated(terminate):
    # x' = x^2 from 1 reaches infinity at t = 1.
    system = ode(
        lambda t, s, u, f: {"x": -(s["x"] ** 2)},
        lambda f, k: {"x": f["x0"]},
        dt=0.05,
        duration=3.0,
        terminate=terminate,
    )
    traces = jax.vmap(lambda x0: system({"x0": x0}, KEY))(jnp.array([-1.0, 1.0, jnp.nan]))
    assert traces.status is not None
    assert traces.status.dtype == jnp.int32
    np.testing.assert_array_equal(traces.status, [Status.NONFINITE, Status.OK, Status.NONFINITE])
    if terminate is not None:
        np.testing.assert_array_equal(traces.valid, [61, 61, 61])


@pytest.mark.thorough
@pytest.mark.parametrize("unroll", [1, 3])
@pytest.mark.parametrize("period", [None, 0.05])
def test_vmap_and_derivatives_agree_with_single_runs(unroll, period):
    system = swing(
        method="rk4",
        unroll=unroll,
        controller=lambda t, s, f: -f["w"] * s["v"],
        control_period=period,
        signals=lambda t, s, u, f: {"x": s["x"]},
        terminate=lambda s, f: s["x"] < -0.2,
    )

    def final(x0):
        return system({"x0": x0, "w": 2.0}, KEY)["x"][-1]

    starts = jnp.array([0.1, 0.2, 0.7])
    batch = jax.jit(jax.vmap(final))(starts)
    np.testing.assert_allclose(batch, [final(x) for x in starts], rtol=1e-6)
    backward = jax.vmap(jax.grad(final))(starts)
    forward = jax.vmap(jax.jacfwd(final))(starts)
    np.testing.assert_allclose(backward, forward, rtol=1e-5)


@pytest.mark.parametrize(
    ("state", "derivative", "signals", "names"),
    [
        ({"a": 0.0, "b": 1.0}, {"a": 1.0, "b": 1.0}, None, ["a", "b", "control"]),
        (
            ({"q": 0.0}, {"v": 1.0}),
            ({"q": 0.0}, {"v": 1.0}),
            None,
            ["q", "v", "control"],
        ),
        (jnp.zeros(3), jnp.ones(3), lambda t, s, u, f: {"s": s}, ["s"]),
    ],
)
def test_names_of_the_signals(state, derivative, signals, names):
    system = ode(
        lambda t, s, u, f: derivative,
        lambda f, k: state,
        controller=lambda t, s, f: 0.0,
        dt=1.0,
        steps=2,
        signals=signals,
    )
    assert sorted(system({}, KEY).signals) == sorted(names)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"dynamics": lambda t, s, f: s},
            r"dynamics is called with \(time, state, control, features\); got a function of "
            r"\(t, s, f\) \(.*test_ode.py, line \d+\)",
        ),
        ({"initial": lambda f: 0.0}, r"initial is called with \(features, key\); got a func"),
        (
            {"controller": lambda t, s, m, f: (0.0, m)},
            r"controller is called with \(time, state, features\); got a function of \(t, s, m, f",
        ),
        (
            {"controller": lambda t, s, f: 0.0, "controller_memory": 0.0},
            r"controller is called with \(time, state, memory, features\)",
        ),
        ({"signals": lambda t, s, f: {}}, r"signals is called with \(time, state, control, f"),
        ({"terminate": lambda t, s, f: True}, r"terminate is called with \(state, features\)"),
        ({"update": lambda s, f: s}, r"update is called with \(time, state, features\)"),
    ],
)
def test_functions_of_other_arguments_are_refused_at_once(options, message):
    parts = {"dynamics": oscillator, "initial": start, "dt": 0.01, "steps": 5, **options}
    with pytest.raises(ValueError, match=message):
        ode(**parts)


def test_functions_may_have_further_arguments_with_defaults():
    def dynamics(time, state, control, features, gain=1.0):
        return {"x": -gain * state["x"]}

    system = ode(dynamics, lambda *given: {"x": 1.0}, dt=0.1, steps=2)
    assert system({}, KEY)["x"].shape == (3,)


def test_named_control_keeps_its_names():
    trace = ramp(
        controller=lambda t, s, f: {"u": t, "flag": 1.0},
        signals=None,
        terminate=None,
    )
    with pytest.raises(ValueError, match="dynamics must return the state's derivative"):
        trace({}, KEY)
    system = ode(
        lambda t, s, u, f: {"x": u["u"]},
        lambda f, k: {"x": 0.0},
        controller=lambda t, s, f: {"u": t, "flag": 1.0},
        dt=1.0,
        steps=1,
    )
    assert sorted(system({}, KEY).signals) == ["flag", "u", "x"]


def test_vector_signals():
    system = ode(
        lambda t, s, u, f: {"p": jnp.ones(2)}, lambda f, k: {"p": jnp.zeros(2)}, dt=1, steps=3
    )
    assert system({}, KEY)["p"].shape == (4, 2)


def test_state_takes_the_precision_of_its_features():
    assert swing()({"x0": 1.0, "w": 1.0}, KEY)["x"].dtype == jnp.float32
    with jax.enable_x64():
        features = {"x0": jnp.float64(1), "w": jnp.float64(1)}
        assert swing()(features, KEY)["x"].dtype == jnp.float64
        assert swing()({"x0": 1, "w": 2}, KEY)["x"].dtype == jnp.float64


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dt": 0}, r"dt must be a positive number of seconds; got 0"),
        ({"dt": float("nan")}, r"dt must be a positive number of seconds; got nan"),
        ({"duration": 1.005}, r"duration must be a positive multiple of dt; got \(duration=1.005"),
        ({"duration": -1.0}, r"duration must be a positive multiple of dt; got \(duration=-1.0"),
        ({"steps": 3}, r"either duration or steps; got \(duration=1.0, steps=3\)"),
        ({"duration": None}, r"either duration or steps; got \(duration=None, steps=None\)"),
        ({"duration": None, "steps": 0}, r"steps must be an integer of at least 1; got 0"),
        ({"control_period": 0.02}, r"need a controller; got none"),
        (
            {"controller": lambda t, s, f: 0.0, "control_period": 0.015},
            r"control_period must be a positive multiple of dt; got \(control_period=0.015, dt",
        ),
        ({"unroll": 0}, r"unroll must be an integer of at least 1; got 0"),
    ],
)
def test_refuses_what_does_not_fit(options, message):
    with pytest.raises(ValueError, match=message):
        swing(**options)


def test_unknown_method_names_the_nearest():
    with pytest.raises(UnknownNameError, match="unknown method 'rk5'; did you mean 'rk4'"):
        swing(method="rk5")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"dynamics": lambda t, s, u, f: {"x": s["v"], "w": 0.0}},
            r"dynamics must return the state's derivative, in the form of the state: "
            r"\{'v': float32\[\], 'x': float32\[\]\}; got \{'w': float32\[\], 'x': float32\[\]\}",
        ),
        (
            {"dynamics": lambda t, s, u, f: {"x": s["v"], "v": jnp.zeros(2)}},
            r"\['v'\] must have shape \[\], got \[2\]",
        ),
        (
            {"dynamics": lambda t, s, u, f: {"x": s["v"], "v": jnp.int32(1)}},
            r"\['v'\] must be float32, got int32",
        ),
        ({"initial": lambda f, k: {}}, r"initial must return a state; got \{\}"),
        ({"initial": lambda f, k: {"x": "0"}}, r"real numbers; \['x'\] is '0'"),
        ({"method": "semi_implicit_euler"}, r"a tuple \(positions, velocities\); got"),
        (
            {"terminate": lambda s, f: s["x"]},
            r"terminate must return one truth value; got float32\[\]",
        ),
        (
            {"signals": lambda t, s, u, f: {"x": jnp.zeros((2, 2))}},
            r"signal 'x' must be a scalar or a vector at each sample; got float32\[2,2\]",
        ),
        ({"signals": lambda t, s, u, f: {}}, r"signals must return a dictionary of named samples"),
        ({"signals": lambda t, s, u, f: s["x"]}, r"signals must return a dictionary"),
        (
            {"controller": lambda t, s, m, f: (m, (m, m)), "controller_memory": 0.0},
            r"controller must return \(control, memory\)",
        ),
        (
            {"controller": lambda t, s, m, f: m, "controller_memory": 0.0},
            r"controller must return \(control, memory\)",
        ),
        (
            {"controller": lambda t, s, m, f: (m, m + 0.5), "controller_memory": 0},
            r"it must be int32, got float32",
        ),
    ],
)
def test_functions_that_do_not_fit_are_refused_while_tracing(options, message):
    parts = {"dynamics": oscillator, "initial": start, "dt": 0.01, "steps": 5, **options}
    system = ode(**parts)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(system, {"x0": 1.0, "w": 1.0}, KEY)


def test_names_that_clash_or_are_missing_are_refused():
    plain = ode(lambda t, s, u, f: s, lambda f, k: (0.0, 1.0), dt=1.0, steps=1)
    with pytest.raises(ValueError, match="no names to call its signals by; give signals="):
        plain({}, KEY)
    twice = ode(
        lambda t, s, u, f: {"control": 0.0},
        lambda f, k: {"control": 0.0},
        controller=lambda t, s, f: 0.0,
        dt=1.0,
        steps=1,
    )
    with pytest.raises(ValueError, match="are called 'control'"):
        twice({}, KEY)


@pytest.mark.thorough
def test_signals_that_are_the_state_are_vouched_for():
    def signals(time, state, control, features):
        return {"p": state["p"], "twice": 2 * state["p"], "inverse": 1 / state["p"]}

    system = ode(
        lambda time, state, control, features: {"p": features["rate"]},
        lambda features, key: {"p": jnp.zeros(())},
        dt=0.1,
        steps=3,
        signals=signals,
    )
    assert system({"rate": 1.0}).finite == ("p",)
    # What is not part of the state may be infinite while the state is not.
    assert not jnp.isfinite(system({"rate": 1.0}).signals["inverse"]).all()
    assert system({"rate": 1.0}).status == Status.OK
