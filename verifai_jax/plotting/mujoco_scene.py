"""A simulation of a MuJoCo model as pictures, without a screen: a film and a strip of its frames.

    motion = record(replay)                        # the model of these features, and where it was
    film(motion, "worst.gif"); strip(motion, "worst-strip.png")

MuJoCo draws with OpenGL. Without a screen that is EGL (a GPU's driver, or Mesa's) or OSMesa, named
by the environment variable `MUJOCO_GL`. Where nothing is named and there is no display, EGL is
used.
"""

import copy
import importlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, UInt8

from verifai_jax.core.errors import require, unknown_name
from verifai_jax.core.programs import Slot
from verifai_jax.core.waveform import set_durations
from verifai_jax.evaluation.replay import Replay
from verifai_jax.plotting.replay import decisive_instant
from verifai_jax.systems.mujoco.system import MuJoCo

Frame = UInt8[np.ndarray, "height width 3"]

FRAMES_PER_SECOND = 20
MOST_FRAMES = 120
"""Frames at most; a longer motion is played faster."""
SIZE = (480, 320)
"""Width and height of a frame in pixels."""
COLORS = 128
"""Colours of a GIF."""
AMBIENT = 0.35
"""Ambient light at least, from 0 to 1."""
HEADER = 24
"""Pixels above a frame for its caption."""
BACKGROUND = np.array([232, 237, 242], np.uint8)
"""Colour where a model has no sky."""
ARROW = np.array([0.82, 0.2, 0.3, 1.0], np.float32)


class NoRenderer(RuntimeError):
    """There is no OpenGL to draw with; one line that says what to install or set."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A model, and where it was at each sample that counts.

    - `model`: a `mujoco.MjModel` of its own, with the features in place.
    - `clock`: seconds of each sample.
    - `pushes`: forces and torques on the bodies, from outside.
    - `caption`: what is written above the frames.
    - `decisive`: the sample that decided a failure, None for a simulation that kept its spec.
    """

    model: Any
    clock: Float[np.ndarray, " samples"]
    qpos: Float[np.ndarray, "samples nq"]
    pushes: Float[np.ndarray, "samples nbody 6"]
    caption: str = ""
    decisive: int | None = None


def can_draw(system: object) -> bool:
    """Return whether a system is a MuJoCo model, which can be drawn by itself."""
    return isinstance(system, MuJoCo)


def record(replay: Replay) -> Motion:
    """Simulate a replay once more, on the same engine, and keep the positions.

    **Raises:** `ValueError` for a system that is no MuJoCo model.
    """
    system: Any = replay.problem.system
    if not can_draw(system):
        raise ValueError(f"the system of problem {replay.problem.name!r} is no MuJoCo model")
    features, loop = set_durations(replay.features, system.duration), system.loop
    # Kept with the problem, as they are compiled once.
    simulate, placed = replay.problem.programs.get(RECORDERS, None, lambda: _recorder(system))
    clock = np.asarray(replay.trace.clock(), np.float64)
    samples = len(clock)
    precise = any(np.asarray(v).dtype == np.float64 for v in replay.trace.signals.values())
    with jax.enable_x64(precise):
        trace = simulate(features, getattr(replay, "key", None))
        qpos = np.asarray(trace["qpos"], np.float64)[:samples]
        times = loop.control_period * np.arange(loop.periods + 1)
        leaves, acting = placed(features, times)
    model = copy.copy(loop.compiled)
    for name, value in leaves.items():
        owner, field = (model.opt, name[4:]) if name.startswith("opt.") else (model, name)
        array = getattr(owner, field)
        array[...] = np.asarray(value).reshape(array.shape)
    pushes = np.zeros((samples, model.nbody, 6))
    if "xfrc_applied" in acting:
        pushes[...] = acting["xfrc_applied"][:samples]
    decided = None
    if replay.violated:
        formula = replay.problem.formulas[replay.worst]
        decided = decisive_instant(formula, replay.trace, replay.problem.end)
    row = "" if replay.row is None else f", row {replay.row}"
    verdict = "violated" if replay.violated else replay.status.name.lower()
    return Motion(
        model,
        clock,
        qpos,
        pushes,
        f"{replay.problem.name}{row}: {verdict}",
        None if decided is None else decided[1],
    )


RECORDERS: Slot[None, tuple[Callable[..., Any], Callable[..., Any]]] = Slot("recorders")
"""Compiled functions that simulate one replay of a problem with its positions."""


