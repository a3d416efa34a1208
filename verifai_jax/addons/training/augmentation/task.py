"""A supervised task with labelled inputs made from features, for augmentation.

    task = SupervisedTask("rings", space, render, label, train, predict, wrongness)
    task.problem(weights)                   # where does this network err? for every search

Inputs need not be images: an input may be anything that the network accepts.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree

from verifai_jax.core.compute.precision import truncate_silently
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.user_code.user_errors import defined_at, explain_user_error
from verifai_jax.core.values.trace import Trace
from verifai_jax.falsification.table import RESERVED
from verifai_jax.features import Domain, FeatureSpace
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import System

Features: TypeAlias = PyTree
"""The features of one input, as `FeatureSpace.unflatten` gives them; or of a batch."""
Weights: TypeAlias = PyTree
"""The weights of a network, or what else `train` returns."""
Inputs: TypeAlias = PyTree
"""Inputs of a network, each leaf with a leading axis `[n]`; mostly one array."""
Labels: TypeAlias = PyTree
"""Labels of inputs, each leaf with a leading axis `[n]`."""
Transformation: TypeAlias = Callable[[Inputs, Labels, Key[Array, ""]], tuple[Inputs, Labels]]
"""A transformation of labelled inputs that keeps the labels true, or corrects them."""
MARGIN = "margin"
"""Signal of the problem of a network: minus the wrongness."""
_RESERVED = (*RESERVED, "arm", "seed", "wrongness")
"""Names of columns of results, which no feature may have."""
_FUNCTIONS = ("render", "label", "train", "predict", "wrongness")
"""Functions that every task has."""


class TaskError(ValueError):
    """An error for a task whose parts do not fit together."""


@dataclass(frozen=True, eq=False)
class SupervisedTask:
    """A network to train, and labelled inputs that are rendered from features.

    **Arguments:**
    - `name`: the name in results.
    - `space`: a `FeatureSpace` or dictionary of domains of all inputs that the network should
      handle.
    - `render`: a function from features to one input.
    - `label`: a function from features to the input's label, which needs no manual labelling.
    - `train`: `(inputs, labels, weights, steps, key) -> weights`: performs this many training steps
      from these weights, or from initial ones if they are None. A plain Python function, which may
      compile its own code; inputs and labels are NumPy arrays with a leading axis `[n]`.
    - `predict`: `(weights, inputs) -> predictions`, all with a leading axis `[n]`.
    - `wrongness`: `(prediction, label) -> number` for one input: positive if the prediction is
      wrong, and larger for worse errors, for example minus a margin. A number instead of a verdict
      lets a search learn and follow gradients.
    - `present`, `detected`: label -> whether there is something to find, prediction -> whether it
      was found; with both, precision and recall are measured.
    - `transform`: `(inputs, labels, key) -> (inputs, labels)`, the usual augmentation of existing
      inputs; `verifai_jax.addons.training.augmentation` has some for images.
    - `training_space`: the space of the initial set, if it is not `space`: with the same features,
      in narrower domains or under a constraint.
    - `measures`: further numbers of a trained network by name, `(weights, key) -> number`, such as
      the failure rate of a closed loop.
    - `lanes`: number of inputs that are rendered together.
    - `black_box`: True if render, label, predict, wrongness, present and detected are plain Python
      that JAX cannot trace; they then receive NumPy arrays, and searches work without gradients.
    **Raises:** `TaskError` for an empty name, a part that is not a function, spaces that do not
    fit, or a feature with the name of a column of results.
    """

    name: str
    space: FeatureSpace
    render: Callable[[Features], Any]
    label: Callable[[Features], Any]
    train: Callable[[Inputs, Labels, Weights | None, int, Key[Array, ""]], Weights]
    predict: Callable[[Weights, Inputs], Any]
    wrongness: Callable[[Any, Any], Any]
    present: Callable[[Any], Any] | None = None
    detected: Callable[[Any], Any] | None = None
    transform: Transformation | None = None
    training_space: FeatureSpace | None = None
    measures: Mapping[str, Callable[[Weights, Key[Array, ""]], float]] = field(default_factory=dict)
    lanes: int = 16
    black_box: bool = False

    def __init__(
        self, name: str, space: FeatureSpace | Mapping[str, Domain],
        render: Callable[[Features], Any], label: Callable[[Features], Any],
        train: Callable[[Inputs, Labels, Weights | None, int, Key[Array, ""]], Weights],
        predict: Callable[[Weights, Inputs], Any], wrongness: Callable[[Any, Any], Any],
        present: Callable[[Any], Any] | None = None, detected: Callable[[Any], Any] | None = None,
        transform: Transformation | None = None,
        training_space: FeatureSpace | Mapping[str, Domain] | None = None,
        measures: Mapping[str, Callable[[Weights, Key[Array, ""]], float]] | None = None,
        lanes: int = 16, black_box: bool = False,
    ) -> None:  # fmt: skip
        if not isinstance(name, str) or not name.strip():
            raise TaskError(f"a supervised task needs a name; got {name!r}")
        values: dict[str, Any] = {
            "name": name, "space": _as_space("space", space), "render": render, "label": label,
            "train": train, "predict": predict, "wrongness": wrongness, "present": present,
            "detected": detected, "transform": transform, "training_space": training_space,
            "measures": dict(measures or {}), "lanes": check_count("lanes", lanes, error=TaskError),
            "black_box": bool(black_box),
        }  # fmt: skip
        taken = next((name for name in values["space"].columns if name in _RESERVED), None)
        if taken is not None:
            raise TaskError(
                f"a feature may not be called {taken!r}: tables of results have a column of that "
                f"name; reserved are {', '.join(_RESERVED)}"
            )
        if training_space is not None:
            values["training_space"] = _as_space("training_space", training_space)
            _check_same_columns(values["space"], values["training_space"])
        functions = {part: values[part] for part in _FUNCTIONS}
        optional = {part: values[part] for part in ("present", "detected", "transform")}
        functions |= {part: value for part, value in optional.items() if value is not None}
        functions |= {f"measure {n!r}": measure for n, measure in values["measures"].items()}
        for part, function in functions.items():
            if not callable(function):
                raise TaskError(f"{part} of task {name!r} must be a function; got {function!r}")
        if (present is None) != (detected is None):
            given, missing = ("present", "detected")[:: 1 if detected is None else -1]
            raise TaskError(
                f"task {name!r} has {given} and no {missing}; precision and recall need both"
            )
        for attribute, value in values.items():
            object.__setattr__(self, attribute, value)

    @property
    def has_presence(self) -> bool:
        """True where precision and recall can be measured."""
        return self.present is not None

    def problem(self, weights: Weights) -> Problem:
        """Return the problem of finding inputs on which a network errs.

        Its robustness is minus the wrongness. Every search applies, including those with gradients
        unless the task is a black box.

        **Arguments:**
        - `weights`: the weights of the network.
        """
        kind = _HostNetwork if self.black_box else _Network
        return Problem(self.name, self.space, kind(self, weights), f"{MARGIN} >= 0")

    @truncate_silently()
    def check(self) -> None:
        """Trace renderer and label abstractly, without compiling; black boxes are not traced.

        **Raises:** `TaskError` for a function that raises; `ValueError` for a constraint that
        refuses every sample.
        """
        for space in (self.space, self.training_space):
            if space is not None:
                space.check_where()
        if self.black_box:
            return
        features = jax.eval_shape(self.space.unflatten, jnp.zeros(self.space.dim))
        for part in ("render", "label"):
            try:
                jax.eval_shape(getattr(self, part), features)
            except Exception as error:
                why = explain_user_error(error, features, system=False)
                raise TaskError(f"{part} of task {self.name!r} fails: {why}") from error

    @truncate_silently()
    def check_network(self, weights: Weights, inputs: Inputs, labels: Labels) -> None:
        """Trace predictions and wrongness of a trained network abstractly.

        **Raises:** `TaskError` for a function that raises or returns a wrong type.
        """
        if self.black_box:
            return

        def judged(weights: Weights, inputs: Inputs, labels: Labels) -> Any:
            return jax.vmap(self.wrongness)(self.predict(weights, inputs), labels)

        try:
            form = jax.eval_shape(judged, weights, inputs, labels)
        except Exception as error:
            why = explain_user_error(error, system=False)
            raise TaskError(
                f"predict or wrongness of task {self.name!r} fails: {why}. predict receives a "
                "batch of inputs, wrongness one prediction and one label"
            ) from error
        shape = getattr(form, "shape", None)
        if shape is None or len(shape) != 1:
            given = type(form).__name__ if shape is None else f"shape {list(shape[1:])}"
            raise TaskError(
                f"wrongness of task {self.name!r} must return one number; it returned "
                f"{given}{defined_at(self.wrongness)}"
            )
        if not jnp.issubdtype(form.dtype, jnp.floating):
            raise TaskError(
                f"wrongness of task {self.name!r} must return a real number, such as minus a "
                f"margin; it returned {form.dtype}{defined_at(self.wrongness)}"
            )


class _Network(System):
    """A network as a system: renders, predicts, and shows the margin."""

    def __init__(self, task: SupervisedTask, weights: Weights) -> None:
        self.task, self.weights, self.lanes = task, weights, task.lanes
        self.dt, self.exact_step = 1.0, True

    def __call__(self, features: Features, key: Any = None) -> Trace:
        return _margin(jnp, self.task, self.weights, features)


class _HostNetwork(System):
    """The same for a task that JAX cannot trace."""

    black_box = True

    def __init__(self, task: SupervisedTask, weights: Weights) -> None:
        self.task, self.weights = task, weights

    def __call__(self, features: Features, key: Any = None) -> Trace:
        return _margin(np, self.task, self.weights, features)


def _margin(numpy: Any, task: SupervisedTask, weights: Weights, features: Features) -> Trace:
    inputs = jax.tree.map(lambda leaf: numpy.asarray(leaf)[None], task.render(features))
    predictions = task.predict(weights, inputs)
    prediction = jax.tree.map(lambda leaf: numpy.asarray(leaf)[0], predictions)
    wrongness = numpy.asarray(task.wrongness(prediction, task.label(features)), float)
    return Trace({MARGIN: -numpy.reshape(wrongness, 1)}, dt=1.0)


def _as_space(part: str, space: object) -> FeatureSpace:
    if isinstance(space, Mapping):
        return FeatureSpace(space)
    if not isinstance(space, FeatureSpace):
        raise TaskError(f"{part} must be a FeatureSpace or a dictionary of domains; got {space!r}")
    return space


def _check_same_columns(space: FeatureSpace, narrow: FeatureSpace) -> None:
    if narrow.columns != space.columns:
        raise TaskError(
            "training_space must have the features of space, in the same order; space has "
            f"{', '.join(space.columns)}, training_space {', '.join(narrow.columns)}"
        )
