"""The names of a model's parts: `"body/pole/mass"`, `"option/gravity[2]"`.

    locate(model.compiled, "geom/floor/friction[0]")       # which numbers of the model that is
    reading(model.compiled, "joint/hinge/qpos")           # which numbers of a state that is

A path is `kind/name/field`, with an index `[i]` or a slice `[i:j]` where a field has several
numbers.
"""

import re
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from verifai_jax.core.messages.errors import require, unknown_name

MjModel: TypeAlias = Any
"""A `mujoco.MjModel`; MuJoCo is an optional package, so its types cannot be imported here."""
# Where the numbers of one element lie in an array: at its id, its degrees of freedom, its part of
# qpos, or in some columns of its row.
_BODY = {name: f"body_{name}" for name in ("mass", "inertia", "pos", "quat", "ipos", "iquat")}
_GEOM_FIELDS = ("size", "pos", "quat", "friction", "margin", "gap", "solref", "solimp", "solmix")
_GEOM = {name: f"geom_{name}" for name in _GEOM_FIELDS}
_JOINT_DOF = {name: f"dof_{name}" for name in ("damping", "armature", "frictionloss")}
_JOINT = {name: f"jnt_{name}" for name in ("stiffness", "range", "pos", "axis", "solref", "solimp")}
_SITE = {"pos": "site_pos", "quat": "site_quat"}
_ACTUATOR = {
    name: f"actuator_{name}"
    for name in ("gear", "gainprm", "biasprm", "dynprm", "ctrlrange", "forcerange")
}
_TENDON = {
    name: f"tendon_{name}"
    for name in ("stiffness", "damping", "armature", "frictionloss", "range", "lengthspring")
}
_EQUALITY = {"solref": "eq_solref", "solimp": "eq_solimp", "data": "eq_data"}
_PAIR = {
    name: f"pair_{name}"
    for name in ("friction", "margin", "gap", "solref", "solreffriction", "solimp")
}
_OPTION = ("gravity", "wind", "magnetic", "density", "viscosity", "impratio")
KINDS = ("body", "joint", "geom", "site", "actuator", "tendon", "equality", "pair")
GEOM_MASS = "geom_mass"
"""The masses of geoms, `[ngeom]`, of which MuJoCo keeps only what they add up to in their body."""
# What can be set, in addition to parameters of the model: the state at time 0, and what acts on it.
_INPUTS = {
    "body": ("force", "torque"),
    "geom": ("mass",),
    "joint": ("qpos", "qvel", "springref", "force"),
    "actuator": ("kp", "kv", "ctrl", "act"),
}
_FIELDS = {
    "body": _BODY,
    "geom": _GEOM,
    "joint": {**_JOINT_DOF, **_JOINT},
    "site": _SITE,
    "actuator": _ACTUATOR,
    "tendon": _TENDON,
    "equality": _EQUALITY,
    "pair": _PAIR,
}
# What can be read of a state, by kind: the name in a path, and that in MjData.
_READINGS = {
    "joint": {"qpos": "qpos", "qvel": "qvel"},
    "body": {"xpos": "xpos", "xquat": "xquat", "xipos": "xipos", "subtree_com": "subtree_com"},
    "geom": {"xpos": "geom_xpos"},
    "site": {"xpos": "site_xpos"},
    "actuator": {"length": "actuator_length", "act": "act", "ctrl": "ctrl"},
    "tendon": {"length": "ten_length"},
}
_PATH = re.compile(r"^(?P<kind>[^/\[\]]+)/(?P<rest>.+?)(\[(?P<index>[^\]]*)\])?$")


@dataclass(frozen=True)
class Location:
    """The location of numbers in one array.

    - `array`: its name in MjModel or MjData; `"opt.gravity"` is one of the model's options.
    - `index`: flat indices `[k]` into the array.
    - `shape`: `()` for one number, else `(k,)`.
    - `sign`: factor between the value and each number.
    """

    array: str
    index: np.ndarray
    shape: tuple[int, ...]
    path: str
    sign: float = 1.0

    def __post_init__(self) -> None:
        # JAX keeps what it traced of an index; one of 64 bits would not be the same in float32.
        object.__setattr__(self, "index", self.index.astype(np.int32))


