"""Where a film of a MuJoCo model is seen from: the camera that shows best what moves.

A model's own cameras are made for a task, and may look at a wall. Each is tried on a few small
pictures, and from cameras that are made for the motion. The camera that shows the moving parts
large and completely is taken.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.core.errors import require, unknown_name
from verifai_jax.plotting.mujoco_motion import Motion

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
    """Return the camera that sees best what moves.

    **Arguments:**

    - `motion`: the motion of the model.
    - `draw`: what `mujoco_scene.canvas` gives, for pictures of this `size`.
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
