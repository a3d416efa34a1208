"""Scenic's requirements as the constraint of a feature space.

    constraint = Constraint(sampling, compiled)
    constraint(features)                                # one truth value, traced by JAX
    constraint.by_scenic                                # what Scenic decides in Python, named

Built-in requirements (objects apart, contained, visible) and a program's own are compiled if they
have a meaning in JAX. Scenic checks the others, on the points that the compiled ones accept.
"""

import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from verifai_jax.addons.scenic import geometry
from verifai_jax.addons.scenic.compilation import Compiled
from verifai_jax.addons.scenic.conditions import Condition, conditions
from verifai_jax.addons.scenic.graph import field, is_random, kind_of
from verifai_jax.addons.scenic.meaning import Values
from verifai_jax.addons.scenic.sampling import LOCK, Refused, Sampling, _plain
from verifai_jax.addons.scenic.values import Unsupported, as_vec, is_plain
from verifai_jax.core.display.progress import write_line

Check = Callable[[Values], Any]
MAX_DECISIONS = 100_000
"""Decisions of Scenic that are kept: a run asks about some points more than once."""
FIRST_SHOWN, SHOWN_EVERY = 2.0, 10.0
"""Seconds of one round of decisions after which a line says so, and seconds between such lines."""


class Constraint:
    """All requirements of one program.

    - `compiled`: names of the requirements that JAX checks.
    - `by_scenic`: names of those that Scenic checks in Python, with the reason.
    - `draws`: True if Scenic may refuse a scene while drawing it.
    """

    def __init__(self, sampling: Sampling, program: Compiled, planar: bool) -> None:
        self.sampling = sampling
        self.compiled: list[str] = []
        self.by_scenic: dict[str, str] = {}
        self._checks: list[tuple[str, Check, str | None]] = []
        self._left: list[Any] = []
        self._decisions: dict[tuple, bool] = {}
        self._began = self._shown = 0.0
        self._soft = {id(requirement): name for name, requirement in sampling.soft.items()}
        shape = {
            name: jax.eval_shape(domain.from_unit, jnp.zeros(domain.size))
            for name, domain in sampling.domains.items()
        }
        parsed = conditions(program)
        scenario = sampling.scenario
        for requirement in (*scenario.defaultRequirements, *scenario.userRequirements):
            if requirement.optional:
                continue
            name = self._name(requirement)
            try:
                if not planar:
                    raise Unsupported("a program that is not planar")
                check = self._check(requirement, parsed, program)
                jax.eval_shape(lambda f, c=check: jnp.asarray(c(Values(sampling, f))), shape)
            except Unsupported as reason:
                self.by_scenic[name] = str(reason)
                self._left.append(requirement)
            else:
                self.compiled.append(name)
                self._checks.append((name, check, self._soft.get(id(requirement))))
        # Those of arithmetic take microseconds, those of meshes milliseconds.
        self._left.sort(key=lambda requirement: kind_of(requirement) != "CompiledRequirement")
        # A scene that Scenic may refuse while it draws it is drawn before it is accepted.
        self.draws = any(
            kind_of(node) == "DiscreteRange" and is_random(node) and is_random(field(node, "high"))
            for node in sampling.order
        ) or bool(sampling.seeded)
        self.__name__ = "the program's requirements"

    def _name(self, requirement: Any) -> str:
        owners = self.sampling.owners
        match kind_of(requirement):
            case "IntersectionRequirement":
                return f"{owners[id(requirement.objA)]} apart from {owners[id(requirement.objB)]}"
            case "ContainmentRequirement":
                return f"{owners[id(requirement.obj)]} in its container"
            case "VisibilityRequirement" | "NonVisibilityRequirement":
                source, target = owners[id(requirement.source)], owners[id(requirement.target)]
                hidden = kind_of(requirement).startswith("Non")
                return f"{target} {'hidden' if hidden else 'visible'} from {source}"
        return f"require on line {requirement.line}"

    def _check(self, requirement: Any, parsed: Mapping[int, Any], program: Compiled) -> Check:
        match kind_of(requirement):
            case "IntersectionRequirement":
                return _apart(requirement)
            case "ContainmentRequirement":
                container, body = requirement.container, requirement.obj
                polygons = (
                    getattr(container, "polygons", None) if not is_random(container) else None
                )
                if polygons is None or kind_of(container) not in (
                    *("PolygonalFootprintRegion", "PolygonalRegion", "RectangularRegion"),
                    *("CircularRegion", "SectorRegion"),
                ):
                    raise Unsupported(
                        f"a container that is not a fixed polygon ({kind_of(container)})"
                    )
                edges, convex = geometry.edges_of(polygons), geometry.is_convex(polygons)
                if len(edges) > 2000:
                    raise Unsupported(f"a container of {len(edges)} edges")
                return lambda values: geometry.box_inside(
                    geometry.rectangle_of(values.body(body)), edges, convex
                )
            case "VisibilityRequirement":
                return _visible(requirement)
            case "CompiledRequirement":
                if requirement.line not in parsed:
                    raise Unsupported("a requirement of an imported module")
                return Condition(requirement, parsed[requirement.line], program)
        raise Unsupported(kind_of(requirement))

    def __call__(self, features: Mapping[str, Any]) -> Bool[Array, ""]:
        """Return whether a scene keeps all requirements."""
        values = Values(self.sampling, features)
        holds = jnp.asarray(True)
        for _, check, soft in self._checks:
            held = check(values)
            if soft is not None:
                held = jnp.logical_or(jnp.logical_not(features[soft]), held)
            holds = jnp.logical_and(holds, held)
        if not (self._left or self.draws):
            return holds
        answer = jax.ShapeDtypeStruct((), jnp.bool_)
        asked = {name: features[name] for name in self.sampling.domains}
        return jax.pure_callback(self._decided, answer, holds, asked, vmap_method="broadcast_all")

    def _decided(self, holds: Any, features: Mapping[str, Any]) -> np.ndarray:
        """Let Scenic decide about the points that the compiled requirements accept."""
        holds = np.asarray(holds)
        features = {name: np.asarray(column) for name, column in features.items()}
        if holds.ndim == 0:
            return np.asarray(bool(holds) and self._accepts(features))
        verdicts = holds.copy()
        asked = np.flatnonzero(holds)
        for number, row in enumerate(asked):
            verdicts[row] = self._accepts({name: c[row] for name, c in features.items()})
            self._show(number + 1, len(asked))
        return verdicts

    def _show(self, decided: int, points: int) -> None:
        """Say on the error stream what takes so long, after some seconds and then now and then."""
        now = time.perf_counter()
        if decided == 1:
            self._began, self._shown = now, now + FIRST_SHOWN - SHOWN_EVERY
        if now - self._shown > SHOWN_EVERY:
            self._shown = now
            write_line(
                f"vj.scenic: Scenic decides requirements in Python: {decided} of {points} points "
                f"so far, {1000 * (now - self._began) / decided:z.0f} ms each"
            )

    def _accepts(self, features: Mapping[str, Any]) -> bool:
        """Return whether Scenic accepts a point, by the requirements that are not compiled."""
        point = tuple(_plain(features[name]) for name in self.sampling.domains)
        if (known := self._decisions.get(point)) is not None:
            return known
        if len(self._decisions) >= MAX_DECISIONS:
            self._decisions.clear()
        verdict = self._decisions[point] = self._accepts_anew(features)
        return verdict

    def _accepts_anew(self, features: Mapping[str, Any]) -> bool:
        with LOCK:
            try:
                values = self.sampling.values(features)
            except Refused:
                return False
            self.sampling.activate(features)
            for requirement in self._left:
                name = self._soft.get(id(requirement))
                if name is not None and not _plain(features[name]):
                    continue
                if requirement.falsifiedBy(values):
                    return False
        return True


