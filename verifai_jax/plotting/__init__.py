"""Pictures of runs and of single simulations; matplotlib is imported when one is drawn."""

from verifai_jax.plotting.animation import animate as animate
from verifai_jax.plotting.replay import plot_replay as plot_replay
from verifai_jax.plotting.robustness_history import plot_budget as plot_budget
from verifai_jax.plotting.run_pictures import draw_replay as draw_replay
from verifai_jax.plotting.run_pictures import draw_run as draw_run
from verifai_jax.plotting.scatter import plot_features as plot_features
