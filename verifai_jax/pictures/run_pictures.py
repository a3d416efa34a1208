"""The pictures of a run in its folder: features.png, robustness.png, worst.png, worst.gif."""

import logging
from pathlib import Path

from verifai_jax.core.messages.text import format_error
from verifai_jax.evaluation.replay import Replay
from verifai_jax.falsification.run import Run
from verifai_jax.pictures.animation import Animation, animate
from verifai_jax.pictures.film import NoRenderer
from verifai_jax.pictures.replay import plot_replay
from verifai_jax.pictures.robustness_history import plot_robustness_history
from verifai_jax.pictures.scatter import plot_features


def write_run_pictures(run: Run, folder: str | Path) -> list[Path]:
    """Write all pictures of a run into a folder.

    The worst simulation is drawn when the run has its problem and a row with a verdict.

    **Arguments:**
    - `folder`: the folder, made if missing.
    """
    folder = Path(folder)
    paths = [folder / "features.png", folder / "robustness.png"]
    plot_features(run, paths[0])
    plot_robustness_history(run, paths[1])
    if run.problem is not None and len(run.table.failed) < run.simulations:
        paths += write_replay_pictures(run.replay(run.best), folder, "worst")
    return paths


def write_replay_pictures(
    replay: Replay, folder: str | Path, name: str | None = None
) -> list[Path]:
    """Write the pictures of one simulation into a folder, and an animation if possible.

    A MuJoCo model is also drawn as a strip of frames, `NAME-strip.png`. If MuJoCo or a Gymnasium
    environment cannot draw, the reason is logged in one line, and the pictures are left out.

    **Arguments:**
    - `folder`: the folder, made if missing.
    - `name`: the name of the files without an ending; by default that of the row.
    """
    folder = Path(folder)
    name = name or ("replay" if replay.row is None else f"row-{replay.row}")
    paths = [folder / f"{name}.png"]
    plot_replay(replay, paths[0])
    if replay.problem.draw is not None:
        paths.append(animate(replay).save(folder / f"{name}.gif"))
    elif (filmed := replay.problem.system.filmed(replay)) is not None and filmed.draws:
        try:
            if (strip := filmed.strip(folder / f"{name}-strip.png")) is not None:
                paths.append(strip)
            paths.append(Animation(filmed.gif()).save(folder / f"{name}.gif"))
        except NoRenderer as error:
            logging.getLogger(__name__).warning("%s", error)
        except Exception as error:  # What draws there is not this package's.
            logging.getLogger(__name__).warning("no film: %s", format_error(error))
    return paths
