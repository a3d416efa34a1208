"""The trainer of a study: from hyper-parameters to trainings, checked before anything trains.

trainer = Trainer(task, {"ppo": PPO(), "pqn": PQN()}, steps=32_768)
trainer.configuration({"algorithm": "ppo", "learning_rate": 1e-3, "width": 32}, seed=0)
"""

import dataclasses
import inspect
import pickle
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias, cast

import jax
import numpy as np

from verifai_jax.addons.rl import algorithms
from verifai_jax.addons.rl.algorithm import Algorithm, check_fit
from verifai_jax.addons.rl.batched_training import (
    Configuration,
    policy_structure,
    untrained_policy,
)
from verifai_jax.addons.rl.policies import policy as load
from verifai_jax.addons.rl.policy import Policy
from verifai_jax.addons.rl.ppo import PPO
from verifai_jax.addons.rl.task.task import Task
from verifai_jax.addons.training.sweeps.hyperparameters import companions, probe_values
from verifai_jax.core.messages.checks import check_count, check_positive, is_number
from verifai_jax.core.messages.errors import check_names, unknown_name
from verifai_jax.features import FeatureSpace
from verifai_jax.features.domain import Domain

ALGORITHM, STEPS, WIDTH = "algorithm", "steps", "width"
"""Hyper-parameters that are no fields of an algorithm or a task."""
_TASK = ("action", "time_limit", "reset", "step", "observe")
"""Attributes that a task must have."""


class StudyError(ValueError):
    """An error for a study that cannot be swept."""


Train: TypeAlias = Callable[..., Any]
"""A function `train(key, hyperparameters, steps=..., resume=...) -> policy`."""


