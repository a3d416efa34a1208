"""Scenes of MuJoCo models: depth as MuJoCo's own rays measure it."""

import jax
import mujoco
import numpy as np
import pytest

from verifai_jax.addons.perception import mujoco_camera, mujoco_scene
from verifai_jax.core.messages.errors import UnknownNameError

MJCF = """
<mujoco><worldbody>
  <geom type="plane" size="20 20 1" rgba=".4 .5 .4 1"/>
  <geom type="box" size=".5 .3 .2" pos="3 .6 .9" euler="20 30 40" rgba="1 0 0 1"/>
  <geom type="capsule" size=".25 .5" pos="2.5 -.7 .8" euler="50 10 0" rgba="0 0 1 1"/>
  <geom type="cylinder" size=".3 .4" pos="4.5 -.2 .4" rgba="0 1 0 1"/>
  <geom type="sphere" size=".4" pos="4 1.6 .4" rgba="1 1 0 1"/>
  <geom type="ellipsoid" size=".4 .2 .1" pos="9 1.6 .4" rgba="1 1 0 0"/>
  <camera name="eye" pos="0 0 1.5" xyaxes=".1 -1 0 .2 .02 1" fovy="50"/>
</worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def model():
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.slow
def test_depth_is_that_of_mujoco_s_rays(model):
    model, data = model
    camera = mujoco_camera(model, data, "eye", 20, 30)
    depth = np.array(jax.jit(lambda: mujoco_scene(model, data).depth(camera))())
    rays = camera.rays()
    axes = [np.array(axis, np.float64) for axis in (rays.right, rays.down, rays.forward)]
    u, v, focal = np.array(rays.u), np.array(rays.v), float(rays.focal)
    met = np.zeros(1, np.int32)

    def cast(row, column):
        ray = column * axes[0] + row * axes[1] + axes[2]
        length = np.linalg.norm(ray)
        far = mujoco.mj_ray(model, data, data.cam_xpos[0], ray / length, None, 1, -1, met)
        return (np.inf if far < 0 else far / length), int(met[0])

    compared = set()
    for i, row in enumerate(v):
        for j, column in enumerate(u):
            near, what = cast(row, column)
            step = 0.5 / focal
            around = [cast(row + a * step, column + b * step)[1] for a in (-1, 1) for b in (-1, 1)]
            # MuJoCo's plane ends at 20 m, ours does not.
            if set(around) == {what} and near < 15:
                assert depth[i, j] == pytest.approx(near, rel=1e-3)
                compared.add(what)
    assert compared == {0, 1, 2, 3, 4}


def test_mistakes_are_named(model):
    model, data = model
    with pytest.raises(UnknownNameError, match="no camera 'eyes'; did you mean 'eye'"):
        mujoco_camera(model, data, "eyes")
    bad = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom name="egg" type="ellipsoid" size="1 2 3"/></worldbody></mujoco>'
    )
    with pytest.raises(ValueError, match="'egg' is a geom of kind ellipsoid; the camera"):
        mujoco_scene(bad, mujoco.MjData(bad))
