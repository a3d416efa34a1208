"""Bindings from features to numbers of a MuJoCo model, its initial state, forces and controls.

    bind={"masspole": "body/pole/mass", "wind": "body/cart/force[0]", "x0": "joint/slider/qpos"}
    bind={"grip": ["geom/left/friction[0]", "geom/right/friction[0]"]}    # one feature, several
    bind={"payload": Scaled("body/torso/mass")}                           # times the model's value

The code here is pure JAX on one row of features; the native backend runs it on a batch.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.addons.simulators.mujoco.derived_constants import (
    SolidBody,
    bodies_of_geoms,
    masses_of_geoms,
    recompute_inertia,
)
from verifai_jax.addons.simulators.mujoco.model import Model, free_centres_of_mass
from verifai_jax.addons.simulators.mujoco.part_paths import GEOM_MASS, Location, locate
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.values.waveform import is_waveform

STATE = ("qpos", "qvel", "act", "mocap_pos", "mocap_quat")
APPLIED = ("ctrl", "xfrc_applied", "qfrc_applied")
# Parameters from which `mj_setConst` derives others.
_DERIVED_FROM = {
    *("body_mass", "body_inertia", "body_pos", "body_quat", "body_ipos", "body_iquat"),
    *("jnt_pos", "jnt_axis", "dof_armature", "tendon_armature", "tendon_stiffness"),
    *("geom_size", "geom_pos", "geom_quat", "site_pos", "site_quat", "actuator_gear"),
}
Bound = Mapping[str, "str | Scaled | Sequence[str | Scaled]"]


@dataclass(frozen=True)
class Scaled:
    """A location whose value is multiplied by the feature: 1 keeps the model's value.

    - `path`: the path of the location, as in `bind`: `"body/torso/mass"`.
    """

    path: str


@dataclass(frozen=True)
class Binding:
    """A feature together with the location that it sets."""

    feature: str
    location: Location
    scaled: bool = False


@dataclass(frozen=True, eq=False)
class Bindings:
    """All bindings of a system, grouped by the kind of location; made by `resolve_bindings`."""

    model: Model
    parameters: tuple[Binding, ...]
    state: tuple[Binding, ...]
    applied: tuple[Binding, ...]
    # The bodies whose mass and inertia come from geoms that features change.
    solids: tuple[SolidBody, ...]
    # MJX models and blank data, by their precision: True in float64.
    models: dict[Any, Any] = field(default_factory=dict, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "models": {}}

    @property
    def all(self) -> tuple[Binding, ...]:
        """Every binding."""
        return self.parameters + self.state + self.applied

    @cached_property
    def arrays(self) -> frozenset[str]:
        """The model's arrays that differ between rows, including derived ones."""
        changed = {binding.location.array for binding in self.parameters}
        if changed & {"geom_size", "geom_pos", "geom_quat", GEOM_MASS} and self.solids:
            changed |= {"body_mass", "body_inertia", "body_ipos", "body_iquat"}
        changed.discard(GEOM_MASS)
        if "body_mass" in changed:
            changed.add("body_inertia")
        return frozenset(changed)

    @cached_property
    def moves_constants(self) -> bool:
        """True if constants that MuJoCo derives from the model differ between rows."""
        return bool(self.arrays & _DERIVED_FROM)

    def leaves(self, features: Mapping[str, Any]) -> dict[str, Float[Array, "..."]]:
        """Return the model's arrays for this row of features, in the model's shapes.

        Geometry is computed first, then masses with inertia, then the bound values.
        """
        ordered = ("geom_size", "geom_pos", "geom_quat", GEOM_MASS)
        groups = [
            [b for b in self.parameters if b.location.array in ordered],
            [b for b in self.parameters if b.location.array == "body_mass"],
            [b for b in self.parameters if b.location.array not in (*ordered, "body_mass")],
        ]
        bound = self.arrays | {binding.location.array for binding in groups[0]}
        leaves = {name: jnp.asarray(self._base(name), _float()) for name in sorted(bound)}
        leaves = _set(leaves, groups[0], features, self._base)
        leaves = recompute_inertia(self.model.compiled, self.solids, leaves)
        leaves.pop(GEOM_MASS, None)
        before = leaves.get("body_mass")
        leaves = _set(leaves, groups[1], features, self._base)
        if before is not None:
            ratio = leaves["body_mass"] / jnp.where(before > 0, before, 1.0)
            leaves["body_inertia"] = (
                leaves["body_inertia"] * jnp.where(before > 0, ratio, 1.0)[:, None]
            )
        return _set(leaves, groups[2], features, self._base)

    def start(
        self, features: Mapping[str, Any],
        begin: Mapping[str, Float[Array | np.ndarray, " k"]] | None = None,
    ) -> dict[str, Float[Array, " k"]]:  # fmt: skip
        """Return `qpos`, `qvel` and `act` at time 0, and the positions of mocap bodies if bound.

        - `begin`: their values if no feature sets them; those of the model's keyframe if None.
        """
        known = self.model.begin if begin is None else begin
        bound = {"qpos", "qvel", "act"} | {b.location.array for b in self.state} | set(known)
        values = {
            name: jnp.asarray(known.get(name, self._base(name)), _float())
            for name in STATE
            if name in bound
        }
        return _set(values, self.state, features, self._base)

    def applied_at(
        self, features: Mapping[str, Any], time: Float[Array, ""]
    ) -> dict[str, Float[Array, "..."]]:
        """Return the forces and controls that features apply from `time` on, by array name."""
        compiled = self.model.compiled
        shapes = {"ctrl": (compiled.nu,), "xfrc_applied": (compiled.nbody, 6)}
        shapes["qfrc_applied"] = (compiled.nv,)
        bound = {binding.location.array for binding in self.applied}
        values = {name: jnp.zeros(shapes[name], _float()) for name in APPLIED if name in bound}
        if "ctrl" in values and "ctrl" in self.model.begin:
            values["ctrl"] = jnp.asarray(self.model.begin["ctrl"], _float())
        given = {binding.feature: features[binding.feature] for binding in self.applied}
        now = {name: value(time) if is_waveform(value) else value for name, value in given.items()}
        return _set(values, self.applied, now, self._base)

    def check(self, features: Mapping[str, Any]) -> None:
        """Refuse features that the bindings do not fit.

        **Raises:** `ValueError` for a bound feature that does not exist or has another shape than
        its location, and for a `Signal` bound to a constant.
        """
        for binding in self.all:
            check_names(f"feature bound to {binding.location.path!r}:", [binding.feature], features)
            value, path = features[binding.feature], binding.location.path
            if is_waveform(value):
                if binding not in self.applied:
                    raise ValueError(
                        f"feature {binding.feature!r} is a Signal, which can only drive a force, a "
                        f"torque or a control; it is bound to {path!r}"
                    )
                shape = np.shape(value.knots)[1:]
            elif isinstance(value, Mapping | list | tuple):
                raise ValueError(
                    f"feature {binding.feature!r} has several parts; bind needs a number or an "
                    "array"
                )
            else:
                shape = np.shape(value)
            if shape not in ((), binding.location.shape) or (shape == () != binding.location.shape):
                raise ValueError(
                    f"feature {binding.feature!r} has shape {list(shape)}, but {path!r} has "
                    f"{list(binding.location.shape)}{_one_of(path, shape, binding.location)}"
                )

    def _base(self, array: str) -> np.ndarray:
        compiled = self.model.compiled
        if array in ("qpos", "qvel", "act"):
            return (
                compiled.qpos0
                if array == "qpos"
                else np.zeros(compiled.nv if array == "qvel" else compiled.na)
            )
        if array in ("mocap_pos", "mocap_quat"):
            value = compiled.body_pos if array == "mocap_pos" else compiled.body_quat
            bodies = np.flatnonzero(compiled.body_mocapid >= 0)
            return value[bodies[np.argsort(compiled.body_mocapid[bodies])]]
        if array == GEOM_MASS:
            return masses_of_geoms(compiled, self.solids)
        owner, name = (compiled.opt, array[4:]) if array.startswith("opt.") else (compiled, array)
        return np.asarray(getattr(owner, name), np.float64)


