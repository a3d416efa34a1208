"""Keyframes, mocap bodies, masses of geoms, delays, controllers in Python, and what MJX refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.simulators.mujoco import Scaled, mujoco, native

mj = pytest.importorskip("mujoco")

MODEL = """<mujoco><option timestep="0.01" {option}><flag {flag}/></option>
<worldbody>
  <body name="target" mocap="true" pos="1 0 1">
    <geom name="t" type="sphere" size=".05" contype="0" conaffinity="0"/></body>
  <body name="cart"><joint name="s" type="slide" axis="1 0 0"/>
    <geom name="c" type="box" size=".1 .1 .1"/>
    <body name="pole" pos="0 0 .1"><joint name="h" type="hinge" axis="0 1 0"/>
      <geom name="p" type="capsule" size=".02 .3" pos="0 0 .3"/>
      <geom name="tip" type="sphere" size=".05" pos="0 0 .6" mass="{tip}"/></body></body>
  <body name="stated" pos="5 0 0"><joint type="slide"/>
    <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><geom name="g" size=".1"/></body>
</worldbody>
<actuator><motor name="m" joint="s"/></actuator>{sensor}
<keyframe><key name="home" qpos="0.5 0.2 0" ctrl="0.7" mpos="2 0 1"/></keyframe></mujoco>"""
SIGNALS = {"x": "joint/s/qpos", "tx": "body/target/xpos[0]"}
TIMES = {"duration": 0.2, "control_period": 0.02}


def model(option="", flag='energy="disable"', tip=0.3, sensor=""):
    return MODEL.format(option=option, flag=flag, tip=tip, sensor=sensor)


def cart(source=None, **options):
    return mujoco(source or model(), **{"signals": SIGNALS, **TIMES, **options})


class TestPaths:
    def test_a_keyframe_begins_with_its_state_and_control(self):
        trace = cart(keyframe="home", backend="native")({})
        assert trace.signals["x"][0] == pytest.approx(0.5)
        assert trace.signals["tx"][0] == 2.0
        still = cart(keyframe=0, backend="native", controller=lambda t, s, f: 0.0)({})
        assert trace.signals["x"][-1] > still.signals["x"][-1] + 1e-4  # By its control, 0.7.
        bound = cart(keyframe="home", backend="native", bind={"a": "joint/s/qpos"})
        assert bound({"a": jnp.float32(0.25)}).signals["x"][0] == 0.25

    @pytest.mark.parametrize(
        ("keyframe", "message"),
        [
            ("hom", "unknown keyframe 'hom'; did you mean 'home'"),
            (3, "keyframe must be a name or a number from 0 to 0; got 3"),
            (True, "keyframe must be a name or a number"),
        ],
    )
    def test_a_keyframe_that_the_model_lacks_is_refused(self, keyframe, message):
        with pytest.raises(ValueError, match=message):
            cart(keyframe=keyframe)

    @pytest.mark.thorough
    def test_the_mass_of_a_geom_is_that_of_a_model_compiled_so(self):
        system = cart(
            backend="native", bind={"tip": "geom/tip/mass", "more": Scaled("geom/p/mass")},
            keyframe=0,
        )  # fmt: skip
        other = model(tip=0.5).replace('type="capsule"', 'type="capsule" density="2000"')
        trace = system({"tip": jnp.float32(0.5), "more": jnp.float32(2.0)})
        wanted = cart(other, backend="native", keyframe=0)({})
        np.testing.assert_allclose(trace.signals["x"], wanted.signals["x"], atol=1e-6)
        with pytest.raises(ValueError, match="'geom/g/mass': the inertia of body 'stated' is giv"):
            cart(bind={"m": "geom/g/mass"})

    @pytest.mark.slow
    def test_a_mocap_body_goes_where_a_feature_says_on_both_engines(self):
        system = cart(bind={"goal": "body/target/pos[0]", "tip": "geom/tip/mass"}, keyframe=0)
        features = {"goal": jnp.float32(3.0), "tip": jnp.float32(0.4)}
        here = system.with_backend("native")(features)
        there = jax.jit(system.with_backend("mjx"))(features)
        for trace in (here, there):
            np.testing.assert_array_equal(trace.signals["tx"], 3.0)
        np.testing.assert_allclose(here.signals["x"], there.signals["x"], atol=1e-5)


SEEN = {"signals": {"u": lambda time, state, control, features: control[0]}}


class TestDelays:
    @pytest.mark.slow
    @pytest.mark.parametrize("backend", ["native", pytest.param("mjx", marks=pytest.mark.thorough)])
    def test_a_decision_takes_effect_later(self, backend):
        system = cart(
            controller=lambda time, state, features: 1.0 + time, backend=backend,
            action_delay={"lag": 3}, **SEEN,
        )  # fmt: skip
        simulate = system if backend == "native" else jax.jit(system)
        sent = simulate({"lag": jnp.int32(2)}).signals["u"]
        np.testing.assert_allclose(sent[:5], [0, 0, 1, 1.02, 1.04], atol=1e-6)
        trace = simulate({"lag": jnp.int32(4)})
        assert int(trace.status) == int(vj.Status.ERROR)
        assert "whole number of steps from 0 to 3" in str(system.why_error({"lag": 4}))

    def test_a_delay_that_cannot_be_is_refused(self):
        with pytest.raises(ValueError, match="action_delay needs a controller"):
            cart(action_delay=1)
        with pytest.raises(ValueError, match="action_delay must be a number of steps"):
            cart(action_delay=-1, controller=lambda t, s, f: 0.0)
        system = cart(action_delay={"lag": 3}, controller=lambda t, s, f: 0.0)
        with pytest.raises(ValueError, match="unknown feature of action_delay: 'lag'"):
            vj.Problem("p", vj.FeatureSpace({"x": vj.Box(0, 1)}), system, "x < 9").check()


GAINS = np.array([1.0, 2.0, 0.0])


def python_controller(time, state, features):
    weights = np.array(GAINS)
    return float(-np.asarray(state.qpos) @ weights) * float(features["k"])


class TestControllersInPython:
    SPACE = vj.FeatureSpace({"k": vj.Box(0, 2)})

    @pytest.mark.slow
    def test_native_calls_them_and_says_so(self):
        system = cart(controller=python_controller, backend="native", keyframe=0)
        problem = vj.Problem("cart", self.SPACE, system, "always x < 0.505")
        run = vj.falsify(problem, "uniform", budget=4, confirm=False, progress=False)
        assert (run.table.all["status"] == "ok").all()
        assert any("the controller runs in Python" in note for note in run.notes)
        traced = cart(
            controller=lambda t, s, f: -(s.qpos @ jnp.asarray(GAINS)) * f["k"],
            backend="native", keyframe=0,
        )  # fmt: skip
        for row in range(4):
            k = {"k": jnp.float32(run.table.row(row)["k"])}
            np.testing.assert_allclose(system(k).signals["x"], traced(k).signals["x"], atol=1e-6)
        assert traced.notes == ()

    @pytest.mark.slow
    def test_their_memory_goes_along(self):
        def counting(time, state, memory, features):
            if memory > 2:
                return 1.0, memory
            return 0.0, memory + 1

        system = cart(controller=counting, controller_memory=0, backend="native", **SEEN)
        assert system({}).signals["u"].tolist() == [0.0] * 3 + [1.0] * 8

    def test_elsewhere_the_error_names_the_way(self):
        problem = vj.Problem("cart", self.SPACE, cart(controller=python_controller), "x < 1")
        with pytest.raises(vj.ProblemError, match=r'Use jnp .* run it with backend="native"'):
            problem.check()

    def test_what_is_wrong_in_python_too_is_told(self):
        system = native(model(), signals=SIGNALS, **TIMES, controller=lambda t, s, f: float(f["q"]))
        with pytest.raises(vj.ProblemError, match="no feature 'q'"):
            vj.Problem("cart", self.SPACE, system, "x < 1").check()


class TestRefusals:
    def test_flags_that_change_no_step_are_cleared_and_noted(self):
        system = cart(model(flag='energy="enable" fwdinv="enable"'))
        assert system.why_not("mjx") is None
        assert "mjENBL_ENERGY is cleared: it changes no step" in system.notes[0]
        assert "mjENBL_FWDINV" in system.notes[1]
        compiled = mj.MjModel.from_xml_string(model(flag='energy="enable"'))
        assert cart(compiled).why_not("mjx") is None
        assert int(compiled.opt.enableflags) == int(mj.mjtEnableBit.mjENBL_ENERGY)

    @pytest.mark.parametrize(
        ("change", "lines"),
        [
            ({"option": 'solver="PGS"'}, ["spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON"]),
            (
                {"option": 'solver="PGS" integrator="implicit"'},
                ["mjINT_IMPLICITFAST; spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON"],
            ),
            (
                {"option": 'integrator="implicitfast" density="1"'},
                ["spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER"],
            ),
            ({"sensor": '<sensor><e_kinetic name="e"/></sensor>'}, ["spec.delete(s)"]),
        ],
    )
    def test_the_message_names_lines_that_cure_it(self, change, lines):
        why = cart(model(**change)).why_not("mjx")
        assert "spec = mujoco.MjSpec.from_file('model.xml'); " in why
        for line in lines:
            assert line in why
        spec = mj.MjSpec.from_string(model(**change))
        code = why.split("`")[1].partition("; ")[2]
        exec(code.replace("; for", "\nfor"), {"spec": spec, "mujoco": mj})
        assert cart(spec).why_not("mjx") is None


class TestWhatTakesLong:
    def test_a_compilation_of_minutes_is_announced_with_its_reason_and_a_cheaper_way(self):
        floor = '<geom name="floor" type="plane" size="9 9 1" pos="0 0 -9"/><body name="target"'
        source = model('integrator="RK4"').replace('<body name="target"', floor)
        system = cart(source, backend="mjx")
        why = system.why_slow_to_compile(True)
        assert "MJX compiles this model for minutes" in why
        assert "four times in each Runge-Kutta step" in why
        assert 'integrator="implicitfast"' in why
        assert 'backend="native"' in why
        assert system.with_backend("native").why_slow_to_compile(True) == ""
        assert cart(source, backend="auto").why_slow_to_compile(True) == ""

    @pytest.mark.slow
    def test_a_row_of_mjx_is_replayed_natively_where_that_gives_its_number(self):
        system = cart(backend="mjx", bind={"x0": "joint/s/qpos"}, keyframe=0)
        space = vj.FeatureSpace({"x0": vj.Box(0, 1)})
        problem = vj.Problem("cart", space, system, "always x < 0.8")
        run = vj.falsify(problem, "uniform", budget=4, batch=4, confirm=False, progress=False)
        seen = run.replay(1)
        assert seen.finding == ""
        assert seen.rho["spec"] == pytest.approx(run.table.row(1)["rho"], abs=1e-5)
        assert "engine       native MuJoCo" in str(seen)
        other = run.table.all.copy()
        other["rho"] += 0.1
        assert run._natively(1, run.table.row(1), other.loc[1].to_dict()) is None
