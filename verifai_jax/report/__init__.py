"""Pictures of runs and of single simulations; matplotlib is imported when one is drawn."""

from verifai_jax.report.animation import animate as animate
from verifai_jax.report.budget import plot_budget as plot_budget
from verifai_jax.report.files import draw_replay as draw_replay
from verifai_jax.report.files import draw_run as draw_run
from verifai_jax.report.scatter import plot_features as plot_features
from verifai_jax.report.worst import plot_replay as plot_replay
