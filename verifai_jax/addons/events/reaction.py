"""Reactions to signals: the values of a `Reactive` feature, called by a system during the run.

push = features["push"]
push(x=state.x, v=state.v)                          # or push(x, v): a number within bounds
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from verifai_jax.core.messages.errors import check_names

Number = Real[Array | np.ndarray, ""] | float
"""A number of Python, NumPy or JAX."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Reaction:
    """A small network, or an affine function, from signals to a bounded number.

    - `parameters`: weights and biases, layer by layer, `[size]`.
    - `inputs`: name, low and high of each signal, which is scaled from that range to -1 to 1.
    - `hidden`: number of hidden units; 0 for an affine function.
    - `bounds`: the bounds of the output, enforced by a hyperbolic tangent.
    """

    # JAX rebuilds the class with placeholders and with batches, which have other shapes.
    __no_type_check__ = True
    parameters: Float[Array | np.ndarray, " size"]
    inputs: tuple[tuple[str, float, float], ...] = field(metadata={"static": True})
    hidden: int = field(metadata={"static": True})
    bounds: tuple[float, float] = field(metadata={"static": True})

    def __call__(self, *values: Number, **named: Number) -> Number:
        """Return the reaction to signals, in the order of `inputs` or by their names.

        **Raises:** `ValueError` for unknown or missing signals.
        """
        names = [name for name, _, _ in self.inputs]
        check_names("input", named, names)
        given = dict(zip(names, values, strict=False)) | named
        if len(values) > len(names) or len(given) < len(values) + len(named):
            raise ValueError(f"a reaction takes {', '.join(names)}, each once")
        missing = [name for name in names if name not in given]
        if missing:
            raise ValueError(f"a reaction to {', '.join(names)} needs {', '.join(missing)} too")
        # A simulator on the host asks at every step: JAX op by op would take a millisecond each.
        plain = all(isinstance(value, float | int | np.number) for value in given.values())
        xp: Any = np if isinstance(self.parameters, np.ndarray) and plain else jnp
        scaled = xp.stack(
            [
                (xp.asarray(given[name]) - (low + high) / 2) * (2 / (high - low))
                for name, low, high in self.inputs
            ]
        )
        count, parameters = len(names), xp.asarray(self.parameters)
        if self.hidden:
            first = parameters[: self.hidden * count].reshape(self.hidden, count)
            biases = parameters[self.hidden * count :][: self.hidden]
            scaled = xp.tanh(first @ scaled + biases)
        last = parameters[-(len(scaled) + 1) :]
        low, high = self.bounds
        return low + (high - low) * (1 + xp.tanh(last[:-1] @ scaled + last[-1])) / 2

    def __repr__(self) -> str:
        names = ", ".join(name for name, _, _ in self.inputs)
        kind = f"{self.hidden} hidden units" if self.hidden else "affine"
        low, high = self.bounds
        return f"Reaction({names}; {kind}, from {low:zg} to {high:zg})"


def parameter_count(inputs: int, hidden: int) -> int:
    """Return the number of weights and biases."""
    return (inputs + 1) * hidden + hidden + 1 if hidden else inputs + 1
