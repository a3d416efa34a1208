"""A task with a mixture of episodes: its own, from the prior of a problem, and near failures.

    task = mixture_of(task, problem, start)             # all episodes are the task's own
    mixture = Mixture.of(space, (0.25, 0.375, 0.375), centres)
    task = replace(task, mixture=mixture)               # the same structure: nothing is compiled

An episode's features are a pure function of its random key and of arrays, so one compiled training
serves all rounds.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree, Shaped

from verifai_jax.addons.rl.batched_training import StaticTask, numbers_of
from verifai_jax.addons.rl.task.task import State, Task
from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.core.messages.text import format_error
from verifai_jax.counterexamples.nominal import Nominal
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.actions import Action

CAPACITY = 256
"""Maximum number of neighbourhoods in a mixture; the newest are kept."""
RADIUS, NARROW = 0.1, 0.03
"""Half sides of a wide and a narrow neighbourhood, as shares of each coordinate's range."""
TRIES = 8
"""Number of draws; the first that satisfies the constraint is used."""
Start = Callable[[Key[Array, ""], dict[str, Any]], State]
"""`(key, features) -> state`"""
Shares = tuple[float, float, float]
"""Shares of episodes, as `Mixture` has them."""


class HardeningError(ValueError):
    """An error for a task and a problem that cannot be hardened together."""


@dataclass(frozen=True)
class FurtherTraining:
    """The training of a round: its length, and where its episodes begin.

    - `steps`: environment steps of each round; an eighth of the first training when left out.
    - `added`: the maximum number of failures, as points to train around, that a round adds.
    - `own`, `failing`: share of the task's own episodes, and share of episodes that begin near
      failures, including those drawn from the prior that fail; all others come from the prior. The
      share of own episodes grows after a round that loses return, and shrinks after other rounds.
    - `tolerance`: the share of the first policy's return that the result may lose.
    - `start`: a function `(key, features) -> state` for a task without such a method.

    **Raises:** `ValueError` for numbers out of range.
    """

    steps: int | None = None
    added: int = 64
    own: float = 0.25
    failing: float = 0.5
    tolerance: float = 0.02
    start: Start | None = None

    def __post_init__(self) -> None:
        if self.steps is not None:
            check_count("steps", self.steps)
        check_count("added", self.added)
        for name in ("own", "failing", "tolerance"):
            check_fraction(name, getattr(self, name), zero=True)
        if self.own + self.failing > 1:
            raise ValueError(
                f"own and failing are shares of all episodes; got {self.own} + {self.failing} > 1"
            )


