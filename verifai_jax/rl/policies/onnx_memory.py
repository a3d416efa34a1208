"""The memory of a graph of ONNX: which outputs are the next values of which inputs.

    memory_of(nodes, inputs, outputs, None, None, "lstm.onnx")      # {"h": "h_out", "c": "c_out"}

A pair is known by the ports of a recurrent node, by its names, or from the user; never by its shape
alone.
"""

import re
from collections.abc import Iterable, Mapping, Sequence

from verifai_jax.core.messages.errors import check_names
from verifai_jax.rl.policies.errors import PolicyError
from verifai_jax.rl.policies.onnx_node import Node

Shapes = Mapping[str, tuple[int, ...]]
_STATES = {"LSTM": ((5, 1), (6, 2)), "GRU": ((5, 1),), "RNN": ((5, 1),)}
"""Of each recurrent operator, the ports of its initial and its last states."""
_PASSES = frozenset((
    "Cast", "Concat", "Expand", "Flatten", "Gather", "Identity", "Reshape", "Slice", "Split",
    "Squeeze", "Transpose", "Unsqueeze",
))  # fmt: skip
"""Operators that pass values on without computing with them."""
_SIDES = re.compile(
    r"(?<![a-z])(in|out|input|output|next|new|prev|previous|old|last|init|initial|current|after|"
    r"before|n|0|1|tm1|t|ins|outs)(?![a-z0-9])"
)
"""Words in which the names of a value and of its next value differ."""
_KNOWN = re.compile(r"action|mu|mean|logit|value|critic|prob|entropy|std|sigma|neglogp")
"""Parts of the names of outputs that are the actor's or the critic's, and no memory."""


def memory_of(
    nodes: Sequence[Node],
    inputs: Shapes,
    outputs: Shapes,
    stated: Mapping[str, str] | None,
    action: str | None,
    what: str,
) -> dict[str, str]:
    """Return the memory of a graph, the output with the next value by input.

    **Arguments:**
    - `nodes`: the nodes, in the order of computation.
    - `inputs`, `outputs`: shapes by name, in the order of the graph.
    - `stated`: the memory that the user states; None to find it.
    - `action`: the output that the user has chosen as the action; None for none.
    **Raises:** `PolicyError` for pairs of two shapes, and for values that may be memory.
    """
    if stated is not None:
        check_names("input of the network", stated, inputs)
        check_names("output of the network", stated.values(), outputs)
        pairs = dict(stated)
        twice = {one for one in pairs.values() if list(pairs.values()).count(one) > 1}
        if twice:
            raise PolicyError(f"memory= gives the output {min(twice)!r} to several inputs")
    else:
        pairs = _by_ports(nodes, inputs, outputs, what)
        names: dict[str, list[str]] = {}
        for name in outputs:
            if name not in pairs.values() and name != action and not _KNOWN.search(name.lower()):
                names.setdefault(_plain(name), []).append(name)
        # The first input is the observation, unless a port shows that it is a state.
        for one in (i for i in list(inputs)[1:] if i not in pairs):
            found = [o for o in names.get(_plain(one), ()) if _same(inputs[one], outputs[o])]
            if len(found) == 1 and len(pairs) < len(outputs) - 1:
                pairs[one] = found[0]
    for one, after in pairs.items():
        if not _same(inputs[one], outputs[after]):
            raise PolicyError(
                f"the memory {one!r} of {what} has shape {list(inputs[one])}, and its next value "
                f"{after!r} {list(outputs[after])}"
            )
    if stated is None:
        _check_ambiguity(pairs, inputs, outputs, action, what)
    return {one: pairs[one] for one in inputs if one in pairs}


def _check_ambiguity(
    pairs: Mapping[str, str], inputs: Shapes, outputs: Shapes, action: str | None, what: str
) -> None:
    """Refuse inputs that may be memory: an output that nothing else explains has their shape."""
    left = [o for o in outputs if o not in pairs.values() and o != action]
    left = [o for o in left[action is None :] if not _KNOWN.search(o.lower())]
    for one in [one for one in inputs if one not in pairs][1:]:
        likely = [o for o in left if inputs[one] and inputs[one] == outputs[o]]
        if likely:
            raise PolicyError(
                f"the input {one!r} of {what} may be an observation, or a memory whose next value "
                f"is {' or '.join(map(repr, likely))}: say memory={{{one!r}: {likely[0]!r}}}, with "
                "all that is remembered, or memory={} if nothing is"
            )


def _same(one: tuple[int, ...], other: tuple[int, ...]) -> bool:
    # A graph need not state the shape of an output.
    return not other or one == other


def _plain(name: str) -> str:
    """Return a name without what tells a value from its next one."""
    words = re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower()
    words = re.sub(r"([a-z])([0-9n])$", r"\1_\2", words) if len(words) == 2 else words
    words = re.sub(r"(h|c|hx|cx|hidden|cell|state)([01n])(?=$|_)", r"\1_\2", words)
    return "_".join(re.findall(r"[a-z0-9]+", _SIDES.sub(" ", words.replace("_", " "))))


def _by_ports(nodes: Sequence[Node], inputs: Shapes, outputs: Shapes, what: str) -> dict[str, str]:
    """Return the pairs that recurrent nodes show: the origin of a state, and where its last goes.

    **Raises:** `PolicyError` for a state that goes to several outputs, or comes from several
    inputs.
    """
    made = {name: node for node in nodes for name in node.outputs if name}
    pairs: dict[str, str] = {}
    for node in nodes:
        for before, after in _STATES.get(node.operator, ()):
            begins = node.inputs[before] if len(node.inputs) > before else ""
            ends = node.outputs[after] if len(node.outputs) > after else ""
            origins = _within(begins, made) & inputs.keys()
            goals = {o for o in outputs if ends and ends in _within(o, made)}
            if len(goals) > 1:
                goals = {o for o in goals if any(_same(inputs[i], outputs[o]) for i in origins)}
            if not origins or not goals:
                continue
            pair = [*sorted(origins), *sorted(goals)]
            if len(pair) > 2 or pairs.get(pair[0], pair[1]) != pair[1]:
                raise PolicyError(
                    f"{node} of {what} has a memory that is read from "
                    f"{', '.join(sorted(origins))} and goes to {', '.join(sorted(goals))}: say "
                    "which is which by memory={input: output}"
                )
            pairs[pair[0]] = pair[1]
    return pairs


def _within(name: str, made: Mapping[str, Node]) -> set[str]:
    """Return the values that a value consists of, passed on unchanged, with itself."""
    found: set[str] = set()
    left = [name]
    while left:
        one = left.pop()
        if one in found:
            continue
        found.add(one)
        node = made.get(one)
        if node is not None and node.operator in _PASSES:
            left += _data(node)
    return found


def _data(node: Node) -> Iterable[str]:
    """Return the inputs of a node whose values it passes on; not shapes and indices."""
    return node.inputs if node.operator == "Concat" else node.inputs[:1]
