"""A system given by its step between two samples: its own solver, its own state machine.

    Stepped(initial, advance, signals, dt=0.01, steps=3000, nominal={"throttle": 50.0})

The benchmark models prescribe solvers, and let discrete logic run at instants of its own, which
`vj.ode` does not offer.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PyTree

from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.core.values.waveform import set_durations
from verifai_jax.systems.base import Carry, Seed, System
from verifai_jax.systems.checkpointing import checkpointed_scan
from verifai_jax.systems.ode.integrators import check_factor

Features = Mapping[str, Any]
Scalar = Float[Array, ""]


@dataclass(frozen=True, eq=False)
class Stepped(System):
    """A system `(features, key) -> Trace` with a sample at time 0 and after each of `steps`.

    **Arguments:**

    - `initial(features) -> state`: any pytree of numbers and truth values.
    - `advance(k, state, features) -> state`: from sample `k` to the next.
    - `signals(k, state, features) -> dict`: a number for each name, at sample `k`.
    - `dt`: the sampling period in seconds.
    - `nominal`: the features that the model has, with their values where they are not given.
    - `finer(factor) -> Stepped`: the same model with so many times as many integration steps; None
      where there is nothing to integrate: the step belongs to the model (`exact_step`).
    - `traced_factor`: whether `finer` takes a factor that JAX traces, so that one program replays
      at every step; see `repeated`.

    The status of the trace is `NONFINITE` if the last state is NaN or infinite; a model must not
    recover from such a state.
    """

    initial: Callable[[Features], Any]
    advance: Callable[[Int[Array, ""], Any, Features], Any]
    signals: Callable[[Int[Array, ""], Any, Features], dict[str, Any]]
    dt: float = field()
    steps: int
    nominal: Features = field(default_factory=dict)
    finer: Callable[[int], "Stepped"] | None = None
    traced_factor: bool = False

    @property
    def duration(self) -> float:
        """Simulated seconds."""
        return self.steps * self.dt

    @property
    def exact_step(self) -> bool:
        """True for a model without an integration: no finer step simulates it."""
        return self.finer is None

    def refined(self, factor: int) -> "Stepped":
        """Return the same model, sampled and decided as before, at a `factor` times smaller step.

        **Raises:** `ValueError` for a factor that is not a positive integer, and for a model whose
        step belongs to it.
        """
        if self.finer is None:
            raise ValueError("the step belongs to this model, which integrates nothing")
        if not (self.traced_factor and isinstance(factor, jax.Array)):
            check_factor(factor)
        return self.finer(factor)

    def check(self, features: Features) -> None:
        """Refuse features that the model does not have; it would ignore them."""
        check_names("feature", features, self.nominal)

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        """Simulate once; nothing is random."""
        last, _, samples = self._run(features, None, lambda _, sample: (None, sample))
        return Trace(samples, dt=self.dt, status=_status(last))

    def fold(
        self,
        features: Features,
        key: Seed,
        carry: Carry,
        update: Callable[[Carry, dict[str, Array]], Carry],
    ) -> tuple[Carry, Int[Array, ""]]:
        """Simulate, and let `carry = update(carry, sample)` take in each sample; none is stored."""
        last, carry, _ = self._run(features, carry, lambda c, sample: (update(c, sample), None))
        return carry, _status(last)

    def _run(
        self,
        features: Features,
        collected: PyTree,
        collect: Callable[[PyTree, dict[str, Array]], tuple[PyTree, PyTree]],
    ) -> tuple[Any, Any, Any]:
        self.check(features)
        features = set_durations({**self.nominal, **features}, self.duration)

        # A gradient's way back takes each step again instead of storing what is within it: a
        # quarter faster where a step has stages, and quicker to compile.
        advance = jax.checkpoint(self.advance, prevent_cse=False)

        def sample(carry: PyTree, k: Int[Array, ""]) -> Any:
            state, collected = carry
            collected, output = collect(collected, self.signals(k, state, features))
            following = advance(k, state, features)
            # One iteration more than there are steps samples the last state and stays there: it
            # costs less than appending one sample to all others.
            state = jax.tree.map(lambda a, b: jnp.where(k < self.steps, a, b), following, state)
            return (state, collected), output

        start = (self.initial(features), collected)
        (last, collected), outputs = checkpointed_scan(sample, start, self.steps + 1)
        return last, collected, outputs


def value(feature: Callable[[Any], Any] | ArrayLike, time: Scalar | float) -> Any:
    """Return a feature at a time, be it a function of time or a number."""
    return feature(time) if callable(feature) else jnp.asarray(feature, real())


def real() -> Any:
    """Return the floating type of this process: double where JAX's x64 is on."""
    return jnp.result_type(float)


def repeated(step: Callable[[Any, Any], Any], state: PyTree, count: int | Int[Array, ""]) -> Any:
    """Apply `state = step(j, state)` for `j` below `count`.

    JAX may trace the count; then there is no derivative in reverse mode.
    """
    if isinstance(count, int) and count == 1:
        return step(0, state)
    return jax.lax.fori_loop(0, count, step, state)


def whole(seconds: float, dt: float, name: str) -> int:
    """Return the number of periods of `dt` in `seconds`.

    **Raises:** `ValueError`, naming the argument, unless it is a whole number of at least 1.
    """
    steps = round(seconds / dt) if math.isfinite(seconds) else 0
    if steps < 1 or abs(steps * dt - seconds) > 1e-6 * dt:
        raise ValueError(f"{name} must be a positive multiple of {dt:g} s; got {seconds!r}")
    return steps


def _status(last: PyTree) -> Int[Array, ""]:
    finite = jnp.array(True)
    for leaf in jax.tree.leaves(last):
        if jnp.issubdtype(leaf.dtype, jnp.inexact):
            finite &= jnp.all(jnp.isfinite(leaf))
    return jnp.where(finite, jnp.int32(Status.OK), jnp.int32(Status.NONFINITE))
