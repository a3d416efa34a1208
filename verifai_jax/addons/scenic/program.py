"""A Scenic program as a feature space, and its scenes: as functions of JAX, and as Scenic code."""

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.scenic.graph import kind_of
from verifai_jax.addons.scenic.outputs import Outputs
from verifai_jax.addons.scenic.recipe import Recipe
from verifai_jax.addons.scenic.requirements import Constraint
from verifai_jax.addons.scenic.sampling import LOCK, Refused, Sampling
from verifai_jax.addons.scenic.simulation import OnScenes, ScenicSimulation, check_simulation
from verifai_jax.addons.scenic.steering import BATCH, SteeredScenario
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.values.trace import Trace
from verifai_jax.features import FeatureSpace
from verifai_jax.search import Search
from verifai_jax.systems.base import Seed, System
from verifai_jax.systems.blackbox import blackbox
from verifai_jax.systems.blackbox._blackbox import BlackBox, PooledBlackBox, VectorisedBlackBox

if TYPE_CHECKING:
    import pandas as pd
HostSystem = BlackBox | PooledBlackBox | VectorisedBlackBox


class SceneSystem(System):
    """A function of scenes, `function(scene, key) -> Trace`, as a system with features."""

    def __init__(self, scenes: Outputs, function: Callable[..., Trace]) -> None:
        self.scenes, self.function = scenes, function
        self.__wrapped__ = function
        self.__name__ = getattr(function, "__name__", type(function).__name__)

    def __call__(self, features: Any, key: Seed = None) -> Trace:
        return self.function(self.scenes(features), key)

    def __repr__(self) -> str:
        return f"{self.__name__} over scenes"


