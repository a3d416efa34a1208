"""All kinds of bindings and sensors on both backends, and sensors against mj_step by hand."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from verifai_jax.addons.simulators.mujoco.system import mujoco as model
from verifai_jax.core.values.waveform import Waveform

TEXT = """
<mujoco>
  <option timestep="0.005" integrator="Euler"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 -2"/>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" range="-60 60" damping=".1"/>
      <geom name="upper" type="capsule" fromto="0 0 0 .5 0 0" size=".04" contype="0"
            conaffinity="0"/>
      <body name="lower" pos=".5 0 0">
        <joint name="elbow" axis="0 1 0"/>
        <geom name="lower" type="capsule" fromto="0 0 0 .4 0 0" size=".03" contype="0"
              conaffinity="0"/>
        <site name="hand" pos=".4 0 0"/>
      </body>
    </body>
    <body name="ball" pos="2 0 -1.95">
      <freejoint name="ball"/>
      <geom name="ball" type="sphere" size=".1"/>
      <site name="ball" size=".11"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="both" stiffness="1" damping=".1">
      <joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-1"/>
    </fixed>
  </tendon>
  <actuator>
    <position name="servo" joint="shoulder" kp="5" kv=".5"/>
    <general name="slow" joint="elbow" dyntype="filter" dynprm=".1" gainprm="2"/>
  </actuator>
  <sensor>
    <accelerometer name="acc" site="hand"/>
    <velocimeter name="velocity" site="hand"/>
    <framepos name="place" objtype="site" objname="hand"/>
    <jointactuatorfrc name="torque" joint="shoulder"/>
    <touch name="touch" site="ball"/>
  </sensor>