def _apart(requirement: Any) -> Check:
    one, other = requirement.objA, requirement.objB
    for body in (one, other):
        if is_random(field(body, "allowCollisions")):
            raise Unsupported("a random permission to collide")
        if field(body, "allowCollisions"):
            return lambda values: True
    return lambda values: geometry.boxes_apart(
        geometry.rectangle_of(values.body(one)), geometry.rectangle_of(values.body(other))
    )


def _visible(requirement: Any) -> Check:
    source, target = requirement.source, requirement.target
    for body in requirement.potential_occluders:
        if is_random(field(body, "occluding")) or field(body, "occluding"):
            raise Unsupported("objects that hide others")
    angle = field(source, "viewAngle")
    if is_random(angle) or not is_plain(angle) or angle < 2 * np.pi - 0.001:
        raise Unsupported("a view that is not all around")
    if kind_of(target).startswith(("Point", "OrientedPoint")) or "width" not in target.properties:
        raise Unsupported("a point to be seen")

    def check(values: Values) -> Any:
        viewer = values.body(source)
        position = as_vec(viewer.get("position"))
        if "cameraOffset" in viewer.names:
            camera = as_vec(viewer.get("cameraOffset"))
            position = position.offsetRotated(viewer.get("orientation"), camera)
        distance = viewer.get("visibleDistance")
        return geometry.sees_all_around(
            position.x, position.y, distance, geometry.rectangle_of(values.body(target))
        )

    return check
