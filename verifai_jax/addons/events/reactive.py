"""Adversaries that see signals during the run (`Reactive`), varied through their parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from verifai_jax.addons.events.reaction import Reaction, parameter_count
from verifai_jax.core.messages.checks import is_number
from verifai_jax.features.box import Box
from verifai_jax.features.domain import Domain, Row

Inputs = Mapping[str, tuple[float, float]] | Sequence
"""Names of signals, or their ranges by name."""


@dataclass(frozen=True, init=False)
class Reactive(Domain):
    """An adversary that sees signals during the run: `Reactive({"gap": (0, 60)}, bounds=(-3, 3))`.

    A value is a `Reaction`, which a system calls with the present signals:
    `features["brake"](gap=gap, v=v)`. Its parameters are the coordinates. So a search finds how to
    react to signals, whereas a `Signal` depends on time only.

    **Arguments:**
    - `inputs`: signal -> `(low, high)`, its usual range, which is scaled to -1 to 1; or names of
      signals that have this size already.
    - `hidden`: number of hidden tanh units of a network; 0 for an affine function.
    - `bounds`: the bounds of the output.
    - `scale`: weights and biases are uniform from `-scale` to `scale`.
    **Raises:** `ValueError` for no inputs, invalid ranges or bounds, a negative number of hidden
    units, or a scale that is not positive.
    """

    arguments = ("inputs", "hidden", "bounds", "scale")
    inputs: tuple[tuple[str, float, float], ...]
    hidden: int
    bounds: tuple[float, float]
    scale: float

    def __init__(
        self, inputs: Inputs, hidden: int = 0, bounds: Sequence[float] = (-1.0, 1.0),
        scale: float = 3.0,
    ) -> None:  # fmt: skip
        entries = [inputs] if isinstance(inputs, str) else inputs
        if isinstance(entries, Mapping):
            entries = [(name, *_range(name, ends)) for name, ends in entries.items()]
        named = [(each, -1.0, 1.0) if isinstance(each, str) else tuple(each) for each in entries]
        names = [name for name, *_ in named]
        if not named or len(set(names)) < len(names):
            raise ValueError(f"inputs must be names of signals, each once; got {inputs!r}")
        if isinstance(hidden, bool) or not isinstance(hidden, int | np.integer) or hidden < 0:
            raise ValueError(f"hidden must be a number of units, 0 or more; got {hidden!r}")
        if not (is_number(scale) and 0 < scale < np.inf):
            raise ValueError(f"scale must be a positive number; got {scale!r}")
        object.__setattr__(
            self, "inputs", tuple((name, float(low), float(high)) for name, low, high in named)
        )
        object.__setattr__(self, "hidden", int(hidden))
        object.__setattr__(self, "bounds", _range("the output", bounds))
        object.__setattr__(self, "scale", float(scale))

    @cached_property
    def _box(self) -> Box:
        count = parameter_count(len(self.inputs), self.hidden)
        return Box([-self.scale] * count, [self.scale] * count)

    @property
    def levels(self) -> tuple[int, ...]:
        return self._box.levels

    def from_unit(self, u: Float[Array, " size"]) -> Reaction:
        return self._reaction(self._box.from_unit(u))

    def to_unit(self, value: Reaction) -> Float[Array, " size"]:
        return self._box.to_unit(jnp.asarray(value.parameters))

    def coerce(self, value: PyTree) -> Reaction:
        """Convert a `Reaction`, or a list of its parameters, layer by layer."""
        parameters = value.parameters if isinstance(value, Reaction) else value
        return self._reaction(self._box.coerce(parameters))

    def check(self, value: object, name: str) -> None:
        if isinstance(value, Reaction):
            same = (value.inputs, value.hidden, value.bounds)
            if same != (self.inputs, self.hidden, self.bounds):
                raise ValueError(f"{name} must be a reaction of {self!r}; got {value!r}")
            value = value.parameters
        self._box.check(value, name)

    def columns(self, name: str) -> tuple[str, ...]:
        return self._box.columns(name)

    def labels(self, name: str, duration: float | None = None) -> tuple[str, ...]:
        if self.hidden:
            return self.coordinates(name)
        weights = tuple(f"{name} by {signal}" for signal, _, _ in self.inputs)
        return (*weights, f"{name} at the middle")

    def to_columns(self, values: Reaction, name: str) -> dict[str, np.ndarray]:
        return self._box.to_columns(np.asarray(values.parameters), name)

    def from_columns(self, row: Row, name: str) -> Reaction:
        return self._reaction(self._box.from_columns(row, name))

    def _reaction(self, parameters: Float[Array, "*n size"]) -> Reaction:
        return Reaction(parameters, self.inputs, self.hidden, self.bounds)

    def __repr__(self) -> str:
        plain = all((low, high) == (-1.0, 1.0) for _, low, high in self.inputs)
        ranges = {name: (low, high) for name, low, high in self.inputs}
        inputs = tuple(ranges) if plain else ranges
        low, high = self.bounds
        return (
            f"Reactive({inputs!r}, hidden={self.hidden}, bounds=({low:zg}, {high:zg}), "
            f"scale={self.scale:zg})"
        )


def _range(name: str, ends: object) -> tuple[float, float]:
    if isinstance(ends, tuple | list) and len(ends) == 2 and all(map(is_number, ends)):
        low, high = float(ends[0]), float(ends[1])
        if -np.inf < low < high < np.inf:
            return low, high
    raise ValueError(f"the range of {name} must be (low, high) with low < high; got {ends!r}")
