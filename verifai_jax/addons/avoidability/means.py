"""Means by which a failure could have been avoided: actions, features, or another policy."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Key, PyTree

from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.verdicts import boolean_semantics, trace_verdict
from verifai_jax.features import FeatureSpace
from verifai_jax.mtl import smooth
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import System
from verifai_jax.systems.channels import Instant, Link, Side
from verifai_jax.systems.forks import Fork

PLAN = "plan of actions"
"""The name of the feature that holds the actions in place of the policy's."""


class Choice(NamedTuple):
    """Numbers `[steps, entries]` from 0 to 1, in force from one decision to another."""

    start: Int[Array, "*n"]
    numbers: Float[Array, "*n steps entries"]
    stop: Int[Array, "*n"]


@dataclass(frozen=True)
class Steering(Link):
    """A link that replaces the actions of the policy; its memory is the last action."""

    side: Side = "action"
    decides: bool = True
    features: tuple[str, ...] = (PLAN,)

    def begin(self, value: PyTree, now: Instant, key: Key[Array, ""] | int | None) -> PyTree:
        return jnp.zeros_like(ravel_pytree(value)[0])

    def through(self, state: PyTree, value: PyTree, now: Instant) -> tuple[PyTree, PyTree]:
        start, actions, stop = now.features[PLAN]
        own, unravel = ravel_pytree(value)
        planned = actions[jnp.clip(now.step, 0, len(actions) - 1)].astype(own.dtype)
        action = jnp.where((now.step >= start) & (now.step < stop), planned, own)
        return unravel(action), now.kept(state, action)


class Means:
    """The means by which `who` could have avoided a failure, and their compiled programs.

    - `shape`: `(steps, entries)` of a choice; `levels`: number of values of each entry, 0 for real
      numbers; `period`: samples between two decisions; `ends`: whether a choice may stop before the
      end, so that the policy goes on; `constraint`: says which `[n, entries]` are admissible.
    """

    who: str
    shape: tuple[int, int] = (1, 0)
    levels: tuple[int, ...] = ()
    period: int = 1
    ends: bool = False
    constraint: Callable[..., Any] | None = None

    def __init__(self, problem: Problem, system: System) -> None:
        self.problem, self.system = problem, system
        self.course = jax.jit(self._course)
        self.judge = jax.jit(jax.vmap(self._judged, in_axes=(None, None, 0)))
        slope = jax.grad(self._objective, argnums=2, allow_int=True)
        self.climb = jax.jit(jax.vmap(slope, in_axes=(None, None, 0, None)))
        self.alone = jax.jit(lambda forks, choice: self._verdict(self._alone(forks, choice)))

    def fork(self, fork: Fork, choice: Choice) -> Fork:
        """Return a fork that goes on with a choice; traced by JAX."""
        raise NotImplementedError

    def _course(self, features: Mapping[str, Any], key: Any) -> Fork:
        """Return all forks of the undisturbed simulation."""
        return self.problem.system.forks(features, key)

    def _trace(self, forks: Fork, first: Any, choice: Choice) -> Trace:
        fork = self.fork(forks.at(choice.start * self.period), choice)
        return self.system.go_on(fork, first)

    def _alone(self, forks: Fork, choice: Choice) -> Trace:
        return self._trace(forks, 0, choice)

    def _verdict(self, trace: Trace) -> Any:
        verdict = trace_verdict(self.problem, trace)
        return (*verdict, boolean_semantics(self.problem, trace)), trace

    def _judged(self, forks: Fork, first: Int[Array, ""], choice: Choice) -> Any:
        return self._verdict(self._trace(forks, first, choice))[0]

    def _objective(self, forks: Fork, first: Any, choice: Choice, temperature: Any) -> Any:
        trace = self._trace(forks, first, choice)
        return jnp.min(trace_verdict(self.problem, trace, smooth(temperature))[0])


