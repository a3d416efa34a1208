"""Numbers of a scene, for each object and parameter, compiled by JAX if possible.

outputs = Outputs(sampling, planar=True)
outputs(features)                                   # {"ego": {"x": ..., ...}, "params": {...}}
outputs.in_python                                   # what Scenic computes, with the reason
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.scenic.compilation import ProgramError, describe_error
from verifai_jax.addons.scenic.graph import field, is_random, kind_of
from verifai_jax.addons.scenic.meaning import Values, as_output
from verifai_jax.addons.scenic.sampling import LOCK, Refused, Sampling
from verifai_jax.addons.scenic.values import Unsupported, as_vec, as_yaw

POSE = ("x", "y", "heading", "width", "length")
"""What every object has."""
PARAMS = "params"
"""Name of the dictionary of the global parameters."""
BASE = frozenset(
    (
        *("position", "parentOrientation", "yaw", "pitch", "roll", "heading", "orientation"),
        *("width", "length", "height", "baseOffset", "contactTolerance", "sideComponentThresholds"),
        *("visibleDistance", "viewAngle", "viewAngles", "viewRayDensity", "viewRayCount"),
        *("viewRayDistanceScaling", "mutationScale", "mutator", "positionStdDev", "onDirection"),
        *("orientationStdDev", "cameraOffset", "allowCollisions", "requireVisible", "occluding"),
        *("regionContainedIn", "showVisibleRegion", "shape", "behavior", "lastActions", "sensors"),
        *(
            "headingStdDev",
            "velocity",
            "angularVelocity",
            "angularSpeed",
            "render",
            "observations",
            "name",
            "color",
        ),
    )
)
"""Properties of Scenic's own that a system does not see as such."""
WHERE_RANDOM = frozenset(("color", "viewAngle", "visibleDistance"))
"""Those that it sees where they are random."""
Read = Callable[[Values], Any]