@dataclass(frozen=True, eq=False)
class Trainer:
    """A task and the algorithms that may learn it, or a training function.

    A training function `train(key, hyperparameters, steps=..., resume=...) -> policy` can use any
    framework. It runs in its own process, so define it by `def` in a module or a script. It
    receives the random key of the training seed, a dictionary of plain values, and the total number
    of environment steps. `resume` is a folder, empty at first: files written there at one
    checkpoint are there again when the function is called for the next. A function without this
    argument trains from the start up to each checkpoint, unless it has the argument `checkpoint`: a
    function to call while it trains, `checkpoint(steps, policy, mean_return)`, which shows progress
    and takes the policies at the study's checkpoints. Processes are used again for other calls,
    so nothing that a call leaves in global variables may matter. It returns anything that
    `vj.policy` accepts, or `(policy, {"steps": [...], "mean_return": [...]})` with its learning
    curve.

    **Arguments:**
    - `task`: the task to learn, see `rl.Task`; if it is a dataclass its fields may be swept. Or a
      training function; `algorithms` is then left out.
    - `algorithms`: an algorithm, or several by name; their fields are the values of
      hyper-parameters that are not swept.
    - `steps`: number of environment steps of a training, rounded up to whole updates.
    - `nominal`: the task on which nominal returns are measured, for example without randomisation
      and shaping; by default `task` itself, and for a training function the mean return of its
      learning curve.
    - `example`: for a training function, a policy with actions of the same form, such as `lambda
      observation: jnp.zeros(2)`, with which the study is checked before anything trains.
    - `observation`: for a training function, an example observation if its policies do not define
      their input, such as functions and flax modules.
    - `workers`: for a training function, number of processes; by default the number of cores.
    - `timeout`: for a training function, maximum seconds of a call; a longer one is an error of its
      row.
    **Raises:** `StudyError` if there is no algorithm, for anything that is not an algorithm or
    task, a number of steps that is not positive, or a nominal task with other actions or
    observations.
    """

    task: Any
    algorithms: Algorithm | Mapping[str, Algorithm] = field(default_factory=PPO)
    steps: int = 32_768
    nominal: Task | None = None
    example: Any = None
    observation: Any = None
    workers: int | None = None
    timeout: float | None = None

    def __new__(cls, task: object = None, *arguments: object, **options: object) -> "Trainer":
        """Make the trainer of a function where `task` is one."""
        is_function = callable(task) and not isinstance(task, Task | type)
        return object.__new__(FunctionTrainer if cls is Trainer and is_function else cls)

    def __post_init__(self) -> None:
        for name in ("example", "observation", "workers", "timeout"):
            if getattr(self, name) is not None:
                raise StudyError(f"{name} belongs to a function that trains, not to a task")
        given = self.algorithms
        if not isinstance(given, Mapping):
            given = {type(given).__name__.lower(): given}
        if not given:
            raise StudyError("a trainer needs at least one algorithm; got none")
        for name, algorithm in given.items():
            if isinstance(algorithm, type) or not isinstance(algorithm, Algorithm):
                raise StudyError(
                    f"algorithm {name!r} must be an algorithm such as PPO(); got {algorithm!r}"
                )
        nominal = self.task if self.nominal is None else self.nominal
        for name, task in (("task", self.task), ("nominal", nominal)):
            if not isinstance(task, Task):
                missing = [n for n in _TASK if not hasattr(task, n)]
                raise StudyError(
                    f"{name} must have {', '.join(_TASK)}; {type(task).__name__} lacks "
                    f"{', '.join(missing)}"
                )
        forms = [(task.action, _observation_shape(task)) for task in (self.task, nominal)]
        if forms[0] != forms[1]:
            raise StudyError(
                f"nominal must have the actions and observations of task, {forms[0]}; "
                f"got {forms[1]}"
            )
        object.__setattr__(self, "algorithms", dict(given))
        self._check_steps()

    def _check_steps(self) -> None:
        object.__setattr__(self, "steps", whole_number(self.steps, STEPS))
        if self.steps < 1:
            raise StudyError(f"steps must be at least 1; got {self.steps}")

    @property
    def evaluation_task(self) -> Task | None:
        """Task on which nominal returns are measured; None if they come from the learning curve."""
        return self.task if self.nominal is None else self.nominal

    @property
    def by_name(self) -> dict[str, Algorithm]:
        """Algorithms by their names."""
        assert isinstance(self.algorithms, dict)
        return self.algorithms

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all hyper-parameters, with `algorithm`, `steps` and `width` first."""
        known: dict[str, None] = dict.fromkeys((ALGORITHM, STEPS))
        for algorithm in self.by_name.values():
            if _layers(algorithm):
                known[WIDTH] = None
        for owner in (*self.by_name.values(), self.task):
            known.update(dict.fromkeys(n for n in _fields(owner) if n not in _layers(owner)))
        return tuple(known)

    def configuration(self, values: Mapping[str, Any], seed: int = 0) -> Configuration:
        """Return the training with these hyper-parameters.

        **Arguments:**
        - `values`: plain Python values; others come from the fields of algorithm and task.
        - `seed`: training seed.
        **Raises:** `ValueError` for a value that the algorithm or the task refuses.
        """
        algorithm = self.by_name[self.algorithm_name(values)]
        changes: dict[str, Any] = {
            name: _cast(getattr(algorithm, name), values[name], name)
            for name in _fields(algorithm)
            if name in values and name not in _layers(algorithm)
        }
        if WIDTH in values:
            width = whole_number(values[WIDTH], WIDTH)
            for name in _layers(algorithm):
                changes[name] = (width,) * len(getattr(algorithm, name))
        task, fields = self.task, _fields(self.task)
        swept = {n: _cast(getattr(task, n), values[n], n) for n in fields if n in values}
        if swept:
            task = dataclasses.replace(task, **swept)  # pyright: ignore[reportArgumentType]
        if changes:
            algorithm = dataclasses.replace(algorithm, **changes)  # pyright: ignore[reportArgumentType]
        steps = whole_number(values.get(STEPS, self.steps), STEPS)
        return Configuration(task, algorithm, steps, seed)

    def structure(self, values: Mapping[str, Any]) -> Hashable:
        """Return a key that is equal for trainings that can go on from one another."""
        configuration = self.configuration(values)
        return *policy_structure(configuration), configuration.steps

    def algorithm_name(self, values: Mapping[str, Any]) -> str:
        """Return the name of the algorithm chosen by these hyper-parameters."""
        return str(values[ALGORITHM]) if ALGORITHM in values else next(iter(self.by_name))

    def used_hyperparameters(self, values: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the names of the hyper-parameters that the chosen algorithm or the task has."""
        algorithm = self.by_name[self.algorithm_name(values)]
        own = {ALGORITHM, STEPS, *_fields(algorithm), *_fields(self.task)}
        if _layers(algorithm):
            own.add(WIDTH)
        return tuple(name for name in values if name in own)

    def untrained_policy(self, name: str) -> Policy:
        """Return a policy of the form that this algorithm learns, with zero weights.

        Nothing compiles.
        """
        shapes = untrained_policy(self.by_name[name], self.task)
        return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)

    def algorithms_in(self, space: FeatureSpace) -> tuple[str, ...]:
        """Return the names of the algorithms that a space can choose."""
        if ALGORITHM not in space.domains:
            return tuple(self.by_name)
        return tuple(value for value, _ in probe_values(space.domains[ALGORITHM]))

    @property
    def name(self) -> str:
        """Class of the task, or name of the training function."""
        return type(self.task).__name__

    def check(self, space: FeatureSpace) -> None:
        """Check that a space of hyper-parameters can be trained; nothing compiles.

        **Raises:** `UnknownNameError` for an unknown hyper-parameter; `StudyError` for one that is
        not a single value, a value that an algorithm or the task always refuses, an algorithm that
        does not fit the task's actions, or a space that chooses no algorithm.
        """
        for name, domain in space.domains.items():
            if name not in self.names:
                for owner in self.by_name.values():
                    if name in _layers(owner):
                        raise StudyError(
                            f"{name} is a tuple of widths; sweep {WIDTH!r}, the width of all "
                            "hidden layers"
                        )
                raise unknown_name("hyper-parameter", name, self.names)
            _check_single(name, domain)
            owners = [o for o in self.by_name.values() if name in _fields(o)]
            if owners and name in _fields(self.task):
                raise StudyError(
                    f"both {type(owners[0]).__name__} and the task have a {name}: it is unclear "
                    "which one to sweep"
                )
        for name in self._checked_algorithms(space):
            self._check_fit(name)
            self._check_values(name, space)

    def _checked_algorithms(self, space: FeatureSpace) -> tuple[str, ...]:
        """Return the names of the algorithms that the space can choose."""
        if ALGORITHM not in space.domains and len(self.by_name) > 1:
            listing = ", ".join(map(repr, self.by_name))
            raise StudyError(
                f"the trainer has {len(self.by_name)} algorithms and the space does not choose "
                f'one: add "algorithm": Categorical({listing})'
            )
        chosen = self.algorithms_in(space)
        check_names("algorithm", chosen, self.by_name)
        return chosen

    def _check_fit(self, name: str) -> None:
        action = self.task.action
        try:
            check_fit(self.by_name[name], self.task)
        except ValueError as error:
            fitting = [n for n, a in self.by_name.items() if isinstance(action, a.actions)]
            fitting += [n for n in algorithms.algorithms_for(action) if n not in fitting]
            those = f"Those that fit: {', '.join(fitting) or 'none'}"
            raise StudyError(f"algorithm {name!r}: {error}. {those}") from None

    def _check_values(self, algorithm: str, space: FeatureSpace) -> None:
        candidates = companions(space)
        for name, domain in space.domains.items():
            if name == ALGORITHM or name not in self.used_hyperparameters(
                {ALGORITHM: algorithm, name: None}
            ):
                continue
            for value, part in probe_values(domain):
                refused = None
                # A value that only some of the others exclude becomes an error of its row.
                for others in candidates:
                    values = {**others, ALGORITHM: algorithm, name: value}
                    try:
                        self.configuration(values).check()
                    except (ValueError, TypeError) as error:
                        refused = refused or error
                    else:
                        refused = None
                        break
                if refused is not None:
                    raise StudyError(f"{name}: {refused}, {part} of {domain!r}") from refused
        for others in candidates:
            try:
                self.configuration({**others, ALGORITHM: algorithm}).check()
                return
            except (ValueError, TypeError) as error:
                last = error
        raise StudyError(f"algorithm {algorithm!r}: {last}")


