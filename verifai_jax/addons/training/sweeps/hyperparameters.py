"""Hyper-parameters as plain Python values: conversion from points, and values for checks.

values_at(space, points)                            # [{"learning_rate": 0.001, "width": 64}, ...]
probe_values(space.domains["width"])                # [(16, "a choice"), (64, "a choice")]
"""

from collections.abc import Mapping
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Float

from verifai_jax.features import FeatureSpace
from verifai_jax.features.domain import Domain

Hyperparameters: TypeAlias = dict[str, Any]
"""Plain Python values of hyper-parameters, by name."""
_MAX_PROBES = 64
"""Maximum number of choices that are all checked; of larger domains only the ends are."""
_COMPANIONS = 16
"""Points of the space at which a value is tried before it is refused."""
_CHUNK = 32
"""Points that are converted at a time, so that one shape compiles."""


def values_at(space: FeatureSpace, points: Float[np.ndarray, "n dim"]) -> list[Hyperparameters]:
    """Return the hyper-parameters at points of the unit cube, as plain Python values.

    Strings stay strings, and choices of a `Categorical` that are numbers stay as given; real
    numbers are rounded to float32, which a training uses.
    """
    points = np.asarray(points, np.float32)
    values: list[Hyperparameters] = []
    for start in range(0, len(points), _CHUNK):
        some = points[start : start + _CHUNK]
        padded = np.pad(some, ((0, _CHUNK - len(some)), (0, 0)), mode="edge")
        values += values_of_features(space, space.features_at(padded))[: len(some)]
    return values


def values_of_features(space: FeatureSpace, features: Mapping[str, Any]) -> list[Hyperparameters]:
    """Return the hyper-parameters in features with leaves `[n]`, as plain Python values."""
    columns = space.rows(jax.tree.map(np.asarray, features))
    count = len(np.ravel(next(iter(jax.tree.leaves(features)))))
    values: list[Hyperparameters] = [{} for _ in range(count)]
    for name, domain in space.domains.items():
        texts = {str(choice): choice for choice in getattr(domain, "choices", ())}
        for i in range(count):
            # A constant has no column.
            value = columns[name][i] if domain.columns(name) else domain.held_at
            value = value.item() if isinstance(value, np.generic) else value
            values[i][name] = texts.get(value, value) if isinstance(value, str) else value
    return values


def probe_values(domain: Domain) -> list[tuple[Any, str]]:
    """Return choices or ends of a domain to check, each with a description of its position."""
    if not domain.columns("value"):
        return [(domain.held_at, "the value")]
    if (tuning := domain.tuning) is not None:
        if 0 < len(tuning.choices) <= _MAX_PROBES:
            return [(choice, "a choice") for choice in tuning.choices]
        if not tuning.choices:
            low, high = tuning.low, tuning.high
            few = tuning.scale == "integer" and np.ndim(low) == 0 and high - low < _MAX_PROBES
            inner = [(value, "a value") for value in range(low + 1, high)] if few else []
            return [(low, "the lower end"), *inner, (high, "the upper end")]
    space = FeatureSpace({"value": domain})
    if not domain.size:
        return [(values_at(space, np.zeros((1, 0)))[0]["value"], "the value")]
    ends = [row["value"] for row in values_at(space, np.array([[0.0], [1.0]]))]
    return [(ends[0], "the lower end"), (ends[1], "the upper end")]


def companions(space: FeatureSpace) -> list[Hyperparameters]:
    """Return hyper-parameters from all over the space, the middle first, to check one value."""
    rng = np.random.default_rng(0)
    # A constraint may make values possible that are rare without it.
    count = _COMPANIONS if space.where is None else 16 * _COMPANIONS
    points = np.concatenate([np.full((1, space.dim), 0.5), rng.random((count, space.dim))])
    return values_at(space, points)
