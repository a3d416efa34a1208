"""Operators of `ai.onnx.ml`: trees, linear models, and what scales their inputs.

Source: the ONNX specification, `docs/Operators-ml.md`, up to operator set 5, and for two classes
with one score ONNX Runtime, since the specification leaves open what their scores are.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from verifai_jax.addons.rl.policies.onnx_node import Node, Value, cast

DOMAIN = "ai.onnx.ml"
_GOES: dict[str, Callable[[Array, Array], Array]] = {
    "BRANCH_LEQ": jnp.less_equal, "BRANCH_LT": jnp.less, "BRANCH_GTE": jnp.greater_equal,
    "BRANCH_GT": jnp.greater, "BRANCH_EQ": jnp.equal, "BRANCH_NEQ": jnp.not_equal,
}  # fmt: skip
"""Conditions under which the true branch of a node of a tree is taken."""


def _labels(node: Node) -> np.ndarray:
    """Return the labels of classes; of those with words, their numbers."""
    for name in ("classlabels_int64s", "classlabels_ints"):
        if node.get(name, ()):
            return np.asarray(node.attributes[name])
    return np.arange(len(node.get("classlabels_strings", ())))


def _transformed(node: Node, scores: Array) -> Array:
    """Return scores after the transformation that a node says."""
    kind = node.get("post_transform", "NONE")
    known = ("NONE", "SOFTMAX", "LOGISTIC", "SOFTMAX_ZERO")
    node.refuse(kind not in known, f"has post_transform={kind!r}, which is not supported")
    if kind == "LOGISTIC":
        return jax.nn.sigmoid(scores)
    if kind.startswith("SOFTMAX"):
        zero = scores == 0 if kind == "SOFTMAX_ZERO" else jnp.zeros(scores.shape, bool)
        # A score of exactly zero is none, but counts in the total.
        return jnp.where(zero, 0.0, jax.nn.softmax(scores, axis=-1))
    return scores


def _classified(node: Node, scores: Array, are_chances: bool = False) -> tuple[Array, Array]:
    """Return labels and scores, also where the only score is that of the second of two classes."""
    labels = _labels(node)
    if scores.shape[-1] == 1 and len(labels) == 2:
        second = scores[:, 0] > (0.5 if are_chances else 0.0)
        scores = jnp.concatenate([1 - scores if are_chances else -scores, scores], axis=-1)
        scores = scores if are_chances else _transformed(node, scores)
        return jnp.asarray(labels)[second.astype(int)], scores
    node.refuse(scores.shape[-1] != len(labels), "has another number of labels than of scores")
    return jnp.asarray(labels)[jnp.argmax(scores, axis=-1)], _transformed(node, scores)


def _leaves(node: Node, x: Array, kind: str) -> tuple[Array, np.ndarray]:
    """Return the leaf `[batch, tree]` that each tree ends in, and the index of each leaf's weight.

    Every tree takes as many steps as the deepest one; a leaf is its own successor.
    """
    count = len(node.attributes["nodes_nodeids"])

    def get(name: str) -> list[Any]:
        return list(node.get(f"nodes_{name}", ()) or [0] * count)

    keys = list(zip(get("treeids"), get("nodeids"), strict=True))
    rows: dict[Any, int] = {key: index for index, key in enumerate(keys)}
    modes, own = get("modes"), np.arange(count)
    leaf = np.array([mode == "LEAF" for mode in modes])
    odd = sorted({*modes} - {*_GOES, "LEAF"})
    node.refuse(bool(odd), f"has nodes of the kind {odd[:1]}, which is not supported")
    features, missing = np.asarray(get("featureids")), np.asarray(get("missing_value_tracks_true"))
    node.refuse(len(rows) != count, "has two nodes of one number in a tree")
    node.refuse(np.any((features < 0) | (features >= x.shape[-1]) & ~leaf),
                f"has a feature beyond the {x.shape[-1]} of an observation")  # fmt: skip
    after = []
    for name in ("falsenodeids", "truenodeids"):
        to = [rows.get((t, n)) for (t, _), n in zip(keys, get(name), strict=True)]
        node.refuse(any(n is None and not e for n, e in zip(to, leaf, strict=True)),
                    "has a branch to a node that is not there")  # fmt: skip
        after.append(np.where(leaf, own, [n or 0 for n in to]))
    roots = np.setdiff1d(own, np.concatenate([a[~leaf] for a in after]))
    depth, front, reached = 0, roots, np.isin(own, roots)
    while not leaf[front].all() and depth <= count:
        depth, front = depth + 1, np.unique(np.concatenate([a[front] for a in after]))
        reached[front] = True
    odd = depth > count or not reached.all() or len(roots) != len({tree for tree, _ in keys})
    node.refuse(odd, "has a tree that leads back to itself, or is in parts")
    values = jnp.asarray(np.asarray(get("values"), np.float32))
    at = jnp.broadcast_to(jnp.asarray(roots), (len(x), len(roots)))
    kinds = {mode: jnp.asarray([each == mode for each in modes]) for mode in {*modes} & {*_GOES}}
    features = jnp.asarray(np.where(leaf, 0, features))
    for _ in range(depth):
        seen, limit = jnp.take_along_axis(x, features[at], axis=1), values[at]
        goes = jnp.isnan(seen) & (jnp.asarray(missing)[at] != 0)
        for mode, which in kinds.items():
            goes |= which[at] & _GOES[mode](seen, limit)
        at = jnp.where(goes, jnp.asarray(after[1])[at], jnp.asarray(after[0])[at])
    ids = zip(node.attributes[f"{kind}_treeids"], node.attributes[f"{kind}_nodeids"], strict=True)
    where = [rows.get(key) for key in ids]
    node.refuse(any(index is None for index in where), "has a weight of a node that is not there")
    return at, np.asarray(where)


def _trees(node: Node, x: Value, kind: str, columns: int) -> Array:
    """Return the sums, means or extremes of the leaves of all trees, `[batch, column]`."""
    x = jnp.asarray(cast(x, float))
    at, where = _leaves(node, x, kind)
    ids, how = np.asarray(node.attributes[f"{kind}_ids"]), node.get("aggregate_function", "SUM")
    node.refuse(np.any((ids < 0) | (ids >= columns)), f"has a weight of no {kind}")
    table = np.zeros((len(node.attributes["nodes_nodeids"]), columns), np.float32)
    np.add.at(table, (where, ids), np.asarray(node.attributes[f"{kind}_weights"], np.float32))
    node.refuse(how not in ("SUM", "AVERAGE", "MIN", "MAX"), f"has aggregate_function={how!r}")
    join = {"SUM": jnp.sum, "AVERAGE": jnp.mean, "MIN": jnp.min, "MAX": jnp.max}[how]
    found = join(jnp.asarray(table)[at], axis=1)
    base = np.asarray(node.get("base_values", ()) or [0.0], np.float32)
    return found + base


def tree_regressor(node: Node, x: Value) -> Array:
    """Return the targets of an ensemble of trees."""
    found = _trees(node, x, "target", int(node.get("n_targets", 1)))
    return _transformed(node, found)


def tree_classifier(node: Node, x: Value) -> tuple[Array, Array]:
    """Return the labels and the scores of an ensemble of trees."""
    ids, count = set(node.attributes["class_ids"]), len(_labels(node))
    if count != 2 or len(ids) > 1:
        return _classified(node, _trees(node, x, "class", count))
    found = _trees(node, x, "class", max(ids) + 1)[:, -1:]
    return _classified(node, found, min(node.attributes["class_weights"]) >= 0)


def _linear(node: Node, x: Value, rows: int) -> Array:
    weights = np.asarray(node.attributes["coefficients"], np.float32)
    odd = rows < 1 or weights.size != rows * x.shape[-1]
    node.refuse(odd, f"has {weights.size} coefficients for {x.shape[-1]} features")
    shift = np.asarray(node.get("intercepts", ()) or [0.0], np.float32)
    return cast(x, float) @ weights.reshape(rows, -1).T + shift


def linear_regressor(node: Node, x: Value) -> Array:
    """Return the targets of a linear model."""
    return _transformed(node, _linear(node, x, int(node.get("targets", 1))))


def linear_classifier(node: Node, x: Value) -> tuple[Array, Array]:
    """Return the labels and the scores of a linear model."""
    rows = len(node.attributes["coefficients"]) // x.shape[-1]
    return _classified(node, _linear(node, x, rows))


def _scaler(node: Node, x: Value) -> Array:
    offset, scale = (np.asarray(node.get(name, ()) or [usual], np.float32)
                     for name, usual in (("offset", 0.0), ("scale", 1.0)))  # fmt: skip
    return (cast(x, float) - offset) * scale


def _normalizer(node: Node, x: Value) -> Array:
    x, norm = jnp.asarray(cast(x, float)), node.get("norm", "MAX")
    if norm == "L1":
        size = jnp.sum(jnp.abs(x), axis=-1, keepdims=True)
    elif norm == "L2":
        size = jnp.sqrt(jnp.sum(x * x, axis=-1, keepdims=True))
    else:
        size = jnp.max(x, axis=-1, keepdims=True)
    return x / jnp.where(size == 0, 1.0, size)


def _imputer(node: Node, x: Value) -> Array:
    odd = not node.get("imputed_value_floats", ())
    node.refuse(odd, "replaces whole numbers, which is not supported")
    gone = node.get("replaced_value_float", 0.0)
    missing = jnp.isnan(x) if math.isnan(gone) else x == gone
    return jnp.where(missing, np.asarray(node.attributes["imputed_value_floats"], np.float32), x)


OPERATORS: dict[str, Callable[..., Any]] = {
    "TreeEnsembleRegressor": tree_regressor, "TreeEnsembleClassifier": tree_classifier,
    "LinearRegressor": linear_regressor, "LinearClassifier": linear_classifier,
    "Scaler": _scaler, "Normalizer": _normalizer, "Imputer": _imputer,
    "Binarizer": lambda node, x: (x > node.get("threshold", 0.0)).astype(x.dtype),
    "ArrayFeatureExtractor": lambda node, x, index: jnp.take(
        jnp.atleast_2d(x), jnp.ravel(index), axis=-1
    ),
    # A list of dictionaries by class; here the scores remain an array.
    "ZipMap": lambda node, scores: scores,
}  # fmt: skip
"""The operators, by name."""