class Outputs:
    """The numbers of a scene as a function of its features.

    - `objects`: names of the numbers of each object, and of the parameters.
    - `in_python`: names of the numbers that Scenic computes in Python, with the reason.
    """

    def __init__(self, sampling: Sampling, planar: bool) -> None:
        self.sampling = sampling
        self._traced: dict[tuple[str, str], Read] = {}
        self._python: list[tuple[str, str, Callable[[Any], Any]]] = []
        self.in_python: dict[str, str] = {}
        self._shape = {
            name: jax.eval_shape(domain.from_unit, jnp.zeros(domain.size))
            for name, domain in sampling.domains.items()
        }
        probe = self._probe()
        for body in sampling.scenario.objects:
            owner = sampling.owners[id(body)]
            for name in (*POSE, *_others(body)):
                on_host = _reader(body, name)
                self._add(owner, name, _tracer(body, name, planar), on_host, probe)
            if not planar:
                for name in ("z", "pitch", "roll"):
                    self._add(owner, name, _tracer(body, name, planar), _reader(body, name), probe)
        for name, value in sampling.scenario.params.items():
            if is_random(value) or (isinstance(value, int | float) and not isinstance(value, bool)):
                on_host = _param_reader(value)
                self._add(PARAMS, name, lambda values, v=value: values(v), on_host, probe)
        outputs = (*self._traced, *((owner, name) for owner, name, _ in self._python))
        self.objects: dict[str, tuple[str, ...]] = {}
        for owner in (*(sampling.owners[id(b)] for b in sampling.scenario.objects), PARAMS):
            names = tuple(name for known, name in outputs if known == owner)
            if names:
                self.objects[owner] = names

    def _probe(self) -> Any:
        """Return the values of one scene, to see which properties are numbers."""
        random = np.random.default_rng(0)
        for _ in range(64):
            features = {
                name: domain.from_unit(jnp.asarray(random.random(domain.size), jnp.float32))
                for name, domain in self.sampling.domains.items()
            }
            try:
                return self.sampling.values(features)
            except Refused:
                continue
            except Exception as error:
                raise ProgramError(
                    f"Scenic cannot sample this program: {describe_error(error)}"
                ) from error
        return None

    def _add(self, owner: str, name: str, trace: Read, on_host: Any, probe: Any) -> None:
        try:
            jax.eval_shape(
                lambda f: jnp.asarray(as_output(trace(Values(self.sampling, f))), float),
                self._shape,
            )
        except Unsupported as reason:
            if probe is None:
                return
            try:
                float(on_host(probe))
            except (TypeError, ValueError, AttributeError):
                return  # No number, so nothing for a system of numbers.
            self.in_python[f"{owner}.{name}"] = str(reason)
            self._python.append((owner, name, on_host))
        else:
            self._traced[owner, name] = trace

    def __call__(self, features: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the numbers of a scene by object and name. Pure JAX."""
        values = Values(self.sampling, features)
        real = jnp.result_type(*(leaf for leaf in jax.tree.leaves(features)), jnp.float32)
        found = {
            key: jnp.asarray(as_output(trace(values))).astype(real)
            for key, trace in self._traced.items()
        }
        if self._python:
            answer = jax.ShapeDtypeStruct((len(self._python),), real)
            asked = {name: features[name] for name in self.sampling.domains}

            def computed(features: Mapping[str, Any]) -> np.ndarray:
                return self._computed(features, real)

            # What a person reads of it, where it has no derivative.
            computed.__name__ = f"{', '.join(self.in_python)}, which Scenic computes in Python"
            column = jax.pure_callback(computed, answer, asked, vmap_method="broadcast_all")
            for i, (owner, name, _) in enumerate(self._python):
                found[owner, name] = column[..., i]
        scene = {
            owner: {name: found[owner, name] for name in names}
            for owner, names in self.objects.items()
        }
        given = {n: value for n, value in features.items() if n not in self.sampling.domains}
        if given:
            scene["params"] = {**scene.get("params", {}), **given}
        return scene

    def _computed(self, features: Mapping[str, Any], dtype: Any) -> np.ndarray:
        """Let Scenic compute what JAX does not; NaN where Scenic refuses the scene."""
        features = {name: np.asarray(column) for name, column in features.items()}
        series = {
            n for leaf in self.sampling.leaves.values() if leaf.is_series for n in leaf.domains
        }
        first = next(iter(features))
        batch = features[first].shape[: -1 if first in series else None]
        rows = np.full((int(np.prod(batch)), len(self._python)), np.nan, dtype)
        for row, numbers in enumerate(rows):
            here = {
                name: column.reshape(len(rows), -1)[row, ... if name in series else 0]
                for name, column in features.items()
            }
            with LOCK:
                try:
                    values = self.sampling.values(here)
                except Refused:
                    continue
                numbers[:] = [float(read(values)) for _, _, read in self._python]
        return rows.reshape(*batch, len(self._python))


def _others(body: Any) -> list[str]:
    """Return the names of the numbers of an object that are its program's own, or random."""
    names = []
    for name in body.properties:
        value = field(body, name)
        plain = isinstance(value, int | float) and not isinstance(value, bool)
        hidden = name in BASE - WHERE_RANDOM if is_random(value) else name in BASE
        if not hidden and not name.startswith("_") and (plain or is_random(value)):
            names.append(name)
    return names


def _tracer(body: Any, name: str, planar: bool) -> Read:
    def trace(values: Values) -> Any:
        if not planar:
            raise Unsupported("a program that is not planar")
        traced = values.body(body)
        if name in ("x", "y"):
            return getattr(as_vec(traced.get("position")), name)
        if name == "heading":
            return as_yaw(traced.get("orientation")).yaw
        return traced.get(name)

    return trace


def _reader(body: Any, name: str) -> Callable[[Any], Any]:
    def read(values: Any) -> Any:
        sampled = values[body]
        match name:
            case "x" | "y" | "z":
                return getattr(sampled.position, name)
            case "pitch" | "roll":
                return getattr(sampled.orientation, name)
            case "heading":
                return (
                    sampled.heading if kind_of(sampled).endswith("2D") else sampled.orientation.yaw
                )
        return getattr(sampled, name)

    return read


def _param_reader(value: Any) -> Callable[[Any], Any]:
    return lambda values: values[value]
