"""Counterexample-guided data augmentation: measures the gain of training on a network's errors.

    result = augment(task, initial=1000, added=200, seeds=5)
    print(result)                           # each arm against none, and against random inputs

For each seed a base network is trained on an initial set, and a search fills its error table. Each
arm trains the base further on the initial set and its added inputs. All arms of a seed share data,
weights, keys and tests, so that their differences are paired.

Sources: Dreossi, Ghosh, Yue, Keutzer, Sangiovanni-Vincentelli and Seshia, Counterexample-guided
data augmentation, IJCAI 2018; Dreossi et al., VerifAI: a toolkit for the formal design and analysis
of artificial intelligence-based systems, CAV 2019.
"""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from verifai_jax._version import __version__
from verifai_jax.addons.training.augmentation.arms import ARMS, check_arms
from verifai_jax.addons.training.augmentation.examples import searched_problem
from verifai_jax.addons.training.augmentation.result import Augmentation
from verifai_jax.addons.training.augmentation.study import Plan, Study
from verifai_jax.addons.training.augmentation.task import SupervisedTask
from verifai_jax.addons.training.sweeps.fingerprint import describe_space
from verifai_jax.core.compute.fingerprint import stable_text
from verifai_jax.core.compute.precision import reproducible_settings
from verifai_jax.core.display.progress import ProgressBar
from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.store.cache import locked_cache
from verifai_jax.core.user_code.source_collection import sources_of
from verifai_jax.falsification.validation import check_search
from verifai_jax.search import Search, named

KIND = "augmentation"
"""Kind of the cache."""
DEFAULT_ARMS = ("none", "random", "counterexamples")
"""Default arms; `standard` is added if the task has a transformation."""


@suggests_options
@reproducible_settings()
def augment(
    task: SupervisedTask, arms: Sequence[str] | str | None = None, *, initial: int = 1000,
    added: int = 200, steps: tuple[int, int] = (600, 300), search: str | Search = "uniform",
    budget: int | None = None, seeds: int = 5, seed: int = 0, test: int = 4096, hard: int = 400,
    confidence: float = 0.95, folder: str | Path | None = None, progress: bool | None = None,
    even_if_changed: bool = False,
) -> Augmentation:  # fmt: skip
    """Compare ways to add training data over several seeds, with paired data, weights and tests.

    All arms train the same base network further, with the same number of steps:

    - `none`: nothing is added.
    - `random`: new inputs from the prior.
    - `standard`: initial inputs, transformed by the task's `transform`.
    - `counterexamples`: rows of the error table, in the order in which the search found them.
    - `table_random`, `table_closest`: counterexamples at random, or those closest to each other.
    - `table_pca`, `rules`: new inputs along the principal components of the counterexamples, or
      inside the rules of the table, even if the network is right on them.
    - `pca_kept`, `rules_kept`: the same, but only inputs on which the network errs are added.

    **Arguments:**
    - `task`: the task to train, with the renderer of its inputs.
    - `arms`: names of arms, or `"all"`; by default `none`, `random`, `counterexamples`, and
      `standard` if the task has a transformation.
    - `initial`: number of inputs in the initial set.
    - `added`: number of inputs that an arm adds.
    - `steps`: training steps of the base network, and of each arm afterwards.
    - `search`: the search that fills the error table: a name, or a search with its options.
    - `budget`: number of simulations for the error table; ten times `added` when left out.
    - `seeds`: number of repetitions, each with its own data, weights and tests.
    - `seed`: the seed from which all repetitions are derived.
    - `test`: number of inputs in the uniform test.
    - `hard`: number of inputs in the hard test, on which an independently trained network errs; 0
      for none. It is the same for all seeds.
    - `confidence`: the confidence of each single interval.
    - `folder`: the folder that stores finished work: the same call resumes after an interruption,
      and one with more seeds or arms computes only the new ones.
    - `progress`, `even_if_changed`: as in `falsify` and `resume`.
    **Returns:** the result: a table with a row for each arm and seed, and comparisons. After an
    interruption (Ctrl-C) it has the finished rows, and `complete` is False.
    **Raises:** before anything is trained, `UnknownNameError` for unknown arms, searches and
    options; `ValueError` for numbers out of range, and for a search that needs gradients if the
    task has none; `TaskError` for a task whose parts do not fit; `CacheError` for a folder that is
    damaged, or of another augmentation; `FolderInUse` if another process writes there.
    """
    if not isinstance(task, SupervisedTask):
        raise TypeError(f"augment needs a SupervisedTask; got {type(task).__name__}")
    chosen = _arms(task, arms)
    first, further = steps
    counts = {"initial": initial, "added": added, "the first of steps": first}
    counts |= {"the second of steps": further, "seeds": seeds, "seed": seed, "test": test}
    for name, value in {**counts, "hard": hard}.items():
        check_count(name, value, 0 if name in ("seed", "hard") else 1)
    check_fraction("confidence", confidence)
    budget = 10 * added if budget is None else check_count("budget", budget)
    search = named(search) if isinstance(search, str) else search
    task.check()
    check_search(searched_problem(task, None, search, None), search)
    plan = Plan(initial, added, first, further, search, budget, seed, test, hard)
    with locked_cache(folder, KIND) as cache, ProgressBar(progress) as bar:
        cache.claim(_fingerprint(task, plan), sources_of(task), even_if_changed)
        bar.begin(task.name, seeds * (1 + len(chosen)), "networks")
        study = Study(task, plan, cache, bar)
        complete = True
        try:
            for number in range(seeds):
                study.run(number, chosen)
        except KeyboardInterrupt:
            complete = False
        result = study.result(chosen, confidence, complete)
    if folder is not None:
        with cache.writing(folder):
            result.save(folder)
    return result


def _arms(task: SupervisedTask, arms: Sequence[str] | str | None) -> tuple[str, ...]:
    if arms is None:
        return (*DEFAULT_ARMS, *(("standard",) if task.transform is not None else ()))
    if arms == "all":
        return tuple(arm for arm in ARMS if arm != "standard" or task.transform is not None)
    chosen = (arms,) if isinstance(arms, str) else tuple(arms)
    check_arms(chosen, task)
    return chosen


def _fingerprint(task: SupervisedTask, plan: Plan) -> dict[str, Any]:
    """Describe what decides the numbers of every arm and seed; code by its name only."""
    functions = ("render", "label", "train", "predict", "wrongness", "transform")
    return {
        "task": task.name,
        "space": describe_space(task.space),
        "training_space": task.training_space and describe_space(task.training_space),
        "constrained": [
            space is not None and space.where is not None
            for space in (task.space, task.training_space)
        ],
        "functions": {name: _name(getattr(task, name)) for name in functions},
        "measures": list(task.measures),
        "presence": task.has_presence,
        "options": {f.name: stable_text(getattr(plan, f.name)) for f in fields(plan)},
        "version": __version__,
    }


def _name(function: Any) -> str | None:
    return None if function is None else getattr(function, "__qualname__", type(function).__name__)
