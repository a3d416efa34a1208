"""Policies of one structure: their weights are arguments of one compiled program.

    group_policies(policies)        # [PolicyGroup(numbers=(0, 2, 3), ...), ...]
    digest(policy)                  # what names a policy in a memo: a hash of its arrays

Hidden layers are padded with units of zero weight, so that policies of different widths share a
program. The padded width depends on the policy alone, so its results do not depend on the other
policies. Padding is exact in real arithmetic, since activations are 0 at 0; in float32 the padded
sums may round differently from the policy's own.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from verifai_jax.addons.rl import Policy
from verifai_jax.core.compute.compilation import power_of_two

MIN_WIDTH = 64
"""Hidden layers up to this width share a program; wider ones go to the next power of two."""


@dataclass(frozen=True, eq=False)
class PolicyGroup:
    """Policies that one program can simulate.

    - `numbers`: their indices in the given list.
    - `weights`: the padded policies, with NumPy leaves, in that order.
    - `structure`: their common structure, as text.
    - `traced`: False for a policy that is not a pytree of numbers and stays as it is.
    """

    numbers: tuple[int, ...]
    weights: tuple[Any, ...]
    structure: str
    traced: bool = True


def group_policies(policies: Sequence[Any]) -> list[PolicyGroup]:
    """Sort policies by structure, in the order in which the structures first appear."""
    found: dict[str, tuple[list[int], list[Any], bool]] = {}
    for number, policy in enumerate(policies):
        traced = is_numeric(policy)
        whole = padded(policy) if traced else policy
        structure = structure_of(whole) if traced else f"policy {number}"
        numbers, weights, _ = found.setdefault(structure, ([], [], traced))
        numbers.append(number)
        weights.append(whole)
    return [
        PolicyGroup(tuple(numbers), tuple(weights), structure, traced)
        for structure, (numbers, weights, traced) in found.items()
    ]


def is_numeric(policy: Any) -> bool:
    """Check that a policy consists only of numbers, which JAX can take as arguments."""
    leaves = jax.tree.leaves(policy)
    plain = (np.ndarray, np.generic, jax.Array, int, float)
    return bool(leaves) and all(isinstance(leaf, plain) for leaf in leaves)


def padded(policy: Any) -> Any:
    """Return a policy with NumPy leaves and hidden layers padded to the shared width."""
    policy = jax.tree.map(_on_host, policy)
    if not isinstance(policy, Policy):
        return policy
    layers = []
    last = len(policy.layers) - 1
    for i, (weight, bias) in enumerate(policy.layers):
        rows, columns = np.shape(weight)
        more = (
            0 if i == 0 else shared_width(rows) - rows,
            0 if i == last else shared_width(columns) - columns,
        )
        layers.append((np.pad(weight, ((0, more[0]), (0, more[1]))), np.pad(bias, (0, more[1]))))
    return replace(policy, layers=tuple(layers))


def shared_width(width: int) -> int:
    """Return the width that a hidden layer of `width` units is padded to."""
    return max(MIN_WIDTH, power_of_two(width))


def structure_of(policy: Any) -> str:
    """Return a text that is equal for policies that one program can simulate."""
    leaves, form = jax.tree.flatten(policy)
    shapes = [f"{np.dtype(leaf.dtype).str}{list(np.shape(leaf))}" for leaf in leaves]
    return f"{form} {' '.join(shapes)}"


def digest(policy: Any, number: int = 0) -> str:
    """Hash a policy's structure and numbers, or its index if it has no numbers."""
    if not is_numeric(policy):
        return f"policy-{number}"
    policy = jax.tree.map(_on_host, policy)
    digest = hashlib.sha256(structure_of(policy).encode())
    for leaf in jax.tree.leaves(policy):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:32]


def _on_host(leaf: Any) -> np.ndarray:
    array = np.asarray(leaf)
    # As JAX would take it, in the precision of simulations.
    kinds: dict[str, Any] = {"f": np.float32, "i": np.int32, "u": np.uint32}
    return array.astype(kinds.get(array.dtype.kind, array.dtype))
