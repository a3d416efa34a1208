"""The pictures of a run in its folder: features.png, robustness.png, worst.png, worst.gif."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from verifai_jax.plotting.animation import animate
from verifai_jax.plotting.mujoco_scene import NoRenderer, can_draw, film, record, strip
from verifai_jax.plotting.replay import plot_replay
from verifai_jax.plotting.robustness_history import plot_budget
from verifai_jax.plotting.scatter import plot_features

if TYPE_CHECKING:
    from verifai_jax.evaluation.replay import Replay
    from verifai_jax.falsification.run import Run


def draw_run(run: "Run", folder: str | Path) -> list[Path]:
    """Draw all pictures of a run into `folder`; returns their paths.

    The worst simulation is drawn when the run has its problem and a row with a verdict.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "features.png", folder / "robustness.png"]
    plot_features(run, paths[0])
    plot_budget(run, paths[1])
    if run.problem is not None and len(run.table.failed) < run.simulations:
        paths += draw_replay(run.replay(run.best), folder, "worst")
    return paths


def draw_replay(replay: "Replay", folder: str | Path, name: str | None = None) -> list[Path]:
    """Draw one simulation into `folder`, animated too where its problem can; returns the paths.

    A MuJoCo model is also drawn as a strip of frames, `NAME-strip.png`. Where MuJoCo cannot draw,
    one line is logged that says what to do, and its pictures are left out.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    name = name or ("replay" if replay.row is None else f"row-{replay.row}")
    paths = [folder / f"{name}.png"]
    plot_replay(replay, paths[0])
    if replay.problem.draw is not None:
        paths.append(animate(replay, folder / f"{name}.gif"))
    elif can_draw(replay.problem.system):
        try:
            motion = record(replay)
            paths.append(strip(motion, folder / f"{name}-strip.png"))
            paths.append(film(motion, folder / f"{name}.gif"))
        except NoRenderer as error:
            logging.getLogger(__name__).warning("%s", error)
    return paths
