"""Tasks that policies are trained on: their contract, and the environments that keep it."""

from verifai_jax.rl.task.task import Action as Action
from verifai_jax.rl.task.task import Continuous as Continuous
from verifai_jax.rl.task.task import Discrete as Discrete
from verifai_jax.rl.task.task import Task as Task
