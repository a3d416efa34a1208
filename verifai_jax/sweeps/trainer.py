"""What a sweep trains: from hyper-parameters to trainings, with all that can be wrong said first.

    trainer = Trainer(task, {"ppo": PPO(), "pqn": PQN()}, steps=32_768)
    trainer.configuration({"algorithm": "ppo", "learning_rate": 1e-3, "width": 32}, seed=0)

Hyper-parameters are `algorithm` (which one), `steps` (environment steps in all), `width` (of all
hidden layers), and the fields of the algorithms and of the task. One that the chosen algorithm
lacks is not used by it.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import jax
import numpy as np

from verifai_jax.core.errors import unknown_name
from verifai_jax.features import (
    Box,
    Categorical,
    Constant,
    DiscreteBox,
    FeatureSpace,
    LogUniform,
    TruncatedNormal,
)
from verifai_jax.features.domain import Domain
from verifai_jax.rl import algorithms
from verifai_jax.rl.algorithm import Algorithm
from verifai_jax.rl.batched_training import Configuration
from verifai_jax.rl.policy import Policy
from verifai_jax.rl.ppo import PPO
from verifai_jax.rl.task.task import Task

ALGORITHM, STEPS, WIDTH = "algorithm", "steps", "width"
_PROBES = 64
"""Choices of a domain up to which each is checked; the ends of larger ones."""
_COMPANY = 16
"""Points of the space in whose company a value is refused before it is said to be impossible."""


_CHUNK = 32


class StudyError(ValueError):
    """A study that cannot be swept, and why."""


@dataclass(frozen=True, eq=False)
class Trainer:
    """A task and the algorithms that may learn it.

    **Arguments:**

    - `task`: what to learn, see `rl.Task`. If it is a dataclass its fields may be swept.
    - `algorithms`: an algorithm, or several by name, with the values of what is not swept.
    - `steps`: environment steps of a training, rounded up to whole updates.
    - `nominal`: the task that nominal returns are measured on, such as the same one without
      randomisation and shaping; `task` itself when left out.

    **Raises:** `StudyError` for no algorithm, something that is none, a number of steps that is not
    positive, or a nominal task with other actions or observations.
    """

    task: Task
    algorithms: Algorithm | Mapping[str, Algorithm] = field(default_factory=PPO)
    steps: int = 32_768
    nominal: Task | None = None

    def __post_init__(self) -> None:
        given: Any = self.algorithms
        if not isinstance(given, Mapping):
            given = {type(given).__name__.lower(): given}
        if not given:
            raise StudyError("a trainer needs at least one algorithm; got none")
        for name, algorithm in given.items():
            if isinstance(algorithm, type) or not isinstance(algorithm, Algorithm):
                raise StudyError(
                    f"algorithm {name!r} must be an algorithm such as PPO(); got {algorithm!r}"
                )
        for name, task in (("task", self.task), ("nominal", self.measured_on)):
            if not isinstance(task, Task):
                lacks = [n for n in _TASK if not hasattr(task, n)]
                raise StudyError(
                    f"{name} must have {', '.join(_TASK)}; {type(task).__name__} lacks "
                    f"{', '.join(lacks)}"
                )
        forms = [(task.action, _observed(task)) for task in (self.task, self.measured_on)]
        if forms[0] != forms[1]:
            raise StudyError(
                f"nominal must have the actions and observations of task, {forms[0]}; "
                f"got {forms[1]}"
            )
        object.__setattr__(self, "algorithms", dict(given))
        object.__setattr__(self, "steps", _whole(self.steps, STEPS))
        if self.steps < 1:
            raise StudyError(f"steps must be at least 1; got {self.steps}")

    @property
    def measured_on(self) -> Task:
        """The task that nominal returns are measured on."""
        return self.task if self.nominal is None else self.nominal

    @property
    def by_name(self) -> dict[str, Algorithm]:
        """The algorithms."""
        assert isinstance(self.algorithms, dict)
        return self.algorithms

    @property
    def names(self) -> tuple[str, ...]:
        """The hyper-parameters that there are, `algorithm`, `steps` and `width` first."""
        known: dict[str, None] = dict.fromkeys((ALGORITHM, STEPS))
        for algorithm in self.by_name.values():
            if _layers(algorithm):
                known[WIDTH] = None
        for owner in (*self.by_name.values(), self.task):
            known.update(dict.fromkeys(n for n in _fields(owner) if n not in _layers(owner)))
        return tuple(known)

    def configuration(self, values: Mapping[str, Any], seed: int = 0) -> Configuration:
        """The training with these hyper-parameters, plain Python values.

        **Raises:** `ValueError` for a value that its owner refuses.
        """
        algorithm = self.by_name[self.chosen(values)]
        changes: dict[str, Any] = {
            name: _like(getattr(algorithm, name), values[name], name)
            for name in _fields(algorithm)
            if name in values and name not in _layers(algorithm)
        }
        if WIDTH in values:
            width = _whole(values[WIDTH], WIDTH)
            for name in _layers(algorithm):
                changes[name] = (width,) * len(getattr(algorithm, name))
        task, fields = self.task, _fields(self.task)
        swept = {n: _like(getattr(task, n), values[n], n) for n in fields if n in values}
        if swept:
            task = dataclasses.replace(task, **swept)  # pyright: ignore[reportArgumentType]
        if changes:
            algorithm = dataclasses.replace(algorithm, **changes)  # pyright: ignore[reportArgumentType]
        steps = _whole(values.get(STEPS, self.steps), STEPS)
        return Configuration(task, algorithm, steps, seed)

    def chosen(self, values: Mapping[str, Any]) -> str:
        """The name of the algorithm that these hyper-parameters choose."""
        return str(values[ALGORITHM]) if ALGORITHM in values else next(iter(self.by_name))

    def uses(self, values: Mapping[str, Any]) -> tuple[str, ...]:
        """Which of these hyper-parameters have a meaning for the algorithm that they choose."""
        algorithm = self.by_name[self.chosen(values)]
        own = {ALGORITHM, STEPS, *_fields(algorithm), *_fields(self.task)}
        if _layers(algorithm):
            own.add(WIDTH)
        return tuple(name for name in values if name in own)

    def untrained(self, name: str) -> Policy:
        """A policy of the form that this algorithm learns, all weights zero; nothing compiles."""
        algorithm = self.by_name[name]

        def first(key: Any) -> Policy:
            return algorithm.policy(self.task, algorithm.init(self.task, key, 1))

        form = jax.eval_shape(first, jax.eval_shape(lambda: jax.random.key(0)))
        return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), form)

    def check(self, space: FeatureSpace) -> None:
        """Refuse a space of hyper-parameters that cannot be trained; nothing compiles.

        **Raises:** `UnknownNameError` for a hyper-parameter that there is not; `StudyError` for
        one that is not a single value, a value that an algorithm or the task refuses whatever the
        others are, an algorithm that does not fit the task's actions, or no choice of one.
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
            if domain.columns(name) not in ((name,), ()) or domain.size > 1:
                raise StudyError(f"hyper-parameter {name} must be a single value; got {domain!r}")
            owners = [o for o in self.by_name.values() if name in _fields(o)]
            if owners and name in _fields(self.task):
                raise StudyError(
                    f"both {type(owners[0]).__name__} and the task have a {name}: it is not clear "
                    "which one to sweep"
                )
        for name in self._checked_algorithms(space):
            self._check_fit(name)
            self._check_values(name, space)

    def _checked_algorithms(self, space: FeatureSpace) -> list[str]:
        """The algorithms that may be chosen."""
        if ALGORITHM not in space.domains:
            if len(self.by_name) > 1:
                listing = ", ".join(map(repr, self.by_name))
                raise StudyError(
                    f"the trainer has {len(self.by_name)} algorithms and the space does not choose "
                    f'one: add "algorithm": Categorical({listing})'
                )
            return list(self.by_name)
        chosen = [value for value, _ in probes(space.domains[ALGORITHM])]
        for name in chosen:
            if name not in self.by_name:
                raise unknown_name("algorithm", name, self.by_name)
        return chosen

    def _check_fit(self, name: str) -> None:
        algorithm = self.by_name[name]
        if isinstance(self.task.action, algorithm.actions):
            return
        fitting = [n for n, a in self.by_name.items() if isinstance(self.task.action, a.actions)]
        fitting += [n for n in algorithms.algorithms_for(self.task.action) if n not in fitting]
        kinds = " or ".join(kind.__name__.lower() for kind in algorithm.actions)
        raise StudyError(
            f"algorithm {name!r}: {type(algorithm).__name__} learns {kinds} actions; "
            f"{type(self.task).__name__} has {self.task.action}. "
            f"Those that fit: {', '.join(fitting) or 'none'}"
        )

    def _check_values(self, algorithm: str, space: FeatureSpace) -> None:
        company = _company(space)
        for name, domain in space.domains.items():
            if name == ALGORITHM or name not in self.uses({ALGORITHM: algorithm, name: None}):
                continue
            for value, place in probes(domain):
                refused = None
                # What is wrong in one company only shows in the table, as the row's error.
                for others in company:
                    values = {**others, ALGORITHM: algorithm, name: value}
                    try:
                        self.configuration(values).check()
                    except (ValueError, TypeError) as error:
                        refused = refused or error
                    else:
                        refused = None
                        break
                if refused is not None:
                    raise StudyError(f"{name}: {refused}, {place} of {domain!r}") from refused
        for others in company:
            try:
                self.configuration({**others, ALGORITHM: algorithm}).check()
                return
            except (ValueError, TypeError) as error:
                last = error
        raise StudyError(f"algorithm {algorithm!r}: {last}")