def resolve_bindings(model: Model, bind: Bound | None) -> Bindings:
    """Resolve the `bind` argument of a system.

    **Raises:** the errors of `model.locate`; `ValueError` for two features bound to one number, or
    a factor for a value that the model does not have.
    """
    sorted_: dict[str, list[Binding]] = {"parameters": [], "state": [], "applied": []}
    taken: dict[tuple[str, int], str] = {}
    for feature, targets in (bind or {}).items():
        for target in [targets] if isinstance(targets, str | Scaled) else targets:
            path = target.path if isinstance(target, Scaled) else target
            for where in locate(model.compiled, path):
                group = "state" if where.array in STATE else "parameters"
                group = "applied" if where.array in APPLIED else group
                if isinstance(target, Scaled) and group != "parameters":
                    raise ValueError(
                        f"Scaled({path!r}): the model has no value there to multiply; bind it as "
                        "it is"
                    )
                _claim(taken, where, feature)
                sorted_[group].append(Binding(feature, where, isinstance(target, Scaled)))
    parameters, state, applied = (tuple(group) for group in sorted_.values())
    masses = {
        int(i): b.location.path
        for b in parameters
        if b.location.array == GEOM_MASS
        for i in b.location.index
    }
    changed = _rows(parameters, "geom_size", "geom_pos", "geom_quat")
    solids = bodies_of_geoms(model, changed, masses)
    model = free_centres_of_mass(model, _moving_bodies(model, parameters, solids))
    return Bindings(model, parameters, state, applied, solids)