def names(model: MjModel, kind: str) -> list[str]:
    """Return the names of all elements of a kind that have one."""
    mujoco = require("mujoco", extra="mujoco")
    code = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    count = {
        "body": "nbody",
        "joint": "njnt",
        "geom": "ngeom",
        "site": "nsite",
        "actuator": "nu",
        "tendon": "ntendon",
        "equality": "neq",
        "pair": "npair",
        "sensor": "nsensor",
        "key": "nkey",
    }[kind]
    every = (mujoco.mj_id2name(model, code, i) for i in range(getattr(model, count)))
    return [name for name in every if name]


def locate(model: MjModel, path: str) -> list[Location]:
    """Return the locations that a bound path sets.

    **Raises:** `UnknownNameError` for an unknown kind, element or field, with the nearest ones;
    `ValueError` for an index outside the field.
    """
    kind, name, field, index = _split(path, (*KINDS, "option"))
    if kind == "option":
        if field not in _OPTION:
            raise unknown_name(f"option in {path!r}: option", field, _OPTION)
        value = np.asarray(getattr(model.opt, field))
        return [_pick(path, f"opt.{field}", np.arange(value.size), index)]
    fields = [*_FIELDS[kind], *_INPUTS.get(kind, ())]
    element = _element(model, kind, name, path)
    if field not in fields:
        raise unknown_name(f"field of a {kind} in {path!r}: field", field, fields)
    if kind == "body" and field in ("pos", "quat") and model.body_mocapid[element] >= 0:
        # Where a mocap body is belongs to the state: what the model has is where it begins.
        width = 3 if field == "pos" else 4
        where = int(model.body_mocapid[element]) * width + np.arange(width)
        return [_pick(path, f"mocap_{field}", where, index)]
    if field in _FIELDS[kind]:
        array = _FIELDS[kind][field]
        rows = _dofs(model, element) if array.startswith("dof_") else np.array([element])
        return [_pick(path, array, _flat(getattr(model, array), rows), index)]
    return _locate_input(model, kind, field, element, path, index)


def _locate_input(
    model: MjModel, kind: str, field: str, element: int, path: str, index: str | None
) -> list[Location]:
    if kind == "body":
        start = 6 * element + (3 if field == "torque" else 0)
        return [_pick(path, "xfrc_applied", start + np.arange(3), index)]
    if kind == "geom":
        return [_pick(path, GEOM_MASS, np.array([element]), index)]
    if kind == "joint":
        if field in ("qpos", "springref"):
            array = "qpos" if field == "qpos" else "qpos_spring"
            return [_pick(path, array, _positions(model, element), index)]
        array = "qvel" if field == "qvel" else "qfrc_applied"
        return [_pick(path, array, _dofs(model, element), index)]
    if field == "ctrl":
        return [_pick(path, "ctrl", np.array([element]), index)]
    if field == "act":
        return [_pick(path, "act", _activations(model, element, path), index)]
    # A position servo is gain kp and bias -kp; a damped one also has bias -kv.
    gain, bias = model.actuator_gainprm.shape[1], model.actuator_biasprm.shape[1]
    if model.actuator_biastype[element] != 1:
        raise ValueError(
            f"{path!r}: kp and kv are those of a servo (position, velocity, intvelocity); "
            "this actuator has gear and gainprm"
        )
    column, sets_gain = (1, True) if field == "kp" else (2, model.actuator_biasprm[element, 1] == 0)
    locations = [Location("actuator_biasprm", np.array([element * bias + column]), (), path, -1.0)]
    if sets_gain:
        locations.append(Location("actuator_gainprm", np.array([element * gain]), (), path))
    return locations


