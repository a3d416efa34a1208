"""The closed loop that `ode` makes: its simulation step by step."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree

from verifai_jax.core.user_code.user_errors import defined_at
from verifai_jax.core.values.trace import Status
from verifai_jax.core.values.waveform import set_durations, within_step
from verifai_jax.systems.base import Features, Seed, System
from verifai_jax.systems.channels import Channels, Link, Passing, States, first_refusal
from verifai_jax.systems.checkpointing import checkpointed_scan
from verifai_jax.systems.delays import joined
from verifai_jax.systems.forks import LoopState, Rollout
from verifai_jax.systems.ode.delay_line import DelayLine
from verifai_jax.systems.ode.integrators import (
    Integrator,
    Step,
    Time,
    check_factor,
    edge,
    integrator,
)
from verifai_jax.systems.ode.switching import Inputs, Switch, switched_step
from verifai_jax.systems.pytree_checks import (
    as_floating,
    as_precise_as,
    check_like,
    check_signals,
    default_signals,
    in_working_precision,
    outline,
)


@dataclass(frozen=True, eq=False)
class Ode(System):
    """A closed loop `(features, key) -> Trace`; made by `ode`, which documents its parts.

    - `substeps`: integration steps between two samples; more than one in a `refined` loop.
    - `exact_step`: whether the step is part of the plant, so that the loop has no finer one.
    """

    traced_factor: ClassVar[bool] = True
    dynamics: Callable[..., Any]
    initial: Callable[..., Any]
    controller: Callable[..., Any] | None
    controller_memory: Any
    dt: float = field()
    steps: int
    steps_per_control: int
    method: str | Integrator
    signals: Callable[..., Mapping[str, Any]] | None
    terminate: Callable[..., Any] | None
    unroll: int
    substeps: Any = 1
    exact_step: bool = False
    update: Callable[..., Any] | None = None
    switches: tuple[Switch, ...] = ()
    links: tuple[Link, ...] = ()

    @property
    def duration(self) -> float:
        """Duration of a simulation in seconds."""
        return self.steps * self.dt

    def refined(self, factor: int | Int[Array, ""]) -> "Ode":
        """Return the same loop with a finer step; samples, decisions and end keep their times.

        An odd number of steps is divided differently between each two samples, so that nothing
        periodic has the same phase in all of them. JAX may trace the factor; the loop then has no
        reverse-mode derivative.

        **Raises:** `ValueError` unless the factor is a positive integer, and for a loop with
        `exact_step`.
        """
        if self.exact_step:
            raise ValueError(
                "the step belongs to this system (exact_step=True), so a finer one would simulate "
                "another; for a plant whose step is an approximation, give exact_step=False"
            )
        if not isinstance(factor, jax.Array):
            check_factor(factor)
        return replace(self, substeps=self.substeps * factor)

    def rollout(self, features: Features, key: Seed = None) -> Rollout:
        """Return one simulation; `features` and `key` reach the functions of `ode` as they are.

        Only a waveform without a duration is given that of the simulation.
        """
        features = set_durations(features, self.duration)
        start = as_floating(self.initial(features, key), "initial")
        return _Rollout(self, features, key).from_state(start)

    def check(self, features: Features) -> None:
        """Refuse features that a fault cannot read."""
        for link in self.links:
            link.check(features)

    def why_error(self, features: Features) -> str | None:
        """Return a message that names a fault with an invalid number."""
        return first_refusal(self.links, features, "this system")

    def passing(self, features: Features) -> Passing:
        """Return the controller's input, the state, and its output.

        **Raises:** `ValueError` for a plant without a controller.
        """
        if self.controller is None:
            raise ValueError(
                "faults act between a plant and its controller; this system has no controller"
            )

        def first(features: Features, key: Seed) -> Any:
            features = set_durations(features, self.duration)
            state = as_floating(self.initial(features, key), "initial")
            memory = in_working_precision(self.controller_memory)
            return state, _Rollout(self, features, key).decided(state, memory)

        key = jax.eval_shape(lambda: jax.random.key(0))
        state, control = jax.eval_shape(first, features, key)
        period = self.dt * self.steps_per_control
        return Passing(state, control, period, self.duration)

    def held_signals(self, features: Features) -> tuple[str, ...]:
        """Return the names of the signals that are parts of the control."""
        if self.controller is None:
            return ()
        held: list[str] = []

        def look(features: Features, key: Seed) -> None:
            features = set_durations(features, self.duration)
            state = as_floating(self.initial(features, key), "initial")
            rollout = _Rollout(self, features, key)
            control = rollout.decided(state, in_working_precision(self.controller_memory))
            signals = rollout.signals(jnp.zeros((), _dtype(state)), state, control)
            parts = jax.tree.leaves(control)
            held.extend(n for n, v in signals.items() if any(v is part for part in parts))

        jax.eval_shape(look, features, jax.eval_shape(lambda: jax.random.key(0)))
        return tuple(held)

    def with_links(self, links: tuple[Link, ...]) -> "Ode":
        return replace(self, links=joined(self.links, links))


@contextlib.contextmanager
def _explaining_no_control(
    role: str, function: Callable[..., Any] | None, control: object
) -> Iterator[None]:
    try:
        yield
    except TypeError as error:
        if control is None and "NoneType" in str(error):
            raise ValueError(
                f"{role} computes with a control, which is None without controller=: "
                f"{error}{defined_at(function)}"
            ) from error
        raise


@dataclass(frozen=True, eq=False)
class _Rollout:
    """One simulation of a closed loop: the values that its steps share while JAX traces them."""

    loop: Ode
    features: Any
    key: Any = None

    @property
    def channels(self) -> Channels:
        """The links of states to the controller, and of controls from it."""
        return Channels(self.loop.links, self.loop.dt * self.loop.steps_per_control, self.features)

    def decided(self, state: PyTree, memory: PyTree) -> Any:
        """Return the control at time 0, without faults."""
        assert self.loop.controller is not None
        arguments = (state,) if self.loop.controller_memory is None else (state, memory)
        made = self.loop.controller(jnp.zeros((), _dtype(state)), *arguments, self.features)
        return made if self.loop.controller_memory is None else made[0]

    def states(self, state: PyTree, memory: PyTree) -> States:
        """Return what delays and faults remember at first."""
        if not self.loop.links:
            return ()
        form = jax.eval_shape(self.decided, state, memory)
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), form)
        return self.channels.begin(state, nothing, self.key)

    def from_state(self, start: PyTree) -> Rollout:
        """Return the simulation as a loop from a state on."""
        loop, memory = self.loop, in_working_precision(self.loop.controller_memory)
        finite = self.check(start, memory)

        def sample(carry: LoopState, k: Int[Array, ""]) -> Any:
            state, age, known = carry.plant, carry.age, (carry.memory, carry.links)
            time, frozen = self.clock(k, age, state)
            control, (own, links) = self.decide(k, age, time, frozen, state, known, carry.held)
            signals = self.signals(time, state, control)
            next_state = self.step(time, self.safe_state(frozen, state, start), control)
            next_state = updated(loop, time + loop.dt, next_state, self.features)
            applied = None if carry.held is None else control
            following = (next_state, own, applied, age + 1)
            # The links know of the end themselves: a long line of past values is not copied for it.
            unchanged = (state, carry.memory, applied, age)
            state, own, applied, age = _where(frozen, unchanged, following)
            return LoopState(state, own, links, age, applied), signals

        # A controller that runs at every sample holds nothing between samples.
        held = None
        links = self.states(start, memory)
        if loop.steps_per_control > 1:
            time = jnp.zeros((), _dtype(start))
            form = jax.eval_shape(self.control, time, jnp.array(False), start, (memory, links))[0]
            held = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), form)
        # One sample more than there are steps: the last one moves nothing, which is cheaper than
        # copying all samples to append one.
        return Rollout(
            LoopState(start, memory, links, jnp.int32(0), held), sample, loop.steps + 1, loop.dt,
            lambda last: _status(last.plant, self.channels.valid()), loop.terminate is not None,
            finite, partial(checkpointed_scan, unroll=loop.unroll),
        )  # fmt: skip

    def decide(
        self, k: Int[Array, ""], age: Int[Array, ""], time: Time, frozen: Bool[Array, ""],
        state: PyTree, memory: PyTree, held: PyTree,
    ) -> Any:  # fmt: skip
        """Return the control from sample `k` on, and the controller's memory then."""
        if held is None:
            return self.control(time, frozen, state, memory)
        # The counter is common to all lanes of a batch, so this stays a branch under `vmap`.
        control, next_memory = jax.lax.cond(
            k % self.loop.steps_per_control == 0,
            lambda: self.control(time, frozen, state, memory),
            lambda: (held, memory),
        )
        if self.loop.terminate is None:
            return control, next_memory
        # What has ended earlier keeps the control that it ended with.
        own, states = next_memory
        control, own = _where(age < k, (held, memory[0]), (control, own))
        return control, (own, states)

    def clock(
        self, k: Int[Array, ""], age: Int[Array, ""], state: PyTree
    ) -> tuple[Time, Bool[Array, ""]]:
        """Return the time in seconds at sample `k`, and True where the state stays from here on."""
        over = k >= self.loop.steps
        if self.loop.terminate is None:
            return k.astype(_dtype(state)) * self.loop.dt, over
        # Time stops with the state: whatever the signals depend on, the samples after the end
        # repeat the last valid one.
        ended = self.loop.terminate(state, self.features)
        return age.astype(_dtype(state)) * self.loop.dt, over | ended

    def safe_state(self, frozen: Bool[Array, ""], state: PyTree, start: PyTree) -> Any:
        """Return a state at which the dynamics may be evaluated.

        A frozen state may lie where the dynamics have no finite derivative (an emptied tank), and
        in reverse mode zero times infinity would poison the gradient of the part that counts.
        """
        return state if self.loop.terminate is None else _where(frozen, start, state)

    def control(
        self, time: Time, frozen: Bool[Array, ""], state: PyTree, memory: PyTree
    ) -> tuple[Any, Any]:
        loop = self.loop
        own, states = memory
        if loop.controller is None:
            return None, memory
        seen, states = self.channels.observation(states, state, time, frozen)
        if loop.controller_memory is None:
            control = loop.controller(time, seen, self.features)
        else:
            control, after = loop.controller(time, seen, own, self.features)
            own = as_precise_as(after, own)
        control, states = self.channels.action(states, control, time, frozen)
        return control, (own, states)

    def signals(self, time: Time, state: PyTree, control: PyTree) -> Any:
        if self.loop.signals is None:
            return default_signals(state, control)
        return self.loop.signals(time, state, control, self.features)

    def step(self, time: Time, state: PyTree, control: PyTree) -> Any:
        """Integrate from one sample to the next."""
        count = self.loop.substeps
        if isinstance(count, int) and count == 1:
            return substep(self.loop, self.features, control, time, state, self.loop.dt)
        time = jnp.asarray(time, _dtype(state))

        def advance(j: Int[Array, ""], state: PyTree) -> Any:
            begin, end = (edge(time, self.loop.dt, count, at) for at in (j, j + 1))
            return substep(self.loop, self.features, control, time + begin, state, end - begin)

        return jax.lax.fori_loop(0, count, advance, state)

    def check(self, state: PyTree, memory: PyTree) -> tuple[str, ...]:
        """Refuse functions that do not fit together; abstract evaluation, nothing compiles.

        **Returns:** the signals that are parts of the state, whose finiteness is the state's.
        """
        loop = self.loop
        time = jnp.zeros((), _dtype(state))
        if loop.method == "semi_implicit_euler" and not _is_pair(state):
            raise ValueError(
                "method 'semi_implicit_euler' needs a state that is a tuple "
                f"(positions, velocities); got {outline(state)}"
            )
        control = None
        if loop.controller is not None:
            if loop.controller_memory is None:
                control = jax.eval_shape(loop.controller, time, state, self.features)
            else:
                decided = jax.eval_shape(loop.controller, time, state, memory, self.features)
                role = "(control, memory), its memory in the form of controller_memory"
                note = defined_at(loop.controller)
                if not _is_pair(decided):
                    raise ValueError(f"controller must return {role}; got {outline(decided)}{note}")
                control = decided[0]
                check_like(decided[1], memory, "controller", role, note, same_precision=False)
            if control is None:
                raise ValueError(
                    "controller must return the control; it returned None, as without a return "
                    f"statement{defined_at(loop.controller)}"
                )
        with _explaining_no_control("dynamics", loop.dynamics, control):
            derivative = jax.eval_shape(
                lambda control: loop.dynamics(time, state, control, self.features), control
            )
        role, note = "the state's derivative, in the form of the state", defined_at(loop.dynamics)
        check_like(derivative, state, "dynamics", role, note, same_precision=False)
        role = "a state, in the form of the state"
        self._check_lines(
            state, loop.dt, "dt, at which update pushes it", fed=loop.update is not None
        )
        if memory is not None:
            period = loop.dt * loop.steps_per_control
            self._check_lines(
                memory, period, "the control period, at which the controller pushes it"
            )
        if loop.update is not None:
            after = jax.eval_shape(loop.update, time, state, self.features)
            check_like(after, state, "update", role, defined_at(loop.update), same_precision=False)
        for switch in loop.switches:
            after = jax.eval_shape(switch.reset, time, state, self.features)
            where = defined_at(switch.reset)
            check_like(after, state, "reset of a Switch", role, where, same_precision=False)
            guard = jax.eval_shape(switch.guard, time, state, self.features)
            if getattr(guard, "shape", None) != () or not jnp.issubdtype(guard.dtype, jnp.floating):
                raise ValueError(
                    f"guard of a Switch must return one real number; got {outline(guard)}"
                    f"{defined_at(switch.guard)}"
                )
        parts, finite = jax.tree.leaves(state), []

        def sample_signals(control: PyTree) -> Any:
            signals = self.signals(time, state, control)
            if isinstance(signals, Mapping):
                finite.extend(n for n, v in signals.items() if any(v is part for part in parts))
            return signals

        with _explaining_no_control("signals", loop.signals, control):
            sampled = jax.eval_shape(sample_signals, control)
        check_signals(sampled)
        if loop.terminate is not None:
            ended = jax.eval_shape(loop.terminate, state, self.features)
            if getattr(ended, "shape", None) != () or ended.dtype != jnp.bool_:
                raise ValueError(
                    f"terminate must return one truth value; got {outline(ended)}"
                    f"{defined_at(loop.terminate)}"
                )
        return tuple(finite)

    def _check_lines(self, tree: PyTree, beat: float, what: str, fed: bool = True) -> None:
        """Refuse delay lines that are not fed once a period: they would be late by another time."""
        is_line = lambda leaf: isinstance(leaf, DelayLine)  # noqa: E731
        for line in filter(is_line, jax.tree.leaves(tree, is_leaf=is_line)):
            if not fed:
                raise ValueError(
                    "a delay_line in the state needs update=, which pushes it at each sample; got "
                    "none"
                )
            count = round(line.period / beat)
            if count < 1 or abs(count * beat - line.period) > 1e-6 * beat:
                raise ValueError(
                    f"the period of a delay_line must be {what} ({beat:zg} s), or a multiple of it "
                    f"where it is not pushed each time; got period={line.period:zg}"
                )