def _rows(parameters: Iterable[Binding], *arrays: str) -> set[int]:
    """Return the rows of these arrays that features change."""
    return {
        int(i) // (4 if binding.location.array.endswith("quat") else 3)
        for binding in parameters
        if binding.location.array in arrays
        for i in binding.location.index
    }


def _moving_bodies(
    model: Model, parameters: Iterable[Binding], solids: Iterable[SolidBody]
) -> set[int]:
    """Return the bodies whose centre of mass or axes features move."""
    joints = _rows(parameters, "jnt_pos", "jnt_axis")
    placed = _rows(parameters, "geom_pos", "geom_quat")
    moving = _rows(parameters, "body_ipos", "body_iquat")
    moving |= {int(model.compiled.jnt_bodyid[joint]) for joint in joints}
    return moving | {s.body for s in solids if len(s.geoms) > 1 or placed & set(s.geoms)}


def _claim(taken: dict[tuple[str, int], str], where: Location, feature: str) -> None:
    for i in where.index.tolist():
        other = taken.setdefault((where.array, i), feature)
        if other != feature:
            raise ValueError(f"features {other!r} and {feature!r} are both bound to {where.path!r}")


def _set(
    arrays: dict[str, Any], bound: Iterable[Binding], features: Mapping[str, Any],
    base: Callable[[str], np.ndarray],
) -> dict[str, Any]:  # fmt: skip
    arrays = dict(arrays)
    for binding in bound:
        where = binding.location
        array = arrays[where.array]
        value = jnp.asarray(features[binding.feature], array.dtype) * where.sign
        if binding.scaled:
            # Of the value there is: a size may have changed the mass already.
            value = value * array.ravel()[where.index].reshape(where.shape) * where.sign
        flat = array.ravel().at[where.index].set(jnp.broadcast_to(value, where.index.shape))
        arrays[where.array] = flat.reshape(array.shape)
    return arrays


def _one_of(path: str, shape: tuple[int, ...], where: Location) -> str:
    if shape == () and where.shape:
        return f"; bind one of its numbers, like '{path}[0]'"
    return ""


def _float() -> Any:
    return jnp.result_type(float)


class RecordingFeatures(dict[str, Any]):
    """Features that record which of them are used."""

    def __init__(self, features: Mapping[str, Any], read: set[str]) -> None:
        super().__init__(features)
        self.read = read

    def __getitem__(self, name: str) -> Any:
        self.read.add(name)
        return super().__getitem__(name)

    def get(self, name: str, default: object = None) -> Any:
        """Return as `dict.get` does."""
        if name in self:
            self.read.add(name)
        return super().get(name, default)

    def __contains__(self, name: object) -> bool:
        if super().__contains__(name):
            self.read.add(str(name))
        return super().__contains__(name)

    def __iter__(self) -> Any:
        self.read.update(super().keys())
        return super().__iter__()

    def keys(self) -> Any:
        """Return all names, recording all features as used."""
        self.read.update(super().keys())
        return super().keys()

    def values(self) -> Any:
        """Return all values, recording all features as used."""
        self.read.update(super().keys())
        return super().values()

    def items(self) -> Any:
        """Return all items, recording all features as used."""
        self.read.update(super().keys())
        return super().items()
