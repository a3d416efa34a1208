"""Tasks that policies are trained on: the contract, and environments of other libraries."""

from verifai_jax.addons.rl.task.task import Action as Action
from verifai_jax.addons.rl.task.task import Continuous as Continuous
from verifai_jax.addons.rl.task.task import Discrete as Discrete
from verifai_jax.addons.rl.task.task import State as State
from verifai_jax.addons.rl.task.task import Task as Task
