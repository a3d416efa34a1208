"""Constants that follow from masses and geometry, against `mj_setConst` and against compilation."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from verifai_jax.addons.simulators.mujoco.mjx_rollout import prepare_model
from verifai_jax.addons.simulators.mujoco.system import mujoco as model

# Bodies with one geom and with several, all kinds of joints and solids, two kinds of tendons.
TEXT = """
<mujoco>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="box" pos="0 0 1">
      <freejoint/>
      <geom name="box" type="box" size=".1 .2 .3"/>
      <body name="arm" pos=".1 0 .3">
        <joint type="ball"/>
        <geom name="upper" type="capsule" fromto="0 0 0 .3 0 .1" size=".04"/>
        <geom name="fist" type="sphere" pos=".3 0 .1" size=".07" density="500"/>
        <body name="tip" pos=".3 0 .1">
          <joint name="hinge" axis="0 1 0" range="-1 1" limited="true" armature=".01"/>
          <geom name="tip" type="cylinder" size=".03 .1" pos="0 .05 .1" euler="20 10 0"/>
          <site name="tip" pos="0 0 .1"/>
        </body>
      </body>
    </body>
    <body name="slide" pos="1 0 1">
      <joint name="slide" type="slide" axis="0 0 1"/>
      <geom name="egg" type="ellipsoid" size=".1 .2 .15" mass="2"/>
      <site name="slide"/>
    </body>
    <body name="spin" pos="2 0 0">
      <joint name="spin" axis="0 0 1"/>
      <geom name="spin" type="sphere" size=".05"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="rope"><site site="tip"/><site site="slide"/></spatial>
    <fixed name="gears"><joint joint="hinge" coef="2"/><joint joint="slide" coef="1"/></fixed>
  </tendon>
  <actuator>
    <muscle tendon="rope" lengthrange=".1 3"/>
    <motor name="motor" joint="hinge" gear="3"/>
  </actuator>