def _recorder(system: Any) -> tuple[Any, Any]:
    """Return the system with its positions as the only signal, and what features set, compiled."""
    loop = system.loop

    def positions(time: Any, state: Any, control: Any, features: Any) -> dict[str, Any]:
        return {"qpos": state.qpos}

    def placed(features: Any, times: Any) -> tuple[Any, Any]:
        acting = jax.vmap(lambda time: loop.bindings.applied_at(features, time))(times)
        return loop.bindings.leaves(features), acting

    recorder = replace(system, loop=replace(loop, signals=positions))
    return recorder if recorder.black_box else jax.jit(recorder), jax.jit(placed)


def film(
    motion: Motion, path: str | Path, size: tuple[int, int] = SIZE, **camera: str | None
) -> Path:
    """Write an animated GIF, in real time where it fits into `MOST_FRAMES` frames.

    **Arguments:**

    - `motion`: what `record` returned.
    - `path`: of the file; folders are made.
    - `size`: width and height in pixels.
    - `camera`: as for `frames`.

    **Returns:** the path.

    **Raises:** `NoRenderer`; `UnknownNameError` for a camera that the model lacks.
    """
    from PIL import Image

    seconds = float(motion.clock[-1] - motion.clock[0])
    count = max(2, min(MOST_FRAMES, round(seconds * FRAMES_PER_SECOND) + 1))
    instants = np.linspace(motion.clock[0], motion.clock[-1], count)
    samples = np.searchsorted(motion.clock, instants - 1e-9).clip(max=len(motion.clock) - 1)
    plain = frames(motion, samples.tolist(), size, **camera)
    drawn = [
        _labelled(frame, motion, sample, motion.caption)
        for frame, sample in zip(plain, samples.tolist(), strict=True)
    ]
    # One palette for all and no dithering, so that what does not move keeps its colour and the file
    # stays small. Half of it is for the colours that there are, however few their pixels, or floor
    # and sky would take them all.
    some = np.concatenate([drawn[i].reshape(-1, 3) for i in (0, count // 2, count - 1)])
    different = np.unique(some & 0xF8, axis=0) + 4
    share = some[:: max(1, len(some) // len(different))]
    both = np.concatenate([different.astype(np.uint8), share])
    palette = Image.fromarray(both[None]).quantize(COLORS)
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in drawn
    ]
    shown = [max(20, round(1000 * seconds / (count - 1) / 10) * 10)] * (count - 1) + [1500]
    path = _folder_of(path)
    images[0].save(path, save_all=True, append_images=images[1:], duration=shown, loop=0)
    return path


def strip(
    motion: Motion,
    path: str | Path,
    count: int = 6,
    size: tuple[int, int] = (280, 300),
    **camera: str | None,
) -> Path:
    """Write a PNG of `count` instants side by side, from the start to the end.

    Those of a failure close in on the sample that decided it.

    **Arguments:**

    - `motion`: what `record` returned.
    - `path`: of the file; folders are made.
    - `count`: instants.
    - `size`: width and height of each in pixels.
    - `camera`: as for `frames`.

    **Returns:** the path.

    **Raises:** as `film`.
    """
    from PIL import Image

    last = len(motion.clock) - 1
    spread = np.linspace(0.0, 1.0, count)
    if motion.decisive is not None:
        last = min(last, motion.decisive + max(1, last // 20))
        spread = 1.0 - (1.0 - spread) ** 1.6
    samples = np.unique(np.rint(spread * last).astype(int)).tolist()
    pieces = []
    for frame, sample in zip(frames(motion, samples, size, **camera), samples, strict=True):
        labelled = _labelled(frame, motion, sample, "" if pieces else motion.caption)
        pieces += [labelled, np.full((len(labelled), 4, 3), 255, np.uint8)]
    path = _folder_of(path)
    Image.fromarray(np.hstack(pieces[:-1])).save(path)
    return path


def frames(
    motion: Motion,
    samples: Sequence[int],
    size: tuple[int, int] = SIZE,
    *,
    camera: str | None = None,
) -> list[Frame]:
    """Draw the motion at some samples.

    **Arguments:**

    - `motion`: what `record` returned.
    - `samples`: their numbers.
    - `size`: width and height in pixels.
    - `camera`: the name of one of the model's; its first one when left out, or, in a model that
      has none, one that follows its heaviest moving body from the side.

    **Returns:** a picture `[height, width, 3]` of each.

    **Raises:** `NoRenderer`; `UnknownNameError`.
    """
    mujoco = require("mujoco", extra="mujoco")
    model, data = motion.model, mujoco.MjData(motion.model)
    view = _view(mujoco, model, camera)
    option = mujoco.MjvOption()
    drawn = []
    with canvas(model, size) as draw:
        for sample in samples:
            data.time = motion.clock[sample]
            data.qpos[:] = motion.qpos[sample]
            mujoco.mj_fwdPosition(model, data)
            drawn.append(draw(data, view, option, _arrows(motion, data, sample)))
    return drawn


@contextmanager
def canvas(model: Any, size: tuple[int, int]) -> Iterator[Any]:
    """Give `draw(data, camera, option, arrows) -> pixels` for pictures of `size`, off the screen.

    `arrows` are pairs of points, tail and tip.

    The model's settings of light and buffers are raised to what such pictures need.

    **Raises:** `NoRenderer` where no OpenGL answers.
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

        def draw(data: Any, camera: Any, option: Any, arrows: Any) -> Frame:
            everything = mujoco.mjtCatBit.mjCAT_ALL
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
            # Nothing lies at the far end of the depth buffer, 0 or 1.
            return np.where(((depth > 0) & (depth < 1))[..., None], pixels, BACKGROUND)[::-1]

        yield draw
    finally:
        pen.free()
        context.free()


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
            way = force / strength
            # The first size of most shapes is their radius or half their width.
            radius = model.geom_size[model.geom_bodyid == body, 0].max(initial=0.0)
            tip = data.xipos[body] - 1.2 * radius * way
            longest = max(0.2 * model.stat.extent, 3.0 * radius)
            arrows.append((tip - longest * strength / greatest * way, tip))
    return arrows


def _gl() -> Any:
    """Return the class of OpenGL contexts to draw with.

    MuJoCo chooses one when it is imported, for a screen unless `MUJOCO_GL` says otherwise. By now
    it is imported, so where there is no screen its EGL is taken directly.
    """
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL") and not screen:
        return importlib.import_module("mujoco.egl").GLContext
    found = getattr(importlib.import_module("mujoco.gl_context"), "GLContext", None)
    if found is None:
        raise RuntimeError("drawing is switched off")
    return found


def explain_failure(error: Exception) -> str:
    """Explain in one line why there is no picture, and what to do about it."""
    said = (str(error).strip() or type(error).__name__).splitlines()[0]
    return (
        f"MuJoCo cannot draw here (MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}): {said}; without "
        "a screen set MUJOCO_GL=egl, which needs libEGL (apt install libegl1 libgl1-mesa-dri, or "
        "a GPU's driver), or MUJOCO_GL=osmesa (apt install libosmesa6)"
    )


def _view(mujoco: Any, model: Any, name: str | None) -> Any:
    known = [model.camera(i).name for i in range(model.ncam)]
    view = mujoco.MjvCamera()
    if name is not None and name not in known:
        raise unknown_name("camera", name, known)
    if model.ncam:
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        view.fixedcamid = 0 if name is None else known.index(name)
        return view
    mujoco.mjv_defaultFreeCamera(model, view)
    moving = np.flatnonzero(model.body_dofnum)
    view.azimuth, view.elevation = 100.0, -12.0
    if moving.size:
        view.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        view.trackbodyid = int(moving[np.argmax(model.body_mass[moving])])
        view.distance = 1.6 * model.stat.extent
    return view


def _labelled(
    image: Frame, motion: Motion, sample: int, caption: str
) -> UInt8[np.ndarray, "taller width 3"]:
    """Write caption and time above a frame; a red edge from the decisive sample on."""
    from PIL import Image, ImageDraw, ImageFont

    header = np.full((HEADER, *image.shape[1:]), BACKGROUND, np.uint8)
    picture = Image.fromarray(np.concatenate([header, image]))
    pen = ImageDraw.Draw(picture)
    width, height = picture.size
    font = ImageFont.load_default(size=13)
    failed = motion.decisive is not None and sample >= motion.decisive
    ink = (190, 45, 65) if failed else (48, 50, 61)
    pen.text((10, 5), caption, fill=ink, font=font)
    pen.text((width - 10, 5), f"{motion.clock[sample]:z.2f} s", fill=ink, font=font, anchor="ra")
    if failed:
        pen.rectangle((0, 0, width - 1, height - 1), outline=ink, width=3)
    return np.asarray(picture)


def _folder_of(path: str | Path) -> Path:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