class FunctionTrainer(Trainer):
    """The trainer of a training function; made by `Trainer`."""

    def __post_init__(self) -> None:
        self._check_steps()
        if self.example is None:
            raise StudyError(
                f"{self.name} is a training function: give example=, a policy with actions of the "
                "form that it returns, such as lambda observation: jnp.zeros(2)"
            )
        if self.nominal is not None and not isinstance(self.nominal, Task):
            raise StudyError(f"nominal must be a task; got {type(self.nominal).__name__}")
        if self.workers is not None:
            check_count("workers", self.workers, error=StudyError)
        if self.timeout is not None:
            check_positive("timeout", self.timeout)
        names = inspect.signature(self.train).parameters
        anything = any(p.kind is p.VAR_KEYWORD for p in names.values())
        if "steps" not in names and not anything:
            raise StudyError(
                f"{self.name} must be train(key, hyperparameters, steps=..., resume=...) -> "
                f"policy; it has the arguments {', '.join(names)}"
            )

    @property
    def train(self) -> Train:
        """The training function."""
        return cast(Train, self.task)

    @property
    def name(self) -> str:
        return getattr(self.train, "__name__", type(self.train).__name__)

    @property
    def evaluation_task(self) -> Task | None:
        return self.nominal

    @property
    def by_name(self) -> dict[str, Any]:
        """The training function by its name."""
        return {self.name: self.train}

    def algorithms_in(self, space: FeatureSpace) -> tuple[str, ...]:
        return (self.name,)

    def used_hyperparameters(self, values: Mapping[str, Any]) -> tuple[str, ...]:
        """Return all names, since the function receives all values."""
        return tuple(values)

    def untrained_policy(self, name: str) -> Any:
        return load(self.example, observation=self.observation)

    def check(self, space: FeatureSpace) -> None:
        """Check that the hyper-parameters are single values, and that processes find the function.

        **Raises:** `StudyError`.
        """
        for name, domain in space.domains.items():
            _check_single(name, domain)
        try:
            pickle.dumps(self.train)
        except Exception as error:
            raise StudyError(
                f"{self.name} runs in processes of its own, which must be able to import it: "
                "define it by `def` at the top level of a module or a script"
            ) from error