class Controls(Means):
    """Any actions between the lowest and the highest, by default those that the system names."""

    who, ends = "the controller", True

    def __init__(
        self, problem: Problem, length: int, dt: float, actions: tuple[Any, Any] | None
    ) -> None:
        super().__init__(problem, problem.system.with_links((Steering(),)))
        passing = problem.system.passing(problem.space.feature_form)
        forms = jax.tree.leaves(passing.action)
        size = sum(form.size for form in forms)
        whole = [not jnp.issubdtype(form.dtype, jnp.floating) for form in forms]
        given = passing.bounds if actions is None else actions
        if given is None:
            raise ValueError(
                f"the actions in problem {problem.name!r} have no bounds, so nothing would be "
                "unavoidable: give actions=(lowest, highest)"
            )
        try:
            ends = (np.concatenate(list(map(np.ravel, jax.tree.leaves(end)))) for end in given)
            self.low, self.high = (np.broadcast_to(end.astype(float), size) for end in ends)
            fits = np.isfinite([self.low, self.high]).all() and np.all(self.low < self.high)
        except (TypeError, ValueError):
            fits = False
        if not fits or any(whole) != all(whole):
            raise ValueError(
                f"actions must be a pair (lowest, highest) of finite numbers for {size} entries, "
                f"all real or all whole; got {given!r}"
            )
        counts = (self.high - self.low + 1).astype(int).tolist()
        self.levels = tuple(counts) if all(whole) else (0,) * size
        self.period = round(passing.period / dt)
        self.shape = -(-(length - 1) // self.period), size
        self.advance = jax.jit(jax.vmap(self._advance, in_axes=(None, None, 0, 0)))

    def actions(self, numbers: Any, xp: Any = jnp) -> Any:
        width = self.high - self.low
        if self.levels[0]:
            return self.low + xp.floor(xp.minimum(numbers * (width + 1), width))
        return xp.clip(self.low + numbers * width, self.low, self.high)

    def fork(self, fork: Fork, choice: Choice) -> Fork:
        plan = choice.start, self.actions(choice.numbers), choice.stop
        return fork._replace(features={**fork.features, PLAN: plan})

    def _course(self, features: Mapping[str, Any], key: Any) -> Fork:
        never = jnp.int32(self.shape[0] + 1)
        plan = never, jnp.zeros(self.shape), never
        return self.system.forks({**features, PLAN: plan}, key)._replace(features=features)

    def _alone(self, forks: Fork, choice: Choice) -> Trace:
        # From the start, without a fork.
        return self.system(self.fork(forks, choice).features, forks.key)

    def own(self, forks: Fork) -> Float[np.ndarray, "decisions entries"]:
        """Return the actions of the policy in the undisturbed simulation."""
        return np.asarray(forks.state.links[0])[1 :: self.period]

    def _advance(self, forks: Fork, decision: Any, state: Any, numbers: Any) -> Any:
        """Return the state one decision later with all extremes so far, and their robustness."""
        plan = Choice(jnp.int32(0), jnp.broadcast_to(numbers, self.shape), decision + 1)
        rollout = self.system.rollout(self.fork(forks, plan).features, forks.key)
        loop, low, high = state
        for k in range(self.period):
            loop, signals = rollout.sample(loop, decision * self.period + k)
            low = jax.tree.map(jnp.minimum, low, signals)
            high = jax.tree.map(jnp.maximum, high, signals)
        extremes = Trace(jax.tree.map(lambda *ends: jnp.stack(ends), low, high), dt=rollout.dt)
        return (loop, low, high), jnp.min(trace_verdict(self.problem, extremes)[0])


class Surroundings(Means):
    """Other values of some features, by default of all that vary, from an instant on."""

    who = "the environment"

    def __init__(self, problem: Problem, names: tuple[str, ...]) -> None:
        super().__init__(problem, problem.system)
        domains, whole = problem.space.domains, problem.space
        check_names("feature", names, domains)
        chosen = names or [name for name, domain in domains.items() if domain.size]
        self.space = space = FeatureSpace({name: domains[name] for name in chosen})
        self.levels, self.shape = space.levels, (1, space.dim)
        # The constraint speaks of all features.
        self.constraint = whole.constraint if space.dim == whole.dim else None

    def fork(self, fork: Fork, choice: Choice) -> Fork:
        changed = self.space.unflatten(choice.numbers[0].astype(jnp.float32))
        return fork._replace(features={**fork.features, **changed})


class OtherPolicy(Means):
    """Another policy: a system that differs in its policy alone."""

    who = "the other policy"

    def __init__(self, problem: Problem, other: System) -> None:
        super().__init__(problem, other)
        form, key = problem.space.feature_form, jax.random.key(0)
        one, two = (
            str(jax.eval_shape(lambda f, s=system: s.rollout(f, key).start.plant, form))
            for system in (problem.system, other)
        )
        if one != two:
            raise ValueError(
                "by must be a system that differs from the problem's in its policy alone; its "
                f"state has the form {two}, and the problem's {one}"
            )

    def fork(self, fork: Fork, choice: Choice) -> Fork:
        start = self.system.rollout(fork.features, fork.key).start
        return fork._replace(state=start._replace(plant=fork.state.plant, age=fork.state.age))
