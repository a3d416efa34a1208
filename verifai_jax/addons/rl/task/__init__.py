"""Tasks that policies are trained on: the contract, and environments of other libraries."""

from verifai_jax.addons.rl.task.task import State as State
from verifai_jax.addons.rl.task.task import Task as Task
from verifai_jax.systems.actions import Action as Action
from verifai_jax.systems.actions import Continuous as Continuous
from verifai_jax.systems.actions import Discrete as Discrete