def _check_single(name: str, domain: Domain) -> None:
    if domain.columns(name) not in ((name,), ()) or domain.size > 1:
        raise StudyError(f"hyper-parameter {name} must be a single value; got {domain!r}")


def takes(train: Train, name: str) -> bool:
    """Return whether a training function has an argument of this name."""
    return name in inspect.signature(train).parameters


def _observation_shape(task: Task) -> tuple[int, ...]:
    """Return the shape of a task's observations."""
    form = jax.eval_shape(
        lambda key: task.observe(task.reset(key)), jax.eval_shape(lambda: jax.random.key(0))
    )
    return form.shape


def _fields(owner: object) -> tuple[str, ...]:
    if not dataclasses.is_dataclass(owner):
        return ()
    return tuple(f.name for f in dataclasses.fields(owner) if f.init)


def _layers(owner: object) -> tuple[str, ...]:
    """Return the names of the fields that hold widths of hidden layers."""
    return tuple(
        name
        for name in _fields(owner)
        if isinstance(value := getattr(owner, name), tuple)
        and isinstance(owner, Algorithm)
        and all(isinstance(width, int) for width in value)
    )


def _cast(present: object, value: object, name: str) -> object:
    """Return a value in the type of the present value of its field."""
    if isinstance(present, bool):
        if value not in (False, True):
            raise ValueError(f"{name} must be True or False; got {value!r}")
        return bool(value)
    if isinstance(present, int):
        return whole_number(value, name)
    if isinstance(present, float | np.ndarray | np.generic | jax.Array) and np.ndim(present) == 0:
        if isinstance(value, bool | str) or not isinstance(value, int | float):
            raise ValueError(f"{name} must be a number; got {value!r}")
        return float(value)
    if isinstance(present, str | None):
        return value
    raise ValueError(f"{name} is not a single value and cannot be swept; it is {present!r}")


def whole_number(value: object, name: str) -> int:
    """Return a hyper-parameter as an integer, or raise if it is not one."""
    if not is_number(value) or int(value) != value:
        raise ValueError(f"{name} must be a whole number (DiscreteBox, Categorical); got {value!r}")
    return int(value)
