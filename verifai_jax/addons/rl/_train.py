"""Train a policy inside one compiled program.

    training = train(CartPoleTask(), PPO(hidden=(32, 32)), seed=0, steps=200_000)
    training.policy, training.mean_return

Hyper-parameters that change no shape re-use the program.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.addons.rl.algorithm import Algorithm
from verifai_jax.addons.rl.batched_training import BatchedTraining, Configuration
from verifai_jax.addons.rl.policy import Policy
from verifai_jax.addons.rl.ppo import PPO
from verifai_jax.addons.rl.task.task import Task
from verifai_jax.core.display.progress import say_done, shows_progress
from verifai_jax.core.user_code.callbacks import Callback, check_callbacks, notify


class Checkpoint(NamedTuple):
    """A policy during a training.

    - `steps`: environment steps taken so far.
    - `policy`: the policy learnt so far, without exploration.
    """

    steps: int
    policy: Policy


@dataclass(frozen=True, eq=False)
class Training:
    """The result of a training.

    - `policy`: the policy at the end, without exploration.
    - `steps`: `[updates]`, environment steps taken by the end of each update.
    - `mean_return`: `[updates]`, the mean return of the episodes that ended in each update, with
      exploration; NaN if none did.
    - `checkpoints`: the policies at the requested checkpoints.
    """

    policy: Policy
    steps: Int[np.ndarray, " updates"]
    mean_return: Float[np.ndarray, " updates"]
    checkpoints: tuple[Checkpoint, ...] = ()


@shows_progress("training", "steps")
def train(
    task: Task, algorithm: Algorithm | None = None, *, seed: int = 0, steps: int = 200_000,
    checkpoints: Sequence[int] = (), callbacks: Iterable[Callback] = (),
    progress: bool | None = None,
) -> Training:  # fmt: skip
    """Train a policy on a task.

    The same seed gives the same policy on the same machine. It compiles once for each task and
    shape; other hyper-parameters reuse the program.

    **Arguments:**
    - `task`: the task to learn; see `Task`.
    - `algorithm`: the algorithm with its hyper-parameters; `PPO()` when left out.
    - `seed`: the seed of all random numbers in the training.
    - `steps`: number of environment steps, rounded up to whole updates.
    - `checkpoints`: environment steps at which the policy is kept as well.
    - `callbacks`: functions called for each update, in groups every two seconds, with the
      environment steps so far and a dictionary of plain numbers: `update`, and `mean_return` if an
      episode ended in it.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Returns:** the policy with its learning curve.
    **Raises:** `ValueError` for invalid hyper-parameters, an algorithm that does not fit the task's
    actions, no steps, or checkpoints outside the training.
    """
    algorithm = PPO() if algorithm is None else algorithm
    called, reported = check_callbacks(callbacks), 0

    def watch(_: int, curve: Float[np.ndarray, " updates"]) -> None:
        nonlocal reported
        returned = f"mean return {curve[-1]:z.4g}" if len(curve) else ""
        say_done(len(curve) * algorithm.steps_per_update, steps, returned)
        for update in range(reported, len(curve)):
            values = {"update": update + 1, "mean_return": float(curve[update])}
            notify(called, (update + 1) * algorithm.steps_per_update, values)
        reported = len(curve)

    run = BatchedTraining([Configuration(task, algorithm, steps, seed)], watch=watch)
    reached, ordered = [], sorted(set(checkpoints))
    if outside := [at for at in ordered if not 1 <= at <= steps]:
        raise ValueError(f"checkpoints must lie between 1 and steps = {steps}; got {outside[0]}")
    for at in ordered:
        for number in run.advance({0: at}):
            reached.append(Checkpoint(int(run.curve(number)[0][-1]), run.policy(number)))
    for _ in run.advance({0: steps}):
        pass
    return Training(run.policy(0), *run.curve(0), tuple(reached))
