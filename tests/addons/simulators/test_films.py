"""Films: their size and speed, the camera that sees what moves, Gymnasium's and Brax's pictures."""

import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image, ImageSequence

import verifai_jax as vj
from verifai_jax.addons.simulators.pictures.frames import HEADER, film_samples, labelled
from verifai_jax.addons.simulators.pictures.mujoco_motion import record
from verifai_jax.addons.simulators.pictures.mujoco_scene import (
    NoRenderer,
    best_view,
    canvas,
    frames,
)
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.evaluation.replay import replay

# A red ball that rolls along x, far from the cameras of the model: one looks at a wall, one away.
HIDDEN = """
<mujoco><option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <camera name="wall" pos="0 -9 1" xyaxes="1 0 0 0 0 1" fovy="45"/>
    <camera name="away" pos="0 9 1" xyaxes="1 0 0 0 0 1" fovy="45"/>
    {more}
    <geom type="box" pos="0 -6 1" size="9 0.1 9" rgba="0 1 0 1"/>
    <geom type="plane" size="40 40 0.1" pos="0 0 -0.5"/>
    <body name="ball"><joint name="x" type="slide" axis="1 0 0"/>
      <geom size="0.1" rgba="1 0 0 1" mass="1"/></body>
  </worldbody>
</mujoco>
"""


def rolling(more="", speed=2.0):
    system = vj.mujoco(
        HIDDEN.format(more=more), duration=1.0, control_period=0.05, backend="native",
        bind={"v": "joint/x/qvel"}, signals={"x": "joint/x/qpos"},
    )  # fmt: skip
    problem = vj.Problem("ball", {"v": vj.Box(0, 100)}, system, "always x < 99")
    return record(replay(problem, {"v": speed}, jax.random.key(0), 0))


@pytest.fixture(scope="module")
def gl():
    try:
        with canvas(rolling().model, (32, 32)):
            pass
    except NoRenderer as error:
        pytest.skip(str(error))


def share_of_red(picture):
    picture = np.asarray(picture, int)
    return float(((picture[..., 0] > 90) & (picture[..., 1:].max(-1) < 70)).mean())


@pytest.mark.slow
@pytest.mark.parametrize("speed", [2.0, 60.0], ids=["near", "far"])
def test_a_film_sees_what_moves(gl, speed):
    motion = rolling(speed=speed)
    for sample in (0, len(motion.clock) // 2, len(motion.clock) - 1):
        (picture,) = frames(motion, [sample], (240, 160))
        assert share_of_red(picture) > (0.001 if speed < 9 else 0.01)
    # A camera by its name is taken as it is.
    (wall,) = frames(motion, [0], (240, 160), camera="wall")
    assert share_of_red(wall) == 0


@pytest.mark.slow
def test_a_models_own_camera_is_taken_where_it_sees_the_motion(gl):
    side = '<camera name="side" pos="0.5 -2 0.2" xyaxes="1 0 0 0 0 1" fovy="60"/>'
    motion = rolling(side, speed=1.0)
    with canvas(motion.model, (120, 80)) as draw:
        view = best_view(motion, draw, (120, 80))
    assert motion.model.camera(view.fixedcamid).name == "side"


def system(features, key):
    return vj.Trace({"x": features["a"] * jnp.arange(41) / 40}, dt=0.1)


def draw(axes, trace, sample, features):
    axes.plot([0, 1], [0, float(trace["x"][sample])])
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)


@pytest.fixture(scope="module")
def drawn():
    problem = vj.Problem("drawn", {"a": vj.Box(0, 1)}, system, "always x < 2", draw=draw)
    return replay(problem, {"a": 0.5}, jax.random.key(0), 0)


def gif(animation):
    with Image.open(io.BytesIO(animation.gif)) as image:
        shown = [image.info["duration"] for _ in ImageSequence.Iterator(image)]
        return image.size, shown


@pytest.mark.thorough
def test_size_and_frames_a_second(drawn):
    size, shown = gif(drawn.animate(size=(200, 120), fps=5))
    assert size == (200, 120)
    assert len(shown) == 20
    assert set(shown[:-1]) == {200}
    for options, message in (
        ({"size": (200,)}, "size is a width and a height in pixels"),
        ({"size": (0, 9)}, "the width of size"),
        ({"fps": 0}, "fps is a number of frames a second, from 0 to 100; got 0"),
        ({"camera": "side"}, "camera names a camera of a MuJoCo model, .* problem 'drawn'"),
    ):
        with pytest.raises(ValueError, match=message):
            drawn.animate(**options)


