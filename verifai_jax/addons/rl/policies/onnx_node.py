"""One operation of a graph of ONNX, with the functions that all operators use."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from verifai_jax.addons.rl.policies.errors import PolicyError

Value: TypeAlias = Array
"""A value of a graph; a NumPy array, with the same operations, if it needs no observation."""
TYPES: dict[int, Any] = {
    1: float, 2: np.uint8, 3: np.int8, 4: np.uint16, 5: np.int16, 6: np.int32, 7: np.int64,
    9: np.bool_, 10: np.float16, 11: float, 12: np.uint32, 13: np.uint64, 16: jnp.bfloat16,
}  # fmt: skip
"""Types by their numbers in ONNX. Float and double are both the caller's working precision."""


@dataclass(frozen=True, eq=False)
class Node:
    """One operation of a graph: its operator and name in the file; the names of its inputs, empty
    if omitted, and outputs; attributes, which are plain values, arrays, and subgraphs `(nodes,
    outputs)`; the version of the operators; `wide`, whether its first output is declared as 64-bit
    integers.
    """

    operator: str
    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]
    opset: int
    wide: bool = False

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


def whole(value: Value) -> bool:
    """Return whether values are whole numbers."""
    return jnp.issubdtype(value.dtype, jnp.integer)


def cast(value: Value, kind: Any) -> Any:
    """Return values as another type, one of `TYPES`.

    Real numbers beyond the range of whole ones become what processors of x86 make of them in C.
    """
    if kind is float or kind in (np.float32, np.float64):
        if known(value):
            return np.asarray(value, np.float32)
        # The working precision is the caller's.
        return value if value.dtype in (np.float32, np.float64) else value.astype(float)
    kind = np.dtype(kind) if known(value) else jax.dtypes.canonicalize_dtype(kind)
    if kind.kind in "iu" and not (whole(value) or value.dtype == bool):
        xp, inside = module(value), abs(value) < 2.0**31
        wrapped = xp.where(inside, value, -(2.0**31)).astype(np.int32).astype(kind)
        large = kind.itemsize == 8 or kind == np.uint32
        return xp.where(inside, wrapped, value.astype(kind)) if large else wrapped
    return value.astype(kind)


def like(made: Value, x: Value) -> Any:
    """Return a result as the type of an input."""
    return made if made.dtype == x.dtype else cast(made, x.dtype)


def fitting(what: object, value: Value) -> Value:
    """Return values for JAX without 64 bits; refuse whole numbers that would be changed."""
    kind = jax.dtypes.canonicalize_dtype(value.dtype) if known(value) else None
    if kind in (np.int32, np.uint32) and np.any(changed := value != value.astype(kind)):
        raise PolicyError(
            f"{what} has whole numbers beyond {kind}, such as {value[changed].ravel()[0]}: export "
            "the model with smaller ones, or start Python with JAX_ENABLE_X64=1"
        )
    return value


def static(node: Node, value: Value) -> tuple[int, ...]:
    """Return concrete numbers for a shape or indices, which no observation may change."""
    node.refuse(not known(value), "has a shape that depends on the observation")
    return tuple(int(n) for n in np.ravel(value))


def static_axes(node: Node, given: Value | None) -> tuple[int, ...] | None:
    """Return axes, an attribute in old operator sets and an input in new ones."""
    if given is not None:
        return static(node, given) or None
    axes = node.get("axes", None)
    return None if axes is None else tuple(axes)