</mujoco>
"""
BIND = {
    "box": "geom/box/size",
    "upper": "geom/upper/size[0]",
    "fist": "geom/fist/pos",
    "egg": "geom/egg/size[1]",
    "shoulder": "body/arm/pos[0]",
    "armature": "joint/hinge/armature",
    "gear": "actuator/motor/gear[0]",
    "tip": "body/tip/mass",
    "spin": "body/spin/mass",
}
VALUES = {
    "box": np.array([0.15, 0.1, 0.2]),
    "upper": np.array(0.05),
    "fist": np.array([0.2, 0.05, 0.1]),
    "egg": np.array(0.3),
    "shoulder": np.array(0.2),
    "armature": np.array(0.05),
    "gear": np.array(2.0),
    "tip": np.array(3.0),
    "spin": np.array(2.0),
}
DERIVED = [
    *("body_mass", "body_ipos", "body_subtreemass", "body_invweight0", "dof_invweight0"),
    *("tendon_length0", "tendon_invweight0", "actuator_acc0", "geom_rbound", "actuator_gear"),
]


@pytest.fixture(scope="module")
def oracle():
    """The model with the values in its MJCF, compiled; but for the mass, which scales inertia."""
    spec = mujoco.MjSpec.from_string(TEXT)
    spec.geom("box").size = VALUES["box"]
    spec.geom("upper").size[0] = VALUES["upper"]
    spec.geom("fist").pos = VALUES["fist"]
    spec.geom("egg").size[1] = VALUES["egg"]
    spec.body("arm").pos[0] = VALUES["shoulder"]
    spec.joint("hinge").armature = VALUES["armature"]
    spec.actuator("motor").gear[0] = VALUES["gear"]
    compiled = spec.compile()
    for name in ("tip", "spin"):
        body = compiled.body(name).id
        compiled.body_inertia[body] *= VALUES[name] / compiled.body_mass[body]
        compiled.body_mass[body] = VALUES[name]
    mujoco.mj_setConst(compiled, mujoco.MjData(compiled))
    return compiled


@pytest.fixture(scope="module")
def system():
    return model(TEXT, duration=0.02, control_period=0.02, bind=BIND)


@pytest.fixture(scope="module")
def in_jax(system):
    with jax.enable_x64():
        values = {name: jnp.asarray(value) for name, value in VALUES.items()}
        constants = jax.jit(lambda values: prepare_model(system.loop.bindings, values)[0])
        # It runs once: a quick compilation is worth more than a quick program.
        quick = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
        return constants.lower(values).compile(compiler_options=quick)(values)


@pytest.fixture(scope="module")
def in_c(system):
    with jax.enable_x64():
        rows = {name: np.stack([value, value]) for name, value in VALUES.items()}
        keys = jax.random.split(jax.random.key(0), 2)
        in_c = system.with_backend("native")
        in_c.simulate_batch(rows, keys)
        return next(iter(in_c._native.batches.values())).get_model(1)


@pytest.mark.slow
@pytest.mark.parametrize("name", DERIVED)
def test_constants_are_those_of_mujoco(oracle, in_jax, in_c, name):
    wanted = getattr(oracle, name)
    for got in (getattr(in_jax, name), getattr(in_c, name)):
        np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-12)
    before = getattr(mujoco.MjModel.from_xml_string(TEXT), name)
    assert not np.allclose(before, wanted, rtol=1e-3)


def full_inertia(compiled):
    """Inertia of each body in its own frame, which principal axes in another order leave alone."""
    full = []
    for moments, quat in zip(compiled.body_inertia, compiled.body_iquat, strict=True):
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.asarray(quat))
        turn = turn.reshape(3, 3)
        full.append(turn @ np.diag(np.asarray(moments)) @ turn.T)
    return np.stack(full)


@pytest.mark.slow
def test_inertia_follows_size_and_mass(oracle, in_jax, in_c):
    for got in (in_jax, in_c):
        np.testing.assert_allclose(full_inertia(got), full_inertia(oracle), rtol=1e-9, atol=1e-12)


def test_a_body_with_stated_inertia_and_a_compiled_model_keep_it():
    text = TEXT.replace(
        '<geom name="box"', '<inertial pos="0 0 0" mass="7" diaginertia="1 1 1"/><geom name="box"'
    )
    for source in (text, mujoco.MjModel.from_xml_string(TEXT)):
        made = model(source, duration=0.02, control_period=0.02, bind={"a": "geom/box/size[0]"})
        assert made.loop.bindings.arrays == {"geom_size"}


def test_a_centre_of_mass_moves_away_from_where_mujoco_holds_it_fixed():
    """The body is "simple" as compiled: MuJoCo leaves out what couples its slide and its hinge."""
    text = """<mujoco><worldbody><body name="b"><joint name="x" type="slide" axis="1 0 0"/>
      <body name="c"><joint name="h" axis="0 1 0"/><geom name="g" type="box" size=".1 .1 .1"
      contype="0"/></body></body></worldbody></mujoco>"""
    text = text.replace(
        '<joint name="x" type="slide" axis="1 0 0"/>',
        '<joint name="x" type="slide" axis="1 0 0"/><geom type="sphere" size=".1" contype="0"/>',
    )
    made = model(
        text, duration=0.2, control_period=0.02, bind={"z": "geom/g/pos[2]", "h": "joint/h/qpos"}
    )
    with jax.enable_x64():
        got = made.with_backend("native")({"z": jnp.float64(0.3), "h": jnp.float64(0.5)})
    spec = mujoco.MjSpec.from_string(text)
    spec.geom("g").pos[2] = 0.3
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    data.qpos[1] = 0.5
    mujoco.mj_step(compiled, data, 100)
    np.testing.assert_allclose(got["h"][-1], data.qpos[1], rtol=1e-9)
    assert abs(data.qpos[0]) > 0.01


@pytest.mark.parametrize(
    ("source", "bind", "message"),
    [
        (
            TEXT.replace('name="box" type="box"', 'name="box" shellinertia="true" type="box"'),
            "geom/box/size[0]",
            r"did not compute from solid geoms .*; give body 'box' an <inertial>",
        ),
        (
            mujoco.MjModel.from_xml_string(TEXT),
            "body/spin/ipos[0]",
            r"centre of mass of body 'spin' lies at its origin.*give the MJCF",
        ),
    ],
)
def test_what_cannot_be_recomputed_is_refused(source, bind, message):
    with pytest.raises(ValueError, match=message):
        model(source, duration=0.02, control_period=0.02, bind={"a": bind})


@pytest.mark.thorough
def test_the_users_model_stays_as_it_is():
    compiled = mujoco.MjModel.from_xml_string(TEXT)
    before = copy.copy(compiled)
    made = model(compiled, duration=0.02, control_period=0.02, bind={"a": "body/tip/mass"})
    made.with_backend("native")({"a": jnp.float32(9)})
    np.testing.assert_array_equal(compiled.body_mass, before.body_mass)