def substep(
    loop: Ode, features: Features, control: PyTree, begin: Time, state: PyTree, dt: Step
) -> Any:
    """Take one integration step of a loop from `begin` on, including its switches."""

    def dynamics(now: Time, state: PyTree, inputs: Inputs) -> Any:
        control, features = inputs
        rates = loop.dynamics(now, state, control, within_step(features, begin, now))
        return as_precise_as(rates, state)

    advance = integrator(loop.method)
    inputs = (control, features)
    return switched_step(advance, dynamics, begin, state, dt, loop.switches, inputs)


def updated(loop: Ode, time: Time, state: PyTree, features: Features) -> Any:
    """Return the state after the updates at a sample."""
    if loop.update is None:
        return state
    # What is not finite stays so: an update may not hide it.
    finite = jnp.array(True)
    for leaf in jax.tree.leaves(state):
        finite &= jnp.all(jnp.isfinite(leaf))
    after = loop.update(time, state, features)
    after = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), after, state)
    return _where(finite, after, state)


def _status(last: PyTree, valid: Bool[Array, ""] | bool = True) -> Int[Array, ""]:
    # Integrators add to the state, and NaN or Inf plus anything is never finite again: if the last
    # state is finite, all were. A state frozen at its end is covered by the same check.
    finite = jnp.array(True)
    for leaf in jax.tree.leaves(last):
        finite &= jnp.all(jnp.isfinite(leaf))
    status = jnp.where(finite, jnp.int32(Status.OK), jnp.int32(Status.NONFINITE))
    return status if valid is True else jnp.where(valid, status, jnp.int32(Status.ERROR))


def _where(condition: Bool[Array, ""], yes: PyTree, no: PyTree) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _dtype(state: PyTree) -> Any:
    return jax.tree.leaves(state)[0].dtype


def _is_pair(value: object) -> bool:
    return isinstance(value, tuple) and len(value) == 2
