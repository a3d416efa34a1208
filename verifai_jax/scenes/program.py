"""A Scenic program as a feature space, with its scenes as a function of JAX (`ScenicProgram`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.core.lazy import lazy_import
from verifai_jax.core.trace import Trace
from verifai_jax.features import FeatureSpace
from verifai_jax.scenes.outputs import Outputs
from verifai_jax.scenes.recipe import Recipe
from verifai_jax.scenes.requirements import Constraint
from verifai_jax.scenes.sampling import LOCK, Refused, Sampling
from verifai_jax.scenes.scene_code import scene_code
from verifai_jax.scenes.simulation import OnScenes, ScenicSimulation, check_simulation
from verifai_jax.systems.base import Seed, System
from verifai_jax.systems.blackbox import blackbox
from verifai_jax.systems.blackbox._blackbox import BlackBox, PooledBlackBox, VectorisedBlackBox

if TYPE_CHECKING:
    import pandas as pd

HostSystem = BlackBox | PooledBlackBox | VectorisedBlackBox


class SceneSystem(System):
    """A system of compiled scenes: `function(scene, key) -> Trace` as a function of features."""

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

    - `space`: one named feature for each random value; its constraint is the requirements. Uniform
      points that it accepts are Scenic's own distribution.
    - `objects`: names of the numbers of each object, and of the global parameters (`params`).
    - `seeded`: random values without an inverse, which share the coordinate `seed`.
    - `in_python`: numbers that Scenic computes, in Python, with the reason.
    - `by_scenic`: requirements that Scenic decides, in Python, with the reason.
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
        """True where every number of a scene is a function of JAX."""
        return not self.in_python

    def scenes(self, features: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the numbers of a scene: `{"ego": {"x": ..., "y": ..., "heading": ...}, ...}`.

        Pure JAX; `jax.vmap` it for batches. Positions are in metres, headings in radians,
        counterclockwise from the y axis, as in Scenic. Global parameters come under `params`; an
        option that is not a number comes as its index. What has no meaning in JAX (`in_python`) is
        computed by Scenic, without derivatives.

        **Arguments:**

        - `features`: as `space.unflatten` gives them, or as a person writes them and `features_of`
          gives them.

        **Raises:** `ValueError` for features whose names or shapes are not those of the space.
        """
        return self._outputs(self.space.convert(features))

    def system(self, function: Callable[..., Trace]) -> System:
        """Return a system that JAX traces, given one of scenes.

        **Arguments:**

        - `function(scene, key) -> Trace`: pure JAX, of the numbers that `scenes` gives.

        **Raises:** `ValueError` for what cannot be called.
        """
        if not callable(function):
            raise ValueError(f"system needs a function (scene, key) -> Trace; got {function!r}")
        return SceneSystem(self._outputs, function)

    @property
    def given(self) -> tuple[str, ...]:
        """Names of the features that the program does not draw, but reads."""
        return tuple(name for name in self.space.domains if name not in self._sampling.domains)

    def blackbox(
        self, function: Callable[..., Trace], *, seeded: bool = False, **options: Any
    ) -> HostSystem:
        """Return a system on the host, given one of Scenic's own scenes.

        **Arguments:**

        - `function(scene) -> Trace`: of Scenic's `Scene`; `function(scene, seed)` with `seeded`.
        - `options`: those of `verifai_jax.blackbox`, such as `workers` and `timeout`. A worker
          compiles the program once.

        **Raises:** as `verifai_jax.blackbox`.
        """
        if not callable(function):
            raise ValueError(f"blackbox needs a function (scene) -> Trace; got {function!r}")
        return blackbox(OnScenes(self._recipe, function, seeded), seeded=True, **options)

    def simulator(
        self,
        steps: int,
        records: tuple[str, ...] | list[str] = (),
        *,
        dt: float | None = None,
        workers: int | None = None,
        timeout: float | None = None,
        **options: Any,
    ) -> HostSystem:
        """Return the program's simulator as a system: behaviours, monitors and records.

        The simulator is the one that the program names, or Scenic's Newtonian one. What behaviours
        draw depends on the row alone.

        **Arguments:**

        - `steps`: the maximum number of steps of a simulation.
        - `records`: names of `record` statements, which become signals; all when left out.
        - `dt`: seconds of a step; the simulator's own when left out.
        - `workers`: processes, each of which compiles the program once; in this process when left
          out.
        - `timeout`: seconds of wall clock for one simulation; needs `workers`. A worker's first
          simulation compiles the program.
        - `options`: others of `verifai_jax.blackbox`.

        **Raises:** `ValueError` for steps, records or a step that can be none, and as
        `verifai_jax.blackbox`.
        """
        named = check_simulation(steps, records, dt, self.scenario)
        simulation = ScenicSimulation(self._recipe, steps, named, dt)
        return blackbox(simulation, seeded=True, workers=workers, timeout=timeout, **options)

    def scene(self, features: Mapping[str, Any]) -> Any:
        """Return Scenic's `Scene` at these features.

        **Raises:** `ValueError` for features outside the space, and for those where Scenic refuses
        the scene.
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
        """Return Scenic's `Scene` of a row of a run's table.

        **Arguments:**

        - `run`: a `Run`, or its table.
        - `row`: number of the row, or the row itself.

        **Raises:** `IndexError` for a row that is not in the table, and as `scene`.
        """
        table = getattr(run, "table", run)
        values = table.row(int(row)) if isinstance(row, int | np.integer) else row
        return self.scene(self.space.from_row(values))

    def features_of(self, scene: Any) -> dict[str, Any]:
        """Return the features at which a scene of Scenic's own sampler would come.

        What a scene does not tell, such as the seed and the ends of an interval that Scenic's bytes
        leave out, is in the middle of its domain, or where the scene is possible.

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
        """Return a Scenic program whose only scene is this one, to compile in the same `mode2D`.

        What code cannot write, such as behaviours and meshes, is named in a comment.
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
        """Return the scene that `to_bytes` wrote, of the same program."""
        with LOCK:
            return self.scenario.sceneFromBytes(data)

    def draw(self, scene: Any, path: str | Path | None = None) -> Any:
        """Draw a scene from above; returns the figure.

        **Arguments:**

        - `scene`: the scene of Scenic.
        - `path`: file to write the picture to.
        """
        return lazy_import("verifai_jax.plotting.scenes", "draw_scene")(self, scene, path)

    def describe(self) -> str:
        """Describe the features, and say what Scenic computes and decides in Python."""
        lines = [self.space.describe()]
        lines += [f"seeded: {name}" for name in self.seeded]
        lines += [f"computed by Scenic: {name} ({why})" for name, why in self.in_python.items()]
        lines += [f"decided by Scenic: {name} ({why})" for name, why in self.by_scenic.items()]
        return "\n".join(lines)

    def __repr__(self) -> str:
        objects = ", ".join(name for name in self.objects if name != "params")
        return f"ScenicProgram(objects: {objects}; {self.space.dim} coordinates)"