</mujoco>
"""
# For each feature a place, and two values.
FEATURES = {
    "start": ("joint/elbow/qpos", 0.5, -0.5),
    "spin": ("joint/shoulder/qvel", 1.0, 6.0),
    "friction": ("joint/elbow/frictionloss", 0.0, 0.5),
    "damping": ("joint/elbow/damping", 0.05, 0.5),
    "armature": ("joint/shoulder/armature", 0.0, 0.1),
    "stiffness": ("joint/elbow/stiffness", 0.5, 3.0),
    "spring": ("joint/elbow/springref", 0.0, 0.5),
    "limit": ("joint/shoulder/range[1]", 1.0, 0.3),
    "kp": ("actuator/servo/kp", 5.0, 20.0),
    "kv": ("actuator/servo/kv", 0.5, 1.0),
    "gear": ("actuator/slow/gear[0]", 1.0, 2.0),
    "lag": ("actuator/slow/dynprm[0]", 0.1, 0.03),
    "rope": ("tendon/both/stiffness", 1.0, 4.0),
    "air": ("option/density", 0.0, 20.0),
    "wind": ("option/wind[0]", 0.0, 3.0),
    "weight": ("option/gravity[2]", -9.81, -3.0),
    "load": ("body/lower/mass", 1.0, 3.0),
    "pull": ("body/lower/force[2]", 0.0, 5.0),
    "twist": ("body/lower/torque[1]", 0.0, 0.5),
    "grip": ("geom/ball/friction[0]", 1.0, 0.1),
    "roll": ("joint/ball/qvel[0]", 0.0, 2.0),
    "act": ("actuator/slow/act", 0.0, 0.3),
}
SENSORS = {name: f"sensor/{name}" for name in ("acc", "velocity", "place", "torque", "touch")}
SIGNALS = {
    "elbow": "joint/elbow/qpos",
    "shoulder": "joint/shoulder/qpos",
    "ball": "joint/ball/qpos[0:3]",
    "rope": "tendon/both/length",
    "act": "actuator/slow/act",
    "centre": "body/upper/subtree_com",
    "on": "contact/floor/ball",
    **SENSORS,
}


def control(time, state, features):
    return jnp.stack([jnp.sin(3 * time), jnp.cos(5 * time) * state.sensordata[3]])


def system(names=FEATURES, **options):
    bind = {name: FEATURES[name][0] for name in names}
    settings = {"duration": 0.6, "control_period": 0.02, "controller": control, "signals": SIGNALS}
    return model(TEXT, bind=bind, **{**settings, **options})


def rows_and_keys():
    """A row with the first values, one with the second, and one for each second value alone."""
    rows = {}
    for i, (name, (_, first, second)) in enumerate(FEATURES.items()):
        column = np.full(len(FEATURES) + 2, first, np.float32)
        column[[i + 1, -1]] = second
        rows[name] = column
    return rows, jax.random.split(jax.random.key(0), len(FEATURES) + 2)


@pytest.mark.slow
def test_backends_agree_on_every_kind_of_feature():
    (rows, keys), both = rows_and_keys(), system()
    in_c = both.with_backend("native").simulate_batch(rows, keys)
    in_jax = jax.jit(jax.vmap(both.with_backend("mjx")))(rows, keys)
    for name in SIGNALS:
        scale = max(1.0, np.abs(in_c.signals[name]).max())
        np.testing.assert_allclose(
            in_c.signals[name], in_jax.signals[name], atol=2e-3 * scale, err_msg=name
        )
    # Each feature alone changes something.
    for i, name in enumerate(FEATURES):
        changes = [
            np.abs(signal[i + 1] - signal[0]).max() / np.abs(signal).max()
            for signal in in_c.signals.values()
            if np.abs(signal).max() > 0
        ]
        if name not in ("wind", "grip"):  # No air to blow, and no motion to hinder, in row 0.
            assert max(changes) > 1e-3, name


@pytest.mark.thorough
def test_sensors_are_of_the_instant_but_those_of_acceleration():
    names = ("spin", "roll")
    trace = system(names, backend="native")({"spin": jnp.float32(2.0), "roll": jnp.float32(1.0)})
    compiled = mujoco.MjModel.from_xml_string(TEXT)
    data, now = mujoco.MjData(compiled), mujoco.MjData(compiled)
    data.joint("shoulder").qvel[0], data.joint("ball").qvel[0] = 2.0, 1.0
    for k in range(31):
        # The state as it is now: everything recomputed, nothing of the step before.
        now.qpos, now.qvel, now.act = data.qpos, data.qvel, data.act
        mujoco.mj_forward(compiled, now)
        for name in ("velocity", "place"):
            np.testing.assert_allclose(trace[name][k], now.sensor(name).data, atol=2e-5)
        np.testing.assert_allclose(trace["rope"][k], now.ten_length[0], atol=2e-5)
        # Those that need forces: of the last step.
        for name in ("acc", "torque", "touch"):
            wanted = data.sensor(name).data * (k > 0)
            got, scale = trace[name][k].reshape(wanted.shape), max(1.0, np.abs(wanted).max())
            np.testing.assert_allclose(got, wanted, atol=1e-4 * scale)
        data.ctrl[:] = np.sin(3 * 0.02 * k), np.cos(5 * 0.02 * k) * now.sensordata[3]
        mujoco.mj_step(compiled, data, 4)
    assert np.abs(trace["touch"]).max() > 1


def test_forces_that_are_signals_are_held_from_control_to_control():
    places = {"pull": "body/lower/force[2]", "push": "actuator/slow/ctrl"}
    made = model(
        TEXT,
        duration=0.4,
        control_period=0.04,
        bind=places,
        signals={"elbow": "joint/elbow/qpos", "push": "actuator/slow/ctrl"},
        backend="native",
    )
    pull, push = np.array([0, 5, -5], np.float32), np.array([1, -1], np.float32)
    features = {"pull": Waveform(pull), "push": Waveform(push, "constant")}
    trace = made(features)
    compiled = mujoco.MjModel.from_xml_string(TEXT)
    data = mujoco.MjData(compiled)
    lower = compiled.body("lower").id
    for k in range(11):
        np.testing.assert_allclose(trace["elbow"][k], data.joint("elbow").qpos[0], atol=1e-5)
        data.xfrc_applied[lower, 2] = np.interp(0.04 * k, [0, 0.2, 0.4], pull)
        data.ctrl[1] = 1.0 if k < 5 else -1.0
        assert trace["push"][k] == data.ctrl[1]
        mujoco.mj_step(compiled, data, 8)
