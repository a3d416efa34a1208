"""MuJoCo's pictures: that they show what was simulated, and what is said where there are none."""

import logging
import os
import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest
from PIL import Image, ImageSequence

import verifai_jax as vj
from verifai_jax.addons.simulators.mujoco.system import mujoco
from verifai_jax.addons.simulators.pictures import frames as films
from verifai_jax.addons.simulators.pictures import mujoco_motion
from verifai_jax.addons.simulators.pictures import mujoco_scene as scene
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.evaluation.replay import replay
from verifai_jax.pictures import animate
from verifai_jax.pictures.run_pictures import write_replay_pictures

# A red ball above the ground, seen from the side; 2 m of height are 60 pixels.
BALL = """
<mujoco><option timestep="0.01"/>
  <visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
  <worldbody>
    <camera name="side" pos="0 -4 1" xyaxes="1 0 0 0 0 1" fovy="60"/>
    <camera name="above" pos="0 0 9" fovy="60"/>
    <body name="ball" pos="0 0 1.5">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <geom name="ball" size="0.1" rgba="1 0 0 1" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""
SIZE = (160, 120)
FOCAL = 60 / np.tan(np.pi / 6)  # pixels


def problem(backend="native", **options):
    system = mujoco(
        BALL,
        duration=0.4,
        control_period=0.02,
        bind={"size": "geom/ball/size[0]", "wind": "body/ball/force[0]", "vx": "joint/x/qvel"},
        signals={"z": "joint/z/qpos", "x": "joint/x/qpos"},
        backend=backend,
        **options,
    )
    domains = {"size": vj.Box(0.05, 0.4), "wind": vj.Box(-9, 9), "vx": vj.Box(0, 2)}
    return vj.Problem("ball", vj.FeatureSpace(domains), system, "always z > -0.5")


@pytest.fixture(scope="module")
def seen():
    row = {"size": 0.2, "wind": 0.0, "vx": 2.0}
    return replay(problem(), row, jax.random.key(0), 7)


@pytest.fixture(scope="module")
def motion(seen):
    return mujoco_motion.record(seen)


@pytest.fixture
def gl(motion):
    try:
        with scene.canvas(motion.model, (32, 32)):
            pass
    except scene.NoRenderer as error:
        pytest.skip(str(error))


def red(picture):
    """Centre (right, down) and width in pixels of what is red, from the picture's middle."""
    picture = np.asarray(picture, int)
    rows, columns = np.nonzero((picture[..., 0] > 150) & (picture[..., 1:].max(-1) < 90))
    height, width = picture.shape[:2]
    return columns.mean() + 0.5 - width / 2, rows.mean() + 0.5 - height / 2, np.ptp(columns) + 1


@pytest.mark.slow
def test_what_is_recorded_is_what_was_replayed(seen, motion):
    assert seen.violated
    np.testing.assert_array_equal(motion.qpos[:, 0], np.asarray(seen.trace["x"], float))
    np.testing.assert_array_equal(motion.qpos[:, 1], np.asarray(seen.trace["z"], float))
    assert motion.qpos[-1, 0] == pytest.approx(0.8, abs=1e-6)
    assert motion.model.geom("ball").size[0] == pytest.approx(0.2)
    assert motion.caption == "ball, row 7: violated"
    # z < -0.5 first at 0.32 s; the least robustness is at the end.
    assert motion.decisive == 20
    # The system's own model stays as it was.
    assert seen.problem.system.loop.compiled.geom("ball").size[0] == pytest.approx(0.1)


@pytest.mark.slow
def test_what_mjx_simulated_is_recorded_in_mjx():
    row = {"size": 0.2, "wind": 3.0, "vx": 2.0}
    for precision in ("float32", "float64"):
        seen = replay(problem("mjx"), row, jax.random.key(0), 7, precision)
        motion = mujoco_motion.record(seen)
        np.testing.assert_allclose(motion.qpos[:, 0], np.asarray(seen.trace["x"]), rtol=1e-6)
        np.testing.assert_array_equal(motion.pushes[:, 1, 0], 3.0)


@pytest.mark.thorough
def test_the_picture_shows_the_ball_where_it_was(motion, gl):
    for sample, picture in zip(
        [0, 10], scene.frames(motion, [0, 10], SIZE, camera="side"), strict=True
    ):
        x, z = motion.qpos[sample, 0], 1.5 + motion.qpos[sample, 1]
        right, down, width = red(picture)
        assert right == pytest.approx(FOCAL * x / 4, abs=1.5)
        assert down == pytest.approx(FOCAL * (1 - z) / 4, abs=1.5)
        assert width == pytest.approx(FOCAL * 0.4 / 4, abs=2.5)
    (above,) = scene.frames(motion, [10], SIZE, camera="above")
    assert abs(red(above)[1]) < 1.5
    with pytest.raises(UnknownNameError, match="unknown camera 'sid'; did you mean 'side'"):
        scene.frames(motion, [0], SIZE, camera="sid")


