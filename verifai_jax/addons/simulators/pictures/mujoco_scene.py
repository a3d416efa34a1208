"""A simulation of a MuJoCo model as pictures, without a screen: a film and a strip of its frames.

    motion = record(replay)                        # the model of these features, and where it was
    film(motion, "worst.gif"); strip(motion, "worst-strip.png")

MuJoCo draws with OpenGL. Without a screen it uses EGL (from a GPU's driver, or Mesa) or OSMesa, as
chosen by the environment variable `MUJOCO_GL`; by default EGL.

The cameras of a model are made for its task, and may look at a wall. So each of them, and further
cameras made for the motion, draws a few small pictures; the film uses the camera that shows the
moving parts large and completely.
"""

import importlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from verifai_jax.addons.simulators.pictures.frames import (
    BACKGROUND,
    Frame,
    film_samples,
    gif,
    labelled,
)
from verifai_jax.addons.simulators.pictures.mujoco_motion import Motion
from verifai_jax.core.messages.errors import require, unknown_name
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.pictures.film import NoRenderer, check_film

FRAMES_PER_SECOND = 20
SIZE = (480, 320)
"""Width and height of a frame in pixels."""
AMBIENT = 0.35
"""Ambient light at least, from 0 to 1."""
ARROW = np.array([0.82, 0.2, 0.3, 1.0], np.float32)


def film(
    motion: Motion, path: str | Path, size: tuple[int, int] | None = None, *,
    camera: str | None = None, fps: float | None = None,
) -> Path:  # fmt: skip
    """Write an animated GIF, in real time unless there are too many frames.

    **Arguments:**
    - `size`: width and height in pixels; `SIZE` when left out.
    - `camera`: as in `frames`.
    - `fps`: frames per second; `FRAMES_PER_SECOND` when left out.
    **Raises:** `NoRenderer`; `UnknownNameError` for a camera that the model lacks.
    """
    check_film(size, fps)
    samples, shown = film_samples(motion.clock, fps, FRAMES_PER_SECOND)
    plain = frames(motion, samples.tolist(), size or SIZE, camera=camera)
    drawn = [
        _labelled(frame, motion, sample, motion.caption)
        for frame, sample in zip(plain, samples.tolist(), strict=True)
    ]
    path = Path(path)
    with replacing(path) as partial:
        partial.write_bytes(gif(drawn, shown))
    return path