def test_a_long_film_is_played_faster_unless_somebody_says_how_fast():
    clock = np.linspace(0, 100, 2001)
    samples, shown = film_samples(clock, None, 20)
    assert len(samples) == 150
    assert shown == 670
    samples, shown = film_samples(clock, 5, 20)
    assert len(samples) == 501
    assert shown == 200


def test_a_caption_never_lies_on_the_time():
    plain = np.zeros((20, 120, 3), np.uint8)
    picture = labelled(plain, "a very long name of a problem, row 123456: violated", 12.34, True)
    assert picture.shape == (20 + HEADER, 120, 3)
    # Between the two there is a gap without ink, which is dark red on the light header.
    ink = (np.abs(picture[4 : HEADER - 2, 4:-4].astype(int) - [190, 45, 65]).sum(-1) < 60).any(0)
    columns = np.flatnonzero(ink)
    assert np.diff(columns).max() >= 6
    assert columns.max() < 112


class Square:
    """A square that goes to the right, drawn by itself as environments of Gymnasium are."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    render_mode = None

    def __init__(self):
        import gymnasium

        self.action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-99, 99, (1,), np.float32)
        self.unwrapped, self.speed = self, 1.0

    def reset(self, seed=None):
        self.x = 0.0
        return np.array([self.x], np.float32), {}

    def step(self, action):
        self.x += self.speed
        return np.array([self.x], np.float32), 0.0, self.x > 30, False, {}

    def render(self):
        assert self.render_mode == "rgb_array"
        picture = np.full((40, 60, 3), 255, np.uint8)
        picture[10:20, int(self.x) : int(self.x) + 10] = (200, 0, 0)
        return picture


def still(observation):
    return np.zeros(1, np.float32)


def square(make=Square):
    system = vj.gymnasium(make, still, steps=20, dt=0.1, features=["speed"])
    space = {"speed": vj.Box(0, 3)}
    return vj.Problem("square", space, system, "always observation < 15")


def red_centre(frame):
    picture = np.asarray(frame.convert("RGB"), int)[HEADER:]
    red = (picture[..., 0] > 150) & (picture[..., 1:].max(-1) < 90)
    return np.nonzero(red[5:25, 4:-4])[1].mean() + 4


@pytest.mark.thorough
def test_an_environment_of_gymnasium_draws_its_episode(tmp_path):
    pytest.importorskip("gymnasium")
    run = vj.falsify(square(), "uniform", 4, batch=4, progress=False, confirm=False)
    # Over after 11 steps, at 33.
    animation = replay(square(), {"speed": 3.0}, jax.random.key(0), 0).animate()
    with Image.open(io.BytesIO(animation.gif)) as image:
        centres = [red_centre(frame) for frame in ImageSequence.Iterator(image)]
        assert image.size == (60, 40 + HEADER)
    assert centres[0] == pytest.approx(5, abs=1.5)
    assert centres[-1] == pytest.approx(38, abs=1.5)
    assert gif(run.replay(0).animate(size=(30, 20)))[0] == (30, 20 + HEADER)
    with pytest.raises(ValueError, match="camera names a camera of a MuJoCo model"):
        run.replay(0).animate(camera="side")


@pytest.mark.thorough
def test_an_environment_that_draws_nothing_says_so():
    pytest.importorskip("gymnasium")

    class Blind(Square):
        metadata = {}  # noqa: RUF012

    seen = replay(square(Blind), {"speed": 3.0}, jax.random.key(0), 0)
    with pytest.raises(ValueError, match="Blind draws no pictures: its metadata have no render"):
        seen.animate()


@pytest.mark.slow
def test_a_brax_environment_is_drawn_by_mujoco(gl):
    pytest.importorskip("brax")

    def nothing(observation):
        return jnp.zeros(1)

    system = vj.brax(
        "inverted_pendulum", nothing, steps=10, backend="generalized", initial={"angle": "q[1]"}
    )
    problem = vj.Problem("pole", {"angle": vj.Box(-0.1, 0.1)}, system, "always reward > -99")
    seen = replay(problem, {"angle": 0.1}, jax.random.key(0), 0)
    motion = record(seen)
    assert motion.qpos.shape == (seen.trace.length, 2)
    assert motion.qpos[0, 1] == pytest.approx(0.1)
    np.testing.assert_allclose(motion.qpos, np.asarray(seen.trace["q"]), rtol=1e-6)
    assert gif(seen.animate(size=(80, 60)))[0] == (80, 60 + HEADER)
    with pytest.raises(UnknownNameError, match="unknown camera 'sid'"):
        seen.animate(camera="sid")
