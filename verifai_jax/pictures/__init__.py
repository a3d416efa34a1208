"""Pictures of runs and of single simulations; matplotlib is imported when one is drawn.

A function `plot_...` draws its first argument, writes the picture to `path`, if that is given, and
returns the figure.
"""

from verifai_jax.pictures.animation import animate as animate
from verifai_jax.pictures.replay import plot_replay as plot_replay
from verifai_jax.pictures.robustness_history import (
    plot_robustness_history as plot_robustness_history,
)
from verifai_jax.pictures.run_pictures import write_replay_pictures as write_replay_pictures
from verifai_jax.pictures.run_pictures import write_run_pictures as write_run_pictures
from verifai_jax.pictures.scatter import plot_features as plot_features