def strip(
    motion: Motion, path: str | Path, count: int = 6, size: tuple[int, int] = (280, 300),
    camera: str | None = None,
) -> Path:  # fmt: skip
    """Write a PNG of `count` frames side by side, from the start to the end.

    For a failure the frames are concentrated around the deciding sample.

    **Arguments:**
    - `count`: number of frames.
    - `size`: width and height of each in pixels.
    - `camera`: as in `frames`.
    **Raises:** the errors of `film`.
    """
    from PIL import Image

    last = len(motion.clock) - 1
    spread = np.linspace(0.0, 1.0, count)
    if motion.decisive is not None:
        last = min(last, motion.decisive + max(1, last // 20))
        spread = 1.0 - (1.0 - spread) ** 1.6
    samples = np.unique(np.rint(spread * last).astype(int)).tolist()
    pieces = []
    for frame, sample in zip(frames(motion, samples, size, camera=camera), samples, strict=True):
        labelled = _labelled(frame, motion, sample, "" if pieces else motion.caption)
        pieces += [labelled, np.full((len(labelled), 4, 3), 255, np.uint8)]
    path = Path(path)
    with replacing(path) as partial:
        Image.fromarray(np.hstack(pieces[:-1])).save(partial)
    return path


def frames(
    motion: Motion, samples: Sequence[int], size: tuple[int, int] = SIZE, *,
    camera: str | None = None,
) -> list[Frame]:  # fmt: skip
    """Draw the motion at some samples.

    **Arguments:**
    - `samples`: their indices.
    - `size`: width and height in pixels.
    - `camera`: the name of one of the model's cameras; by default the one that shows the motion
      best (`mujoco_view.best_view`), among the model's and some made for this purpose.
    **Returns:** a picture `[height, width, 3]` of each.
    **Raises:** `NoRenderer`; `UnknownNameError`.
    """
    mujoco = require("mujoco", extra="mujoco")
    model, data = motion.model, mujoco.MjData(motion.model)
    option = mujoco.MjvOption()
    drawn = []
    with canvas(model, size) as draw:
        view = named_view(model, camera) if camera else best_view(motion, draw, size)
        for sample in samples:
            data.time = motion.clock[sample]
            data.qpos[:] = motion.qpos[sample]
            mujoco.mj_fwdPosition(model, data)
            drawn.append(draw(data, view, option, _arrows(motion, data, sample)))
    return drawn


@contextmanager
def canvas(model: Any, size: tuple[int, int]) -> Iterator[Any]:
    """Provide `draw(data, camera, option, arrows) -> pixels` for off-screen pictures of `size`.

    `arrows` are pairs of points, tail and tip. With `numbers=True` it returns, instead of colours,
    the index of the geom in each pixel `[height, width]`, -1 for none.

    The model's settings of light and buffers are raised as needed for such pictures.

    **Raises:** `NoRenderer` if there is no OpenGL.
    """
    mujoco = require("mujoco", extra="mujoco")
    width, height = size
    # The off-screen buffer is as large as the model says, or the window.
    buffer = model.vis.global_
    buffer.offwidth, buffer.offheight = max(buffer.offwidth, width), max(buffer.offheight, height)
    # A model that nobody has looked at yet has little light in it.
    model.vis.headlight.ambient[:] = np.maximum(model.vis.headlight.ambient, AMBIENT)
    context = None
    try:
        context = _gl()(width, height)
        context.make_current()
        pen = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # The loaders of EGL, OSMesa and GLX raise what they like.
        if context is not None:
            context.free()
        raise NoRenderer(explain_failure(error)) from error
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, pen)
        scene = mujoco.MjvScene(model, 2000 + 2 * model.ngeom)
        area = mujoco.MjrRect(0, 0, width, height)

        def draw(
            data: Any, camera: Any, option: Any, arrows: Any, numbers: bool = False
        ) -> Frame | Int[np.ndarray, "height width"]:
            everything = mujoco.mjtCatBit.mjCAT_ALL
            for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
                scene.flags[flag] = numbers
            mujoco.mjv_updateScene(model, data, option, None, camera, everything, scene)
            for tail, tip in arrows:
                geom = scene.geoms[scene.ngeom]
                kind = mujoco.mjtGeom.mjGEOM_ARROW
                mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), ARROW)
                # An arrow is drawn half as long as its geom says.
                thick = 0.05 * float(np.linalg.norm(tip - tail))
                mujoco.mjv_connector(geom, kind, thick, tail, 2 * tip - tail)
                scene.ngeom += 1
            mujoco.mjr_render(area, scene, pen)
            pixels = np.empty((height, width, 3), np.uint8)
            depth = np.empty((height, width), np.float32)
            mujoco.mjr_readPixels(pixels, depth, area, pen)
            if numbers:
                return _geoms(scene, pixels)[::-1]
            # Nothing lies at the far end of the depth buffer, 0 or 1.
            return np.where(((depth > 0) & (depth < 1))[..., None], pixels, BACKGROUND)[::-1]

        yield draw
    finally:
        pen.free()
        context.free()


def _geoms(scene: Any, pixels: Frame) -> Int[np.ndarray, "height width"]:
    """Return the geoms that pixels show whose colours are numbers of a scene."""
    mujoco = require("mujoco", extra="mujoco")
    shown = pixels.astype(np.int64) @ np.array([1, 1 << 8, 1 << 16])
    geom_of = np.full(scene.ngeom + 1, -1)
    for geom in scene.geoms[: scene.ngeom]:
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and 0 <= geom.segid < scene.ngeom:
            geom_of[geom.segid + 1] = geom.objid
    return geom_of[np.where(shown > scene.ngeom, 0, shown)]