@pytest.mark.thorough
def test_film_and_strip(motion, gl, tmp_path):
    with Image.open(scene.film(motion, tmp_path / "new" / "it.gif", SIZE)) as image:
        shown, edges = [], []
        for frame in ImageSequence.Iterator(image):
            shown.append(image.info["duration"])
            edges.append(np.asarray(frame.convert("RGB"), int)[60, 1])
    assert image.size == (SIZE[0], SIZE[1] + films.HEADER)
    # Real time, and the end stays.
    assert sum(shown) == 400 + 1500
    # The edge is red on the decisive frame, the last, alone.
    assert edges[-1][0] - edges[-1][1] > 90
    assert edges[-2][0] - edges[-2][1] < 30
    with Image.open(scene.strip(motion, tmp_path / "it.png", count=3, size=(100, 90))) as image:
        assert image.size == (3 * 100 + 2 * 4, 90 + films.HEADER)


@pytest.mark.thorough
def test_a_push_is_an_arrow(motion, gl):
    pushes = motion.pushes.copy()
    pushes[0, 1, 0] = 5.0
    plain, pushed = (
        scene.frames(replace(motion, pushes=p), [0], SIZE)[0] for p in (motion.pushes, pushes)
    )
    columns = np.nonzero(np.abs(pushed.astype(int) - plain).max(-1) > 40)[1]
    # It comes from the left and ends at the ball, which is in the middle.
    assert columns.size > 10
    assert columns.max() < SIZE[0] / 2


@pytest.mark.thorough
def test_a_wind_is_a_push(seen):
    row = {"size": 0.2, "wind": -4.0, "vx": 0.0}
    pushes = mujoco_motion.record(replay(seen.problem, row, jax.random.key(0), 0)).pushes
    np.testing.assert_array_equal(pushes[:, 1, 0], -4.0)
    assert np.count_nonzero(pushes) == len(pushes)


@pytest.mark.thorough
def test_a_run_ends_where_it_was_terminated():
    ending = problem(terminate=lambda state, features: state.qpos[1] < -0.1)
    short = replay(ending, {"size": 0.2, "wind": 0.0, "vx": 0.0}, jax.random.key(0), 0)
    motion = mujoco_motion.record(short)
    # Euler's step of 0.01 s has fallen 9.81e-4 k (k + 1) / 2 after k: more than 0.1 at k = 14.
    assert len(motion.qpos) == len(motion.clock) == 8
    assert motion.decisive is None
    assert motion.caption == "ball, row 0: ok"


@pytest.mark.slow
def test_pictures_of_a_replay(seen, gl, tmp_path, monkeypatch):
    monkeypatch.setattr(scene, "SIZE", SIZE)
    names = [path.name for path in write_replay_pictures(seen, tmp_path, "worst")]
    assert names == ["worst.png", "worst-strip.png", "worst.gif"]
    assert all((tmp_path / name).stat().st_size > 1000 for name in names)


@pytest.mark.thorough
def test_without_a_renderer_one_line_says_what_to_do(seen, tmp_path, monkeypatch, caplog):
    def nothing():
        raise ImportError("Cannot initialize a EGL device display.\nMore.")

    monkeypatch.setattr(scene, "_gl", nothing)
    with pytest.raises(scene.NoRenderer, match=r"MUJOCO_GL=egl.*libEGL.*MUJOCO_GL=osmesa"):
        animate(seen, tmp_path / "no.gif")
    with caplog.at_level(logging.WARNING):
        paths = write_replay_pictures(seen, tmp_path, "worst")
    assert [path.name for path in paths] == ["worst.png"]
    (message,) = caplog.messages
    assert "\n" not in message
    assert "Cannot initialize a EGL device display.; without a screen set" in message


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["disable", "glfw", "egl", None])
def test_real_settings_draw_or_explain(setting):
    code = f"""
import sys
try:
    import mujoco
except Exception:  # Its own import needs what the setting names.
    print("no MuJoCo")
    sys.exit()
from verifai_jax.addons.simulators.pictures import mujoco_scene as scene
try:
    with scene.canvas(mujoco.MjModel.from_xml_string({BALL!r}), (32, 32)):
        print("drew")
except scene.NoRenderer as error:
    print(error)
"""
    hidden = {"MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"}
    environment = {k: v for k, v in os.environ.items() if k not in hidden}
    if setting is not None:
        environment["MUJOCO_GL"] = setting
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=120
    )
    assert done.returncode == 0, done.stderr
    said = done.stdout.strip()
    if said == "no MuJoCo":
        pytest.skip(f"MuJoCo itself cannot be imported with MUJOCO_GL={setting} here")
    assert said == "drew" or ("MUJOCO_GL=egl" in said and "\n" not in said)
    if setting in ("disable", "glfw"):
        assert said != "drew"
