"""The optimizer of all training algorithms: Adam with a constant or linearly falling rate.

optimizer = adam(max_gradient=0.5)
rate = annealed(1e-3, done, updates, enabled=True)
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from jaxtyping import Array, Int, PyTree

from verifai_jax.addons.rl.algorithm import Number

EPSILON = 1e-5
"""Adam's constant against division by zero, as PPO and its successors set it."""


@runtime_checkable
class Optimizer(Protocol):
    """An optimizer with the functions of `optax.GradientTransformation`."""

    @property
    def init(self) -> Callable[[PyTree], PyTree]:
        """A function from weights to the optimizer's state."""
        ...

    @property
    def update(self) -> Callable[..., tuple[PyTree, PyTree]]:
        """A function from a gradient and a state to a direction and the next state."""
        ...


def adam(max_gradient: Number | None = None) -> Optimizer:
    """Make Adam with rate 1, with gradients clipped to the norm `max_gradient` if it is given."""
    import optax

    if max_gradient is None:
        return optax.scale_by_adam(eps=EPSILON)
    return optax.chain(
        optax.clip_by_global_norm(max_gradient),  # pyright: ignore[reportArgumentType]
        optax.scale_by_adam(eps=EPSILON),
    )


def annealed(rate: Number, done: Int[Array, ""], updates: Int[Array, ""], enabled: bool) -> Number:
    """Return the learning rate after `done` of `updates` updates.

    It falls linearly from `rate` to 0 if `enabled`, and otherwise stays `rate`.
    """
    left = 1.0 - done * (1.0 / updates) if enabled else 1.0
    return rate * left