def _observed(task: Task) -> tuple[int, ...]:
    """The shape of what a policy sees."""
    form = jax.eval_shape(
        lambda key: task.observe(task.reset(key)), jax.eval_shape(lambda: jax.random.key(0))
    )
    return form.shape


_TASK = ("action", "time_limit", "reset", "step", "observe")


def labelled(space: FeatureSpace, points: Any) -> list[dict[str, Any]]:
    """The hyper-parameters at points `[n, dim]` of the unit cube, as plain Python values.

    Strings are strings, numbers of a `Categorical` the choices themselves; real numbers are those
    of float32, which is what a training sees.
    """
    points = np.asarray(points, np.float32)
    found: list[dict[str, Any]] = []
    for start in range(0, len(points), _CHUNK):
        some = points[start : start + _CHUNK]
        padded = np.pad(some, ((0, _CHUNK - len(some)), (0, 0)), mode="edge")
        found += labels(space, _unflatten(space)(padded))[: len(some)]
    return found


@lru_cache(maxsize=16)
def _unflatten(space: FeatureSpace) -> Any:
    """Compiled once for a space, whatever the number of points."""
    return jax.jit(jax.vmap(space.unflatten))


def labels(space: FeatureSpace, features: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The same for features, leaves `[n]`."""
    columns = space.rows(jax.tree.map(np.asarray, features))
    count = len(np.ravel(next(iter(jax.tree.leaves(features)))))
    found: list[dict[str, Any]] = [{} for _ in range(count)]
    for name, domain in space.domains.items():
        texts = {str(choice): choice for choice in getattr(domain, "choices", ())}
        for i in range(count):
            if isinstance(domain, Constant):
                value = domain.value
            else:
                value = columns[name][i]
                value = value.item() if isinstance(value, np.generic) else value
            found[i][name] = texts.get(value, value) if isinstance(value, str) else value
    return found


def probes(domain: Domain) -> list[tuple[Any, str]]:
    """Values of a domain to check, with words for where they lie: its choices, or its ends."""
    match domain:
        case Constant():
            return [(domain.value, "the value")]
        case Categorical() if len(domain.choices) <= _PROBES:
            return [(choice, "a choice") for choice in domain.choices]
        case DiscreteBox(int(low), int(high)) if high - low < _PROBES:
            inner = [(value, "a value") for value in range(low + 1, high)]
            return [(domain.low, "the lower end"), *inner, (domain.high, "the upper end")]
        case Box() | DiscreteBox() | LogUniform() | TruncatedNormal():
            # As it was written, not as float32 has it.
            return [(domain.low, "the lower end"), (domain.high, "the upper end")]
    space = FeatureSpace({"value": domain})
    if not domain.size:
        return [(labelled(space, np.zeros((1, 0)))[0]["value"], "the value")]
    ends = [row["value"] for row in labelled(space, np.array([[0.0], [1.0]]))]
    return [(ends[0], "the lower end"), (ends[1], "the upper end")]


def _company(space: FeatureSpace) -> list[dict[str, Any]]:
    """Points all over the space, the middle first, as companions of a value to check."""
    rng = np.random.default_rng(0)
    # A constraint may make values possible that are rare without it.
    count = _COMPANY if space.where is None else 16 * _COMPANY
    points = np.concatenate([np.full((1, space.dim), 0.5), rng.random((count, space.dim))])
    return labelled(space, points)


def _fields(owner: Any) -> tuple[str, ...]:
    if not dataclasses.is_dataclass(owner):
        return ()
    return tuple(f.name for f in dataclasses.fields(owner) if f.init)


def _layers(owner: Any) -> tuple[str, ...]:
    """The fields that hold widths of hidden layers."""
    return tuple(
        name
        for name in _fields(owner)
        if isinstance(value := getattr(owner, name), tuple)
        and isinstance(owner, Algorithm)
        and all(isinstance(width, int) for width in value)
    )


def _like(present: Any, value: Any, name: str) -> Any:
    """The value in the type that the field has."""
    if isinstance(present, bool):
        if value not in (False, True):
            raise ValueError(f"{name} must be True or False; got {value!r}")
        return bool(value)
    if isinstance(present, int):
        return _whole(value, name)
    if isinstance(present, float | np.ndarray | np.generic | jax.Array) and np.ndim(present) == 0:
        if isinstance(value, bool | str) or not isinstance(value, int | float):
            raise ValueError(f"{name} must be a number; got {value!r}")
        return float(value)
    if isinstance(present, str | None):
        return value
    raise ValueError(f"{name} is no single value and cannot be swept; it is {present!r}")


def _whole(value: Any, name: str) -> int:
    number = isinstance(value, int | float | np.integer) and not isinstance(value, bool)
    if not number or int(value) != value:
        raise ValueError(f"{name} must be a whole number (DiscreteBox, Categorical); got {value!r}")
    return int(value)
