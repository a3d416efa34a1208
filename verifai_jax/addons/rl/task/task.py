"""The contract of an environment to train on, and the kinds of action.

    class Reach:
        action = Continuous(low=-1.0, high=1.0)
        time_limit = 200
        def reset(self, key): ...
        def step(self, key, state, action): ...             # state, reward, terminated
        def observe(self, state): ...

There is no base class: any object with these members is a task.
"""

from typing import Protocol, TypeAlias, runtime_checkable

from jaxtyping import Array, Bool, Float, Key, PyTree, Shaped

from verifai_jax.systems.actions import Action

State: TypeAlias = PyTree
"""The state of one environment: any pytree of arrays, of the same structure at every step."""


@runtime_checkable
class Task(Protocol):
    """An episodic task: pure functions that JAX can trace, for one environment.

    - `action`: the kind of action that `step` takes.
    - `time_limit`: number of steps after which an episode is truncated. Truncation does not end it:
      the last state still has a value. Only `terminated`, returned by `step`, ends an episode for
      good.

    A task may also define `start(key, features) -> state`, the first state of an episode with given
    features of a problem, which `vj.harden` uses to train on counterexamples.

    The object is a static argument of compiled programs, so it must be hashable. It may also be a
    pytree: its numbers are then arguments of the program, and other values need no compilation.
    """

    @property
    def action(self) -> Action:
        """The kind of action that `step` takes."""
        ...

    @property
    def time_limit(self) -> int:
        """Number of steps after which an episode is truncated."""
        ...

    def reset(self, key: Key[Array, ""]) -> State:
        """Draw a first state, with the structure, shapes and dtypes that `step` returns."""
        ...

    def step(
        self, key: Key[Array, ""], state: State, action: Shaped[Array, "..."]
    ) -> tuple[State, Float[Array, ""], Bool[Array, ""]]:
        """Take one step.

        **Arguments:**
        - `action`: an int32 scalar for a `Discrete` task, a float32 vector `[size]` for a
          `Continuous` one.
        **Returns:** the next state; the reward; whether the episode is over for good.
        """
        ...

    def observe(self, state: State) -> Float[Array, " k"]:
        """Return the policy's observation `[k]` of a state."""
        ...
