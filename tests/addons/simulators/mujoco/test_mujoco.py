"""MuJoCo models as systems: both backends on a cart-pole, and what is refused."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from envs import cartpole as analytic
from verifai_jax.addons.simulators.mujoco.bindings import Scaled
from verifai_jax.addons.simulators.mujoco.system import mjx, native
from verifai_jax.addons.simulators.mujoco.system import mujoco as model
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Status
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.systems.ode import ode
from verifai_jax.testing import check_forks

CART = str(Path(__file__).parents[4] / "envs" / "mujoco_cartpole.xml")
GAINS = np.array([0.91, 2.13, 30.6, 7.84])
BIND = {
    "x0": "joint/slider/qpos",
    "theta0": "joint/hinge/qpos",
    "masspole": "body/pole/mass",
    "length": ["geom/pole/size[2]", "geom/pole/pos[2]"],
    "cart": Scaled("body/cart/mass"),
    "wind": "body/cart/force[0]",
}
SIGNALS = {
    "x": "joint/slider/qpos",
    "theta": "joint/hinge/qpos",
    "tip": "site/tip/xpos[2]",
    "pole": "body/pole/xpos",
    "force": "actuator/motor/ctrl",
    "t": lambda time, state, control, features: time,
}


def linear(time, state, features):
    return GAINS @ jnp.stack([state.qpos[0], state.qvel[0], state.qpos[1], state.qvel[1]])


def loop(**options):
    return model(
        **{
            "model": CART,
            "duration": 1.0,
            "control_period": 0.02,
            "bind": BIND,
            "controller": linear,
            "signals": SIGNALS,
            "terminate": lambda state, features: jnp.abs(state.qpos[1]) > 0.2,
            **options,
        }
    )


def rows(n=4):
    spread = np.linspace(0, 1, n, dtype=np.float32)
    knots = np.stack([np.sin(np.arange(5) + i) for i in range(n)]).astype(np.float32)
    return {
        "x0": spread - 0.5,
        # The last row falls at once.
        "theta0": np.append(0.1 * spread[:-1], 0.25).astype(np.float32),
        "masspole": 0.05 + 0.4 * spread,
        "length": 0.3 + 0.6 * spread,
        "cart": 1 + 0.5 * spread,
        "wind": Waveform(2 * knots, "linear"),
    }


KEYS = jax.random.split(jax.random.key(0), 4)


@pytest.fixture(scope="module")
def traces():
    """The same four rows on each backend."""
    system = loop()
    in_c = system.with_backend("native").simulate_batch(rows(), KEYS)
    in_jax = jax.jit(jax.vmap(system.with_backend("mjx")))(jax.tree.map(jnp.asarray, rows()), KEYS)
    return in_c, in_jax


def test_a_system_is_written_in_a_line():
    written = repr(loop())
    assert written.startswith("MuJoCo(")
    assert "2 coordinates, 1 actuators, 1 s, backend=" in written
    assert len(written) < 100


@pytest.mark.thorough
@pytest.mark.parametrize("name", SIGNALS)
def test_backends_agree(traces, name):
    in_c, in_jax = traces
    assert in_c.signals[name].shape == in_jax.signals[name].shape
    scale = max(1.0, np.abs(in_c.signals[name]).max())
    # MJX has float32, MuJoCo float64.
    np.testing.assert_allclose(in_c.signals[name], in_jax.signals[name], atol=2e-5 * scale)


@pytest.mark.thorough
def test_backends_agree_on_how_it_ends(traces):
    in_c, in_jax = traces
    for name in ("valid", "status"):
        np.testing.assert_array_equal(getattr(in_c, name), getattr(in_jax, name))
    assert jax.tree.structure(in_c) == jax.tree.structure(in_jax)
    assert in_c.valid.tolist()[-1] == 1
    assert in_c.valid[0] == 51
    assert not in_c.status.any()


@pytest.mark.thorough
def test_rows_are_what_mujoco_gives_for_such_a_model(traces):
    """One row by hand: another model, compiled from a changed spec, stepped with mj_step."""
    spec, features = mujoco.MjSpec.from_file(CART), jax.tree.map(lambda leaf: leaf[1], rows())
    length = float(features["length"])
    spec.geom("pole").size[2] = spec.geom("pole").pos[2] = length
    spec.geom("pole").mass = float(features["masspole"])
    spec.geom("cart").mass = float(features["cart"])
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    data.qpos[:] = features["x0"], features["theta0"]
    xs, tips = [], []
    wind = features["wind"].over(1.0)
    for k in range(51):
        mujoco.mj_kinematics(compiled, data)
        xs.append(data.qpos[0])
        tips.append(data.site("tip").xpos[2])
        data.ctrl[0] = GAINS @ np.stack([data.qpos, data.qvel]).T.ravel()
        data.xfrc_applied[1, 0] = wind(k * 0.02)
        mujoco.mj_step(compiled, data, 4)
    in_c, _ = traces
    np.testing.assert_allclose(in_c.signals["x"][1], xs, atol=1e-5)
    np.testing.assert_allclose(in_c.signals["tip"][1], tips, atol=1e-5)
    assert np.ptp(xs) > 0.1


@pytest.mark.thorough
def test_samples_behind_the_end_repeat_it(traces):
    for trace in traces:
        for name, signal in trace.signals.items():
            np.testing.assert_array_equal(signal[-1] - signal[-1, :1], 0, name)
        np.testing.assert_allclose(trace.signals["t"][0], np.arange(51) * 0.02, rtol=1e-5)
        np.testing.assert_array_equal(trace.signals["t"][-1], 0)


@pytest.mark.thorough
def test_one_simulation_is_its_row_of_the_batch(traces):
    row = jax.tree.map(lambda leaf: leaf[2], rows())
    one = loop(backend="native")(row, KEYS[2])
    assert one.signals["x"].shape == (51,)
    assert int(one.valid) == traces[0].valid[2]
    np.testing.assert_array_equal(one.signals["x"], traces[0].signals["x"][2])


@pytest.mark.thorough
def test_a_batch_of_any_size_is_the_same_rows():
    """Sizes share programs, and batches of MuJoCo are used again: no row depends on the others."""
    system = loop(backend="native", terminate=None, duration=0.2)
    whole = rows(100)
    keys = jax.random.split(jax.random.key(1), 100)
    together = system.simulate_batch(whole, keys).signals["x"]
    for part in (slice(0, 100), slice(3, 94), slice(40, 41)):
        some = jax.tree.map(lambda leaf, part=part: leaf[part], whole)
        np.testing.assert_array_equal(
            system.simulate_batch(some, keys[part]).signals["x"], together[part]
        )


@pytest.mark.thorough
def test_mujoco_is_the_analytic_cart_pole():
    def push(time, state, features):
        return jnp.asarray(2 * jnp.sin(3 * time), jnp.float32)

    places = {name: BIND[name] for name in ("theta0", "masspole", "length")}
    system = loop(controller=push, bind=places, terminate=None, backend="native")
    features = {"theta0": 0.1, "masspole": 0.3, "length": 0.8}
    features = {name: jnp.float32(value) for name, value in features.items()}
    fine = ode(
        analytic.dynamics,
        analytic.initial,
        controller=push,
        control_period=0.02,
        dt=0.005,
        duration=1.0,
        signals=lambda t, s, u, f: s._asdict(),
    )(features)
    got = system(features)
    # Semi-implicit Euler at 5 ms against Runge-Kutta.
    np.testing.assert_allclose(got["theta"], np.asarray(fine["theta"])[::4], atol=4e-3)
    assert np.abs(got["theta"]).max() > 0.3


@pytest.mark.slow
def test_forks_go_on_bit_for_bit():
    system = loop(duration=0.4, bind={"x0": "joint/slider/qpos", "theta0": "joint/hinge/qpos"})
    space = vj.FeatureSpace({"x0": vj.Box(-1, 1), "theta0": vj.Box(-0.15, 0.15)})
    assert not system.with_backend("native").can_fork
    check_forks(system.with_backend("mjx"), space, samples=1)


def test_controller_with_memory_and_initial_state():
    def counting(time, state, memory, features):
        return memory, memory + 1.0

    def start(features, key, qpos, qvel):
        return qpos + jnp.array([features["x0"], 0.0]), qvel.at[0].set(jax.random.normal(key))

    system = loop(
        controller=counting,
        controller_memory=0.0,
        initial=start,
        bind=None,
        terminate=None,
        signals={"u": "actuator/motor/ctrl", "x": "joint/slider/qpos", "v": "joint/slider/qvel"},
        duration=0.1,
        backend="native",
    )
    trace = system({"x0": jnp.float32(0.5)}, KEYS[0])
    np.testing.assert_array_equal(trace["u"], np.arange(6))
    assert trace["x"][0] == 0.5
    assert trace["v"][0] == np.float32(jax.random.normal(KEYS[0]))


def test_a_simulation_that_blows_up_is_not_finite_and_does_not_begin_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def push(time, state, features):
        return jnp.where(time > 0.05, features["push"], 0.0)

    system = loop(
        controller=push, bind={"x0": "joint/slider/qpos"}, terminate=None, backend="native"
    )
    push = np.array([0.0, np.nan, np.inf, 1.0], np.float32)
    features = {"push": push, "x0": np.array([0, 0, 0, np.nan], np.float32)}
    trace = system.simulate_batch(features, KEYS)
    wrong = [Status.OK, Status.NONFINITE, Status.NONFINITE, Status.NONFINITE]
    np.testing.assert_array_equal(trace.status, wrong)
    # MuJoCo would write a log, and put the state back to where it began.
    assert not list(tmp_path.iterdir())
    np.testing.assert_array_equal(np.isnan(trace.signals["x"][3]), True)


def test_a_model_that_explodes_is_not_finite():
    system = loop(
        bind={"damping": "joint/hinge/damping", "theta_dot": "joint/hinge/qvel"},
        controller=lambda time, state, features: 1e30 * state.qvel[1],
        terminate=None,
        backend="native",
    )
    features = {"damping": np.zeros(2, np.float32), "theta_dot": np.array([0, 1], np.float32)}
    trace = system.simulate_batch(features, KEYS[:2])
    np.testing.assert_array_equal(trace.status, [Status.OK, Status.NONFINITE])


def test_default_signals_are_joints_and_sensors():
    text = (
        Path(CART)
        .read_text()
        .replace("</mujoco>", '<sensor><velocimeter name="speed" site="tip"/></sensor></mujoco>')
    )
    system = native(text, duration=0.1, control_period=0.02)
    trace = system({}, None)
    assert sorted(trace.signals) == ["hinge", "hinge_vel", "slider", "slider_vel", "speed"]
    assert trace["speed"].shape == (6, 3)
    assert trace.finite == ("slider", "slider_vel", "hinge", "hinge_vel")


@pytest.mark.thorough
def test_models_come_from_files_text_specs_and_compiled():
    text = Path(CART).read_text()
    sources = [Path(CART), text, mujoco.MjSpec.from_string(text)]
    sources.append(mujoco.MjModel.from_xml_string(text))
    for source in sources:
        system = native(source, duration=0.04, control_period=0.02, bind={"m": "body/pole/mass"})
        assert system({"m": jnp.float32(1)})["slider"].shape == (3,)
    # The user's model is not changed.
    assert sources[-1].opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET == 0


def test_backends_and_what_the_engine_asks():
    system = loop()
    assert system.backend == "auto"
    assert system.backends == ("native", "mjx")
    assert not system.black_box
    assert system.with_backend("native").black_box
    assert not system.with_backend("mjx").black_box
    assert system.with_backend("native").with_backend("auto").backend == "auto"
    assert system.reverse_hint == ""
    with pytest.raises(UnknownNameError, match="unknown backend 'nativ'; did you mean 'native'"):
        system.with_backend("nativ")
    abstract = system.abstract(jax.tree.map(lambda leaf: leaf[0], rows()))
    assert abstract.signals["pole"].shape == (51, 3)
    assert abstract.valid is not None


def test_a_model_that_mjx_cannot_do_is_left_to_native():
    text = """<mujoco><worldbody><body name="b"><joint name="j"/>
      <geom type="cylinder" size=".1 .1"/></body>
      <geom type="box" size=".1 .1 .1"/></worldbody></mujoco>"""
    system = model(text, duration=0.1, control_period=0.02)
    assert system.backends == ("native",)
    assert "CYLINDER" in system.why_not("mjx")
    assert system.black_box
    assert system({})["j"].shape == (6,)
    with pytest.raises(
        ValueError, match="backend 'mjx' is not possible: MJX does not support this model"
    ):
        mjx(text, duration=0.1, control_period=0.02)


@pytest.mark.parametrize(
    ("bind", "message"),
    [
        ("bodi/pole/mass", r"unknown kind in 'bodi/pole/mass': kind 'bodi'; did you mean 'body'"),
        ("body/pola/mass", r"unknown body in 'body/pola/mass': body 'pola'; did you mean 'pole'"),
        ("body/pole/masse", r"unknown field of a body in .*'masse'; did you mean 'mass'"),
        ("option/gravit", r"unknown option in 'option/gravit': option 'gravit'; did you mean 'gra"),
        (
            "option/gravity[3]",
            r"'option/gravity\[3\]': \[3\] is not part of it; its indices",
        ),
        ("joint/hinge/qpos[-1]", r"\[-1\] is not part of it; its indices are 0 to 0"),
        ("geom/pole/size[x]", r"\[x\] is not part of it"),
        ("pole", r"is written kind/name/field, like 'body/torso/mass'; got 'pole'"),
        ("body/pole", r"'body/pole' lacks a field: write body/pole/FIELD"),
        ("actuator/motor/kp", r"kp and kv are those of a servo"),
        ("actuator/motor/act", r"this actuator has no activation state"),
        (Scaled("joint/hinge/qpos"), r"the model has no value there to multiply"),
    ],
)
def test_bindings_to_nothing_are_refused(bind, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        loop(bind={"a": bind})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"signals": {"x": "joint/slidr/qpos"}}, r"unknown joint .*'slidr'; did you mean 'slider'"),
        (
            {"signals": {"x": "joint/slider/qqpos"}},
            r"unknown signal of a joint in .* did you",
        ),
        ({"signals": {"x": "sensor/imu"}}, r"unknown sensor in 'sensor/imu': sensor 'imu'\. There"),
        ({"signals": {"x": "contact/floor"}}, r"unknown geom in 'contact/floor': geom 'floor'"),
        ({"signals": {}}, r"signals has no signal in it"),
        ({"duration": 1.01}, r"duration must be a positive multiple of control_period; got"),
        (
            {"control_period": 0.008, "duration": 0.8},
            r"multiple of the model's timestep; got \(control_period=0.008",
        ),
        ({"backend": "mjxx"}, r"unknown backend 'mjxx'; did you mean 'mjx'"),
        ({"controller": None, "controller_memory": 0.0}, r"controller_memory needs a controller"),
        ({"bind": {"a": "body/pole/mass", "b": "body/pole/mass"}}, r"'a' and 'b' are both bound"),
        ({"model": "no/such.xml"}, r"there is no MJCF file 'no/such.xml'"),
        ({"model": "<mujoco><bla/></mujoco>"}, r"MJCF text is not a MuJoCo model: XML Error"),
        ({"controller": 3.0}, r"controller must be a function; got 3.0"),
        ({"bind": ["body/pole/mass"]}, r"bind must be a dictionary of paths by feature; got \['b"),
        ({"signals": ["joint/hinge/qpos"]}, r"signals must be a dictionary or a function; got"),
        ({"solver_iterations": 0}, r"solver_iterations must be an integer of at least 1; got 0"),
        ({"model": 3}, r"an MjSpec or an MjModel; got int"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, message):
    with unchecked(), pytest.raises((ValueError, FileNotFoundError), match=message):
        loop(**options)


def test_misspelt_options_name_the_nearest():
    with pytest.raises(UnknownNameError, match="'controler'; did you mean 'controller'"):
        loop(controler=None)


@pytest.mark.parametrize(
    ("options", "features", "message"),
    [
        ({}, {"x": 0.0}, r"unknown feature bound to 'body/pole/mass': 'm'"),
        ({}, {"m": 1.0, "n": 2.0}, r"feature 'n' is used by nothing: bind it"),
        ({}, {"m": np.ones(3)}, r"feature 'm' has shape \[3\], but 'body/pole/mass' has \[\]"),
        ({"bind": {"m": "geom/pole/pos"}}, {"m": 1.0}, r"bind one of its numbers, like 'geom/pole"),
        ({}, {"m": Waveform(np.ones(3))}, r"feature 'm' is a Signal, which can only drive a force"),
        (
            {"controller": lambda t, s, f: jnp.ones(2)},
            {"m": 1.0},
            r"the model has 1 actuators \(motor\), so controller must return a control of shape "
            r"\[1\]; got float32\[2\]",
        ),
        ({"controller": lambda t, s, f: {"u": 1.0}}, {"m": 1.0}, r"control of shape \[1\]; got \{"),
        (
            {"controller": lambda t, s, m, f: m, "controller_memory": 0.0},
            {"m": 1.0},
            r"controller must return \(control, memory\)",
        ),
        ({"terminate": lambda s, f: s.qpos}, {"m": 1.0}, r"terminate must return one truth value"),
        ({"initial": lambda f, k, q, v: q}, {"m": 1.0}, r"initial must return \(qpos, qvel\)"),
        (
            {"initial": lambda f, k, q, v: (q[:1], v)},
            {"m": 1.0},
            r"qpos must have shape \[2\], got \[1\]",
        ),
        (
            {"signals": lambda t, s, u, f: {"x": jnp.ones((2, 2))}},
            {"m": 1.0},
            r"signal 'x' must be a scalar or a vector",
        ),
        ({"bind": {"m": "actuator/motor/ctrl"}}, {"m": 1.0}, r"that the controller already sets"),
    ],
)
def test_features_and_functions_that_do_not_fit_are_refused(options, features, message):
    system = loop(**{"bind": {"m": "body/pole/mass"}, **options})
    with unchecked(), pytest.raises(ValueError, match=message):
        system.check(features)


def test_contacts_need_a_model_that_can_be_given_a_sensor():
    compiled = mujoco.MjModel.from_xml_path(CART)
    with pytest.raises(
        ValueError, match="needs a sensor, which cannot be added to a compiled MjModel"
    ):
        loop(model=compiled, signals={"hit": "contact/pole/cart"})
    with pytest.raises(UnknownNameError, match=r"unknown geom in 'contact/pole/cat': geom 'cat'"):
        loop(signals={"hit": "contact/pole/cat"})


@pytest.mark.thorough
def test_a_row_in_which_mujoco_raises_is_an_error_and_the_others_go_on(monkeypatch):
    from mujoco.batch import Batch, SimulationError

    system = loop(backend="native", terminate=None, duration=0.2)
    alone = system.simulate_batch(rows(), KEYS)
    step = Batch.step

    def refuse(self, ids=None, **options):
        going = np.ones(self.nsim, bool) if ids is None else np.array(ids)
        if not going[1]:
            return step(self, ids, **options)
        going[1] = False
        step(self, going, **options)
        raise SimulationError(np.array([1]), "stack overflow")

    monkeypatch.setattr(Batch, "step", refuse)
    trace = system.simulate_batch(rows(), KEYS)
    np.testing.assert_array_equal(trace.status, [Status.OK, Status.ERROR, Status.OK, Status.OK])
    np.testing.assert_array_equal(trace.signals["x"][[0, 2, 3]], alone.signals["x"][[0, 2, 3]])


@pytest.mark.slow
def test_one_system_in_both_precisions():
    system = loop(backend="native", terminate=None, duration=0.2)
    single = system.simulate_batch(rows(), KEYS).signals["x"]
    with jax.enable_x64():
        wide = jax.tree.map(lambda leaf: leaf.astype(np.float64), rows())
        double = system.simulate_batch(wide, KEYS).signals["x"]
    assert (single.dtype, double.dtype) == (np.float32, np.float64)
    np.testing.assert_allclose(single, double, atol=1e-5)
    one = jax.tree.map(lambda leaf: leaf[0], rows())
    in_jax = system.with_backend("mjx")
    assert jax.eval_shape(in_jax, one, KEYS[0]).signals["x"].dtype == jnp.float32
    with jax.enable_x64():
        one = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), wide)
        assert jax.eval_shape(in_jax, one, KEYS[0]).signals["x"].dtype == jnp.float64