def neighbourhoods(
    space: FeatureSpace, centres: Float[np.ndarray, "n d"], radii: Float[np.ndarray, " n"] | float
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
    """Return the ends of boxes around points of the unit cube."""
    # The neighbourhood of a choice or an integer is its cell.
    wide = np.array(space.levels) <= 0
    around = np.asarray(radii, np.float32)[..., None] * wide
    return np.clip(centres - around, 0.0, 1.0), np.clip(centres + around, 0.0, 1.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mixture:
    """Points of the unit cube of a space, from the prior and from neighbourhoods.

    - `shares`: shares of the task's own episodes, of those from the prior, and from neighbourhoods.
    - `low`, `high`: `[neighbourhoods, d]`, boxes of the unit cube; only the first `count` are used.
    """

    # JAX rebuilds the class with stacked arrays and placeholders, which have other shapes.
    __no_type_check__ = True
    space: FeatureSpace = field(metadata={"static": True})
    shares: Float[Array | np.ndarray, "3"]
    low: Float[Array | np.ndarray, "n d"]
    high: Float[Array | np.ndarray, "n d"]
    count: int

    @classmethod
    def of(
        cls, space: FeatureSpace, shares: Shares, centres: Float[np.ndarray, "n d"],
        radii: Float[np.ndarray, " n"] | float = RADIUS,
    ) -> "Mixture":  # fmt: skip
        """Return a mixture with neighbourhoods of these points; without points it has none."""
        count = len(centres)
        if not count:
            shares = (shares[0], shares[1] + shares[2], 0.0)
        ends = np.zeros((2, CAPACITY, space.dim), np.float32)
        ends[:, :count] = neighbourhoods(space, centres, radii)
        return cls(space, np.asarray(shares, np.float32), ends[0], ends[1], count)

    def draw(self, key: Key[Array, ""]) -> Float[Array, " d"]:
        """Draw a point of the unit cube, from the prior or from a neighbourhood."""
        kind_key, which_key, point_key = jax.random.split(key, 3)
        _, prior, failing = self.shares
        near = jax.random.uniform(kind_key) * (prior + failing) >= prior
        index = jax.random.randint(which_key, (), 0, jnp.maximum(self.count, 1))
        tries = 1 if self.space.where is None else TRIES
        u = jax.random.uniform(point_key, (tries, self.space.dim))
        low, high = (jnp.asarray(ends)[index] for ends in (self.low, self.high))
        points = jnp.where(near, low + u * (high - low), u)
        if tries == 1:
            return points[0]
        accepted = jax.vmap(lambda point: self.space.accepts(self.space.unflatten(point)))(points)
        return points[jnp.argmax(accepted)]

    def episode(
        self, kind_key: Key[Array, ""], draw_key: Key[Array, ""]
    ) -> tuple[Bool[Array, ""], Float[Array, " d"]]:
        """Draw whether an episode is the task's own, and the point for any other episode."""
        return jax.random.uniform(kind_key) < self.shares[0], self.draw(draw_key)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MixtureTask:
    """A task that draws the features of an episode from a mixture; made by `mixture_of`.

    - `own`: the point of the unit cube of the task's own episodes; None if `reset` starts them.
    """

    __no_type_check__ = True
    static: StaticTask = field(metadata={"static": True})
    starting: Start | None = field(metadata={"static": True})
    own: tuple[float, ...] | None = field(metadata={"static": True})
    numbers: list[np.ndarray]
    mixture: Mixture

    @property
    def task(self) -> Task:
        """The task itself."""
        return self.static.with_numbers(self.numbers)

    @property
    def action(self) -> Action:
        return self.task.action

    @property
    def time_limit(self) -> int:
        return self.task.time_limit

    def reset(self, key: Key[Array, ""]) -> State:
        """Start an episode of the mixture."""
        kind_key, draw_key, start_key, own_key = jax.random.split(key, 4)
        is_own, u = self.mixture.episode(kind_key, draw_key)
        if self.own is not None:
            return self.started(start_key, jnp.where(is_own, jnp.asarray(self.own, u.dtype), u))

        def either(own: Array, started: Array) -> Array:
            own = jnp.asarray(own)
            return jnp.where(is_own, own, jnp.asarray(started, own.dtype))

        return jax.tree.map(either, self.task.reset(own_key), self.started(start_key, u))

    def started(self, key: Key[Array, ""], u: Float[Array, " d"]) -> State:
        """Start an episode with the features at a point of the unit cube."""
        start = cast(Any, self.task).start if self.starting is None else self.starting
        return start(key, self.mixture.space.unflatten(u))

    def step(
        self, key: Key[Array, ""], state: State, action: Shaped[Array, "..."]
    ) -> tuple[State, Float[Array, ""], Bool[Array, ""]]:
        return self.task.step(key, state, action)

    def observe(self, state: State) -> Float[Array, " k"]:
        return self.task.observe(state)


def mixture_of(task: Task, problem: Problem, start: Start | None) -> MixtureTask:
    """Return a task that starts with its own episodes only and accepts other mixtures.

    **Raises:** `HardeningError` for a task that cannot start with given features.
    """
    if start is None and not callable(getattr(task, "start", None)):
        raise HardeningError(
            f"{type(task).__name__} does not say how an episode starts with the features of "
            f"{problem.name!r}: give the task a method start(key, features) -> state, or give "
            "harden start=, a function of the same arguments"
        )
    own = Mixture.of(problem.space, (1.0, 0.0, 0.0), np.zeros((0, problem.space.dim)))
    mixed = MixtureTask(StaticTask(task), start, None, numbers_of(task)[0], own)
    key = jax.eval_shape(lambda: jax.random.key(0))
    point = jax.ShapeDtypeStruct((problem.space.dim,), np.float32)
    try:
        started = jax.eval_shape(mixed.started, key, point)
    except Exception as error:
        raise HardeningError(
            f"an episode of {type(task).__name__} does not start with the features of "
            f"{problem.name!r} ({', '.join(problem.space.domains)}): {format_error(error)}"
        ) from error
    if _form(started) != _form(jax.eval_shape(task.reset, key)):
        # Its own episodes lack something that differs from one episode of the problem to the next.
        try:
            u = Nominal.of(problem).u
        except ValueError as error:
            raise HardeningError(
                f"the episodes that {type(task).__name__}.reset starts have another structure than "
                f"those with the features of {problem.name!r}, and {error}"
            ) from error
        mixed = replace(mixed, own=tuple(map(float, u)))
    return mixed


def _form(state: PyTree) -> tuple[Any, list[tuple[int, ...]]]:
    leaves, structure = jax.tree.flatten(state)
    return structure, [leaf.shape for leaf in leaves]
