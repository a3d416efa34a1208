"""The memory of a graph of ONNX: which outputs are the next values of which inputs.

    memory_of(nodes, inputs, outputs, None, None, "lstm.onnx")      # {"h": "h_out", "c": "c_out"}

A pair is known by the ports of a recurrent node, by its names, or from the user; never by its shape
alone.
"""

import re
from collections.abc import Mapping, Sequence

from verifai_jax.addons.rl.policies.errors import PolicyError
from verifai_jax.addons.rl.policies.onnx_node import Node
from verifai_jax.core.messages.errors import check_names

Shapes = Mapping[str, tuple[int, ...]]
Stated = Mapping[str, str] | None
"""The memory that a user states, `{input: output}`; None to find it."""
_STATES = {"LSTM": ((5, 1), (6, 2)), "GRU": ((5, 1),), "RNN": ((5, 1),)}
"""Of each recurrent operator, the ports of its initial and its last states."""
_PASSES = {
    "Cast", "Concat", "Expand", "Flatten", "Gather", "Identity", "Reshape", "Slice", "Split",
    "Squeeze", "Transpose", "Unsqueeze",
}  # fmt: skip
"""Operators that pass values on without computing with them."""
_SIDES = re.compile(
    r"\b(ins?|outs?|input|output|next|new|prev|previous|old|last|init|initial|current|after|n|0|1)\b"
)
"""Words in which the names of a value and of its next value differ."""
_KNOWN = re.compile(r"action|mu|mean|logit|value|critic|prob|entropy|std|sigma|neglogp")
"""Parts of the names of outputs that are the actor's or the critic's, and no memory."""


def memory_of(
    nodes: Sequence[Node], shapes: Sequence[Shapes], stated: Stated, action: str | None, what: str
) -> dict[str, str]:
    """Return the memory of a graph, the output with the next value by input.

    **Arguments:**
    - `shapes`: those of inputs and of outputs by name, in the order of the graph; () if unknown.
    - `action`: the output that the user has chosen as the action; None for none.
    **Raises:** `PolicyError` for a pair of two shapes, and for inputs that may be memory.
    """
    inputs, outputs = shapes
    pairs = _by_ports(nodes, inputs, outputs, what) if stated is None else dict(stated)
    check_names("input of the network", pairs, inputs)
    check_names("output of the network", pairs.values(), outputs)
    left = [o for o in outputs if o not in pairs.values() and o != action]
    left = [o for o in left if not _KNOWN.search(o.lower())] if stated is None else []
    # The first input is the observation, unless a port shows that it is a state.
    for one in [i for i in list(inputs)[1:] if i not in pairs]:
        named = [o for o in left if _plain(o) == _plain(one) and o not in pairs.values()]
        if len(named) == 1 and len(pairs) < len(outputs) - 1:
            pairs[one] = named[0]
    for one, after in pairs.items():
        if inputs[one] != outputs[after] and outputs[after]:
            raise PolicyError(
                f"the memory {one!r} of {what} has shape {list(inputs[one])}, and its next value "
                f"{after!r} {list(outputs[after])}: state what is remembered by memory="
            )
    others = [o for o in left if o not in pairs.values()]
    for one in [i for i in inputs if i not in pairs][1:]:
        likely = [o for o in others if inputs[one] == outputs[o] and o != next(iter(outputs))]
        if likely:
            raise PolicyError(
                f"the input {one!r} of {what} may be an observation, or a memory whose next value "
                f"is {' or '.join(map(repr, likely))}: say memory={{{one!r}: {likely[0]!r}}}, with "
                "all that is remembered, or memory={} if nothing is"
            )
    return {one: pairs[one] for one in inputs if one in pairs}


def _plain(name: str) -> str:
    """Return a name without what tells a value from its next one."""
    words = re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower()
    words = re.sub(r"(?<![a-z])([hc]x?|hidden|cell|state)([01n])(?![a-z0-9])", r"\1 \2", words)
    return "_".join(re.findall(r"[a-z0-9]+", _SIDES.sub(" ", re.sub(r"[^a-z0-9]", " ", words))))


def _by_ports(nodes: Sequence[Node], inputs: Shapes, outputs: Shapes, what: str) -> dict[str, str]:
    """Return the pairs that recurrent nodes show: origins of states, and where their last go."""
    made = {name: node for node in nodes for name in node.outputs if name}
    pairs: dict[str, str] = {}
    for node in nodes:
        for before, after in _STATES.get(node.operator, ()):
            begins, ends = (*node.inputs, *[""] * 7)[before], (*node.outputs, *[""] * 3)[after]
            origins = _within(begins, made) & inputs.keys()
            goals = {o for o in outputs if ends and ends in _within(o, made)}
            if len(goals) > 1:
                goals = {o for o in goals if outputs[o] in map(inputs.get, origins)}
            for one in origins if goals else ():
                if len(origins) > 1 or len(goals) > 1 or pairs.get(one, min(goals)) != min(goals):
                    raise PolicyError(
                        f"{node} of {what} has a memory that is read from "
                        f"{', '.join(sorted(origins))} and goes to {', '.join(sorted(goals))}: "
                        "say which is which by memory={input: output}"
                    )
                pairs[one] = min(goals)
    return pairs


def _within(name: str, made: Mapping[str, Node]) -> set[str]:
    """Return the values that a value consists of, passed on unchanged, with itself."""
    found: set[str] = set()
    left = [name]
    while left:
        node = made.get(one := left.pop())
        if one not in found and node is not None and node.operator in _PASSES:
            # Further inputs are shapes and indices.
            left += node.inputs if node.operator == "Concat" else node.inputs[:1]
        found.add(one)
    return found