@dataclass(frozen=True, eq=False, repr=False)
class ScenicProgram:
    """A compiled Scenic program; made by `scenic`.

    - `space`: one named feature for each random value; its constraint is the program's
      requirements. Uniform points that it accepts have the distribution of Scenic's scenes.
    - `objects`: names of the numbers of each object, and of the global parameters (`params`).
    - `seeded`: random values without an inverse, which share the coordinate `seed`.
    - `in_python`: numbers that Scenic computes in Python, with the reason.
    - `by_scenic`: requirements that Scenic checks in Python, with the reason.
    - `scenario`: Scenic's `Scenario`.
    """

    space: FeatureSpace
    objects: Mapping[str, tuple[str, ...]]
    seeded: tuple[str, ...]
    in_python: Mapping[str, str]
    by_scenic: Mapping[str, str]
    scenario: Any
    _recipe: Recipe
    _sampling: Sampling
    _outputs: Outputs
    _constraint: Constraint

    @property
    def compiled(self) -> bool:
        """True if every number of a scene is computed by JAX."""
        return not self.in_python

    def scenes(self, features: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the numbers of a scene: `{"ego": {"x": ..., "y": ..., "heading": ...}, ...}`.

        Pure JAX; use `jax.vmap` for batches. Positions are in metres, headings in radians,
        counterclockwise from the y axis, as in Scenic. Global parameters are under `params`; an
        option that is not a number is given by its index. Values that JAX cannot compute
        (`in_python`) are computed by Scenic, without derivatives.

        **Arguments:**
        - `features`: as returned by `space.unflatten`, or by `features_of` for a scene.
        **Raises:** `ValueError` for features whose names or shapes are not those of the space.
        """
        return self._outputs(self.space.convert(features))

    def system(self, function: Callable[..., Trace]) -> System:
        """Return a system that JAX traces, from a function of scenes.

        **Arguments:**
        - `function(scene, key) -> Trace`: a pure JAX function of the numbers returned by `scenes`.
        **Raises:** `ValueError` for an object that cannot be called.
        """
        if not callable(function):
            raise ValueError(f"system needs a function (scene, key) -> Trace; got {function!r}")
        return SceneSystem(self._outputs, function)

    @property
    def given(self) -> tuple[str, ...]:
        """Names of the features that the program reads instead of drawing."""
        return tuple(name for name in self.space.domains if name not in self._sampling.domains)

    def blackbox(
        self, function: Callable[..., Trace], *, seeded: bool = False, **options: Any
    ) -> HostSystem:
        """Return a host system, from a function of Scenic's own scenes.

        **Arguments:**
        - `function(scene) -> Trace`: a function of Scenic's `Scene`; `function(scene, seed)` with
          `seeded`.
        - `options`: those of `verifai_jax.blackbox`, such as `workers` and `timeout`. A worker
          compiles the program once.
        **Raises:** the errors of `verifai_jax.blackbox`.
        """
        if not callable(function):
            raise ValueError(f"blackbox needs a function (scene) -> Trace; got {function!r}")
        return blackbox(OnScenes(self._recipe, function, seeded), seeded=True, **options)

    def simulator(
        self, steps: int, records: tuple[str, ...] | list[str] = (), *, dt: float | None = None,
        workers: int | None = None, timeout: float | None = None, **options: Any,
    ) -> HostSystem:  # fmt: skip
        """Return the program's simulator as a system, with behaviors, monitors and records.

        It is the simulator that the program names, or else Scenic's Newtonian one. Random numbers
        of behaviors depend only on the row.

        **Arguments:**
        - `steps`: the maximum number of steps of a simulation.
        - `records`: names of `record` statements, which become signals; all when left out.
        - `dt`: duration of a step in seconds; the simulator's own when left out.
        - `workers`: number of processes, each of which compiles the program; by default this
          process.
        - `timeout`: wall-clock seconds for one simulation; needs `workers`. Compiling the program
          in a worker's first simulation counts.
        - `options`: further options of `verifai_jax.blackbox`.
        **Raises:** `ValueError` for invalid steps, records or step duration; the errors of
        `verifai_jax.blackbox`.
        """
        named = check_simulation(steps, records, dt, self.scenario)
        simulation = ScenicSimulation(self._recipe, steps, named, dt)
        return blackbox(simulation, seeded=True, workers=workers, timeout=timeout, **options)

    def steered(
        self, search: str | Search = "cross_entropy", *, seed: int = 0, batch: int = BATCH
    ) -> SteeredScenario:
        """Return a scenario whose scenes a search proposes, for a runner that simulates them.

        Its `generate(feedback=rho)` is like that of Scenic's scenario, and proposes all random
        values of the program; `rho` is the robustness of the last scene, negative for a failure.

        **Arguments:** those of `scenic_sampler`.
        **Raises:** `ValueError` for a search that learns from more than the robustness.
        """
        return SteeredScenario(self, search, seed, batch)

    def scene(self, features: Mapping[str, Any]) -> Any:
        """Return Scenic's `Scene` at these features.

        **Raises:** `ValueError` for features outside the space, and for those at which Scenic
        refuses the scene.
        """
        complete = self.space.root.coerce(self.space.completed(features))
        self.space.root.check(complete, "")
        here = jax.tree.map(np.asarray, complete)
        try:
            values = self._sampling.values(here)
        except Refused as error:
            raise ValueError(f"Scenic refuses this scene: {error}") from error
        refusal = self._sampling.refusal(values, here)
        if refusal is not None:
            raise ValueError(f"Scenic refuses this scene: {refusal}")
        return self._sampling.scene(values, here)

    def of(self, run: Any, row: "int | pd.Series") -> Any:
        """Return Scenic's `Scene` for a row of a run's table.

        **Arguments:**
        - `run`: a `Run`, or its table.
        - `row`: number of the row, or the row itself.
        **Raises:** `IndexError` for a row that is not in the table; the errors of `scene`.
        """
        table = getattr(run, "table", run)
        values = table.row(int(row)) if isinstance(row, int | np.integer) else row
        return self.scene(self.space.from_row(values))

    def features_of(self, scene: Any) -> dict[str, Any]:
        """Return the features that give a scene of Scenic's own sampler.

        A feature that the scene does not determine, such as the seed or an end of an interval that
        Scenic's bytes leave out, gets the middle of its domain, or a value at which the scene is
        possible.

        **Raises:** `ValueError` for a scene of another program or compilation.
        """
        features = self._sampling.features_of(scene)
        for name in self.given:
            domain = self.space[name]
            middle = domain.from_unit(jnp.full(domain.size, 0.5))
            features[name] = scene.params.get(name, middle)
        return features

    def refusal(self, features: Mapping[str, Any]) -> str | None:
        """Return why Scenic's own checker refuses a scene; None if it accepts it."""
        here = jax.tree.map(np.asarray, self.space.convert(features))
        try:
            return self._sampling.refusal(self._sampling.values(here), here)
        except Refused as error:
            return str(error)

    def code(self, scene: Any) -> str:
        """Return a Scenic program with this scene as its only one, to compile in the same `mode2D`.

        Parts that code cannot express, such as behaviors and meshes, are named in a comment.
        """
        return scene_code(scene, self._recipe.planar)

    def to_bytes(self, scene: Any) -> bytes:
        """Return a scene as bytes that Scenic's `sceneFromBytes` restores.

        **Raises:** `ValueError` for a scene of another program or compilation.
        """
        self._sampling.check_own(scene)
        with LOCK:
            return self.scenario.sceneToBytes(scene)

    def from_bytes(self, data: bytes) -> Any:
        """Return the scene written by `to_bytes` for the same program."""
        with LOCK:
            return self.scenario.sceneFromBytes(data)

    def draw(self, scene: Any, path: str | Path | None = None) -> Any:
        """Draw a scene from above; returns the figure.

        **Arguments:**
        - `scene`: the scene of Scenic.
        - `path`: file to which the picture is written.
        """
        return lazy_import("verifai_jax.addons.scenic.scenes", "draw_scene")(self, scene, path)

    def describe(self) -> str:
        """Describe the features, and list what Scenic computes and checks in Python."""
        lines = [self.space.describe()]
        lines += [f"seeded: {name}" for name in self.seeded]
        lines += [f"computed by Scenic: {name} ({why})" for name, why in self.in_python.items()]
        lines += [f"decided by Scenic: {name} ({why})" for name, why in self.by_scenic.items()]
        return "\n".join(lines)

    def __repr__(self) -> str:
        objects = ", ".join(name for name in self.objects if name != "params")
        return f"ScenicProgram(objects: {objects}; {self.space.dim} coordinates)"


POSE = ("position", "orientation", "parentOrientation", "heading", "yaw", "pitch", "roll")
"""Properties that `at` and `facing` set together."""
UNWRITTEN = frozenset((*POSE, "shape", "regionContainedIn", "lastActions", "sensors"))
"""Properties that are written otherwise, or that say nothing about a scene that is drawn."""
SIZE = ("width", "length", "height")
"""Properties that may come from a shape which is not written."""
SHAPES = ("CylinderShape", "ConeShape", "SpheroidShape")
"""Shapes that are known by their name and the size of the object."""


class _NoCodeError(Exception):
    """A value that Scenic code cannot write."""


def scene_code(scene: Any, planar: bool) -> str:
    """Return Scenic code whose only scene is this one.

    Scenic's own `dumpAsScenicCode` needs the classes of the program. This code defines them without
    properties, since each object lists its own. Parts that code cannot express, such as a behavior,
    are named in a comment. Requirements are left out, since they hold in this scene.

    **Arguments:**
    - `scene`: the scene of Scenic.
    - `planar`: Scenic's `mode2D`, in which the code has to be compiled.
    """
    lines = [f"# One scene of a Scenic program{', in mode2D' if planar else ''}."]
    for kind in dict.fromkeys(each for body in scene.objects for each in _own_classes(type(body))):
        above = [base.__name__ for base in kind.__bases__ if _is_own(base)]
        lines += [f"class {kind.__name__}{f'({above[0]})' if above else ''}:", "    pass"]
    for name, value in scene.params.items():
        label = name if str(name).isidentifier() else f'"{name}"'
        try:
            lines.append(f"param {label} = {_written(value)}")
        except _NoCodeError as kind:
            lines.append(f"# The parameter {name!r} is left out: code cannot write a {kind}.")
    for body in scene.objects:
        specifiers, left_out = _specifiers(body, planar)
        lines += [f"# The property {name!r} of the next object is left out." for name in left_out]
        ego = "ego = " if body is scene.egoObject else ""
        kind = type(body).__name__ if _is_own(type(body)) else "Object"
        lines.append(f"{ego}new {kind} " + ",\n    ".join(specifiers))
    return "\n".join(lines) + "\n"


def _is_own(kind: type) -> bool:
    """Return whether a class of objects is no class of Scenic's language itself."""
    return issubclass(kind, _objects().Object) and kind.__module__ != _objects().__name__


def _own_classes(kind: type) -> Iterator[type]:
    """Return a class and its bases that need a definition in the code."""
    return (each for each in reversed(kind.__mro__) if _is_own(each))


def _objects() -> Any:
    return sys.modules["scenic.core.object_types"]


def _specifiers(body: Any, planar: bool) -> tuple[list[str], list[str]]:
    """Return what sets the properties of an object, and the names of those that code cannot set."""
    yaw, pitch, roll = (float(angle) for angle in body.orientation.eulerAngles)
    facing = f"{yaw!r}" if planar else f"({yaw!r}, {pitch!r}, {roll!r})"
    found, left_out = [f"at {_written(body.position)}", f"facing {facing}"], []
    shape = kind_of(body.shape)
    if shape in SHAPES:
        found.append(f"with shape {shape}()")
    elif shape != "BoxShape":
        left_out.append("shape")
    for name in body.properties:
        value = getattr(body, name)
        hidden = name in UNWRITTEN or name.startswith(("_", "mutat")) or value is None
        if hidden or name in body._finalProperties or _is_scenics_default(body, name):
            continue
        if name == "color" and isinstance(value, str):
            left_out.append(name)  # Scenic takes a name for a color only where it is random.
            continue
        try:
            found.append(f"with {name} {_written(value)}")
        except _NoCodeError:
            left_out.append(name)
    return found, left_out


def _is_scenics_default(body: Any, name: str) -> bool:
    """Return whether a property has the value that Scenic itself gives to every object."""
    if name not in body._constProps or name in SIZE:
        return False
    kinds = (kind for kind in type(body).__mro__ if name in getattr(kind, "_scenic_properties", {}))
    return not _is_own(next(kinds))


def _written(value: Any) -> str:
    """Return a value as Scenic code."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else f'float("{value}")'
    if value is None or isinstance(value, bool | int | str):
        return repr(value)
    if isinstance(value, PurePath):
        return repr(str(value))
    if kind_of(value) in ("Vector", "OrientedVector"):
        return f"Vector({', '.join(_written(part) for part in value.coordinates)})"
    if kind_of(value) == "Orientation":
        return f"Orientation.fromEuler({', '.join(map(_written, value.eulerAngles))})"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_written(k)}: {_written(v)}' for k, v in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_written, value))}]"
    if isinstance(value, tuple):
        return f"({', '.join(map(_written, value))}{',' * (len(value) == 1)})"
    raise _NoCodeError(kind_of(value))