def _arrows(motion: Motion, data: Any, sample: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return an arrow for each body that is pushed, its tip where the body begins.

    The greatest force of the motion is drawn a fifth of the model's extent long.
    """
    model, forces = motion.model, motion.pushes[..., :3]
    greatest = float(np.linalg.norm(forces, axis=-1).max(initial=0.0))
    arrows = []
    for body, force in enumerate(forces[sample]):
        strength = float(np.linalg.norm(force))
        if strength > 0.02 * greatest:
            direction = force / strength
            # The first size of most shapes is their radius or half their width.
            radius = model.geom_size[model.geom_bodyid == body, 0].max(initial=0.0)
            tip = data.xipos[body] - 1.2 * radius * direction
            longest = max(0.2 * model.stat.extent, 3.0 * radius)
            arrows.append((tip - longest * strength / greatest * direction, tip))
    return arrows


def _gl() -> Any:
    """Return the class of OpenGL contexts to draw with.

    MuJoCo chooses one when it is imported: for a screen, unless `MUJOCO_GL` names another. It is
    already imported here, so without a screen its EGL class is used directly.
    """
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL") and not screen:
        return importlib.import_module("mujoco.egl").GLContext
    found = getattr(importlib.import_module("mujoco.gl_context"), "GLContext", None)
    if found is None:
        raise RuntimeError("drawing is switched off")
    return found


def explain_failure(error: Exception) -> str:
    """Explain in one line why there is no picture, with a remedy."""
    said = (str(error).strip() or type(error).__name__).splitlines()[0]
    return (
        f"MuJoCo cannot draw here (MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}): {said}; without "
        "a screen set MUJOCO_GL=egl, which needs libEGL (apt install libegl1 libgl1-mesa-dri, or "
        "a GPU's driver), or MUJOCO_GL=osmesa (apt install libosmesa6)"
    )


def _labelled(
    image: Frame, motion: Motion, sample: int, caption: str
) -> UInt8[np.ndarray, "taller width 3"]:
    """Write caption and time above a frame; a red edge from the decisive sample on."""
    failed = motion.decisive is not None and sample >= motion.decisive
    return labelled(image, caption, float(motion.clock[sample]), failed)


TRIED = 4
"""Instants at which a camera is tried."""
LARGE = 0.1
"""Share of a picture that what moves need not exceed: a camera that is nearer sees no more."""
OWN = 1.9
"""How much better a model's own camera counts than one that is made for the motion."""
FAR = 4.0
"""Sizes of what moves that it goes at least, for a camera to be carried along."""
ANGLES = ((90.0, -15.0), (135.0, -25.0), (45.0, -25.0), (180.0, -15.0), (0.0, -15.0), (90.0, -55.0))
"""Azimuth and elevation in degrees of the cameras that are made."""


def named_view(model: Any, name: str) -> Any:
    """Return a camera of the model by its name.

    **Raises:** `UnknownNameError`.
    """
    known = [model.camera(i).name for i in range(model.ncam)]
    if name not in known:
        raise unknown_name("camera", name, known)
    return _fixed(known.index(name))


def best_view(motion: Motion, draw: Callable[..., Any], size: tuple[int, int]) -> Any:
    """Return the camera that shows the motion best.

    **Arguments:**
    - `draw`: the function from `mujoco_scene.canvas` for pictures of this `size`.
    """
    mujoco = require("mujoco", extra="mujoco")
    model, data = motion.model, mujoco.MjData(motion.model)
    samples = np.unique(np.linspace(0, len(motion.clock) - 1, TRIED).round().astype(int))
    positions = []
    for sample in samples:
        data.qpos[:] = motion.qpos[sample]
        mujoco.mj_fwdPosition(model, data)
        positions.append((data.geom_xpos.copy(), data.geom_xmat.copy()))
    moving = _moving(model, positions)
    own = [_fixed(number) for number in range(model.ncam)]
    made = _made(model, moving, [position for position, _ in positions])
    option = mujoco.MjvOption()
    scores = []
    for view in [*own, *made]:
        seen = []
        for sample in samples:
            data.qpos[:] = motion.qpos[sample]
            mujoco.mj_fwdPosition(model, data)
            seen.append(draw(data, view, option, (), numbers=True))
        scores.append(_score(np.stack(seen), moving) * (OWN if len(scores) < len(own) else 1.0))
    return [*own, *made][int(np.argmax(scores))]


def _fixed(number: int) -> Any:
    mujoco = require("mujoco", extra="mujoco")
    view = mujoco.MjvCamera()
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, number
    return view


def _moving(
    model: Any, positions: list[tuple[np.ndarray, np.ndarray]]
) -> Bool[np.ndarray, " geoms"]:
    """Return which geoms move; all that belong to a body with joints where nothing does."""
    drawn = (model.geom_group < 3) & (model.geom_rgba[:, 3] > 0)
    (first, turned), *others = positions
    far = np.zeros(model.ngeom)
    for position, rotation in others:
        shift = np.linalg.norm(position - first, axis=1)
        turn = np.linalg.norm(rotation - turned, axis=1) * model.geom_rbound
        far = np.maximum(far, np.maximum(shift, turn))
    # Parts that only shake a little are not of interest.
    moving = drawn & (far > max(0.02 * far[drawn].max(initial=0.0), 1e-6))
    if not moving.any():
        moving = drawn & (model.body_weldid[model.geom_bodyid] > 0)
    return moving if moving.any() else drawn


def _made(
    model: Any, moving: Bool[np.ndarray, " geoms"], positions: list[Float[np.ndarray, "geoms 3"]]
) -> list[Any]:
    """Return cameras around what moves: still, or carried along where it goes far."""
    mujoco = require("mujoco", extra="mujoco")
    radius = model.geom_rbound[moving][:, None]
    ends = [np.array([(p[moving] - radius).min(0), (p[moving] + radius).max(0)]) for p in positions]
    whole = np.array([np.min([e[0] for e in ends], 0), np.max([e[1] for e in ends], 0)])
    once = max(float(np.linalg.norm(e[1] - e[0])) for e in ends)
    far = float(np.linalg.norm(whole[1] - whole[0]))
    bodies = np.unique(model.geom_bodyid[moving])
    heaviest = int(bodies[np.argmax(model.body_subtreemass[bodies])])
    views = []
    for carried in (False, True)[: 1 + (far > FAR * once)]:
        # One that is carried along shows some of what is around, too.
        reach = once if carried else 0.5 * far
        for azimuth, elevation in ANGLES:
            view = mujoco.MjvCamera()
            mujoco.mjv_defaultFreeCamera(model, view)
            view.azimuth, view.elevation = azimuth, elevation
            view.distance = 1.1 * reach / np.sin(np.radians(model.vis.global_.fovy) / 2)
            view.lookat[:] = whole.mean(axis=0)
            if carried:
                view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, heaviest
            views.append(view)
    return views


def _score(
    seen: Int[np.ndarray, "samples height width"], moving: Bool[np.ndarray, " geoms"]
) -> float:
    """Return how well pictures show what moves: how large, how much of it, and how whole it is."""
    shown = np.where(seen < 0, False, moving[np.maximum(seen, 0)])
    share = shown.mean(axis=(1, 2))
    parts = [len(np.unique(s[m])) / max(1, moving.sum()) for s, m in zip(seen, shown, strict=True)]
    edge = np.concatenate(
        [shown[:, 0], shown[:, -1], shown[:, :, 0], shown[:, :, -1]], axis=1
    ).mean(axis=1)
    whole = np.sqrt(parts) * np.maximum(0.05, 1 - 4 * edge)
    # By the width rather than the area; at the worst instant, so that nothing leaves the picture.
    return float(np.min(np.cbrt(np.minimum(share, LARGE)) * whole))
