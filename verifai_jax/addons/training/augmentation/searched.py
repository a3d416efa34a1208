"""The problem that a search for errors of a network works on.

searched_problem(task, weights, search, workshop)       # its robustness is minus the wrongness
"""

import numpy as np
import pandas as pd
from jaxtyping import Array, Key

from verifai_jax.addons.training.augmentation.examples import Workshop
from verifai_jax.addons.training.augmentation.task import MARGIN, Features, SupervisedTask, Weights
from verifai_jax.core.values.trace import Trace
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.systems.base import System


def searched_problem(
    task: SupervisedTask, weights: Weights | None, search: Search, workshop: Workshop | None
) -> Problem:
    """Return the problem in which a search looks for inputs on which a network errs.

    Without gradients one program serves the networks of all seeds, with their weights as arguments;
    with gradients each network has its own program.
    """
    if workshop is None or (search.wants.derivatives and not task.black_box):
        return task.problem(weights)
    return Problem(task.name, task.space, _Judged(workshop, weights), f"{MARGIN} >= 0")


class _Judged(System):
    """A network as a system of batches, judged by compiled functions that all networks share."""

    black_box = True

    def __init__(self, workshop: Workshop, weights: Weights) -> None:
        self.workshop, self.weights = workshop, weights

    def simulate_batch(self, features: Features, keys: Key[Array, " n"]) -> Trace:
        rows = pd.DataFrame(self.workshop.task.space.rows(features))
        wrongness = self.workshop.judge(self.weights, self.workshop.render(rows)).wrongness
        return Trace({MARGIN: -np.asarray(wrongness, np.float32)[:, None]}, dt=1.0)