def reading(model: MjModel, path: str) -> Location:
    """Return the location in the state of a signal's path."""
    kind, name, field, index = _split(path, (*_READINGS, "sensor", "contact"))
    if kind == "sensor":
        whole = path.removeprefix("sensor/")
        name = whole[: whole.rindex("[")] if index is not None else whole
        return _pick(path, "sensordata", sensor_addresses(model, name, path), index)
    fields = _READINGS[kind]
    element = _element(model, kind, name, path)
    if field not in fields:
        raise unknown_name(f"signal of a {kind} in {path!r}: signal", field, fields)
    array = fields[field]
    if field in ("qpos", "qvel"):
        where = (_positions if field == "qpos" else _dofs)(model, element)
    elif field == "act":
        where = _activations(model, element, path)
    else:
        width = {"xquat": 4}.get(array, 1 if array.endswith(("length", "ctrl")) else 3)
        where = element * width + np.arange(width)
    return _pick(path, array, where, index)


def sensor_addresses(model: MjModel, name: str, path: str) -> np.ndarray:
    """Return the indices `[k]` of a sensor in `sensordata`."""
    known = names(model, "sensor")
    if name not in known:
        raise unknown_name(f"sensor in {path!r}: sensor", name, known)
    sensor = model.sensor(name)
    return int(sensor.adr[0]) + np.arange(int(sensor.dim[0]))


def _split(path: str, kinds: tuple[str, ...]) -> tuple[str, str, str, str | None]:
    match = _PATH.match(path) if isinstance(path, str) else None
    if match is None:
        raise ValueError(
            f"a part of the model is written kind/name/field, like 'body/torso/mass'; got {path!r}"
        )
    kind, rest, index = match["kind"], match["rest"], match["index"]
    if kind not in kinds:
        raise unknown_name(f"kind in {path!r}: kind", kind, kinds)
    if kind in ("option", "sensor", "contact"):
        return kind, "", rest, index
    name, slash, field = rest.rpartition("/")
    if not slash:
        raise ValueError(f"{path!r} lacks a field: write {kind}/{rest}/FIELD")
    return kind, name, field, index


def _element(model: MjModel, kind: str, name: str, path: str) -> int:
    known = names(model, kind)
    if name not in known:
        raise unknown_name(f"{kind} in {path!r}: {kind}", name, known)
    return int(getattr(model, kind)(name).id)


def _positions(model: MjModel, joint: int) -> np.ndarray:
    width = (7, 4, 1, 1)[model.jnt_type[joint]]
    return int(model.jnt_qposadr[joint]) + np.arange(width)


def _dofs(model: MjModel, joint: int) -> np.ndarray:
    width = (6, 3, 1, 1)[model.jnt_type[joint]]
    return int(model.jnt_dofadr[joint]) + np.arange(width)


def _activations(model: MjModel, actuator: int, path: str) -> np.ndarray:
    if model.actuator_actnum[actuator] < 1:
        raise ValueError(f"{path!r}: this actuator has no activation state")
    start = int(model.actuator_actadr[actuator])
    return start + np.arange(int(model.actuator_actnum[actuator]))


def _flat(array: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return np.arange(array.size).reshape(array.shape)[rows].ravel()


def _pick(path: str, array: str, where: np.ndarray, index: str | None) -> Location:
    """Return the location of those numbers of an element that an index or a slice selects."""
    if index is None:
        return Location(array, where, () if where.size == 1 else (where.size,), path)
    try:
        if ":" in index:
            first, last = (int(end) if end.strip() else None for end in index.split(":"))
            part = where[first:last]
            if part.size == 0:
                raise IndexError
            return Location(array, part, (part.size,), path)
        number = int(index)
        if not 0 <= number < where.size:
            raise IndexError
        return Location(array, where[[number]], (), path)
    except (IndexError, ValueError):
        raise ValueError(
            f"{path!r}: [{index}] is not part of it; its indices are 0 to {where.size - 1}"
        ) from None
