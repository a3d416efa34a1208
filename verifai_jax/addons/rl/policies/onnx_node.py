"""One operation of a graph of ONNX, with the functions that all operators use."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from verifai_jax.addons.rl.policies.errors import PolicyError

Value: TypeAlias = Array
"""A value of a graph; a NumPy array, with the same operations, if it needs no observation."""


@dataclass(frozen=True, eq=False)
class Node:
    """One operation of a graph.

    - `operator`, `name`: operator and name in the file.
    - `inputs`, `outputs`: names of values; an omitted input is empty.
    - `attributes`: plain values, arrays, and subgraphs as `(nodes, outputs)`.
    - `opset`: version of the operators.
    """

    operator: str
    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]
    opset: int

    def __str__(self) -> str:
        return f"node {self.name!r} ({self.operator})"

    def get(self, name: str, default: Any) -> Any:
        """Return an attribute, or its default."""
        return self.attributes.get(name, default)

    def refuse(self, what: object, why: str) -> None:
        """Raise `PolicyError` for attributes that are not supported here."""
        if np.any(what):  # pyright: ignore[reportArgumentType, reportCallIssue]
            raise PolicyError(f"{self} {why}")


def known(*values: Value | None) -> bool:
    """Return whether values are independent of the observation: they are NumPy arrays."""
    return all(isinstance(v, np.ndarray | np.generic) for v in values)


def module(*values: Value) -> Any:
    """Return NumPy if all values are its arrays, otherwise `jax.numpy`."""
    return np if known(*values) else jnp


def static(node: Node, value: Value) -> tuple[int, ...]:
    """Return concrete numbers for a shape, axes or indices.

    **Raises:** `PolicyError` if they depend on the observation.
    """
    node.refuse(not known(value), "has a shape that depends on the observation")
    return tuple(int(n) for n in np.ravel(value))


def static_axes(node: Node, given: Value | None) -> tuple[int, ...] | None:
    """Return axes, an attribute in old operator sets and an input in new ones."""
    if given is not None:
        return static(node, given) or None
    axes = node.get("axes", None)
    return None if axes is None else tuple(axes)
