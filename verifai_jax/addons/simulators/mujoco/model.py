"""A MuJoCo model, read from a file, a text or an object, and compiled.

    model = load("envs/mujoco_cartpole.xml")

MuJoCo is imported when a model is loaded, not before.
"""

import contextlib
import copy
import io
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from verifai_jax.addons.simulators.mujoco.part_paths import MjModel, names
from verifai_jax.core.messages.errors import require, unknown_name
from verifai_jax.core.store.foreign_files import open_file, read_bytes
from verifai_jax.core.user_code.user_files import file_hash

MAX_FILES = 200
"""Files of one model at most."""
_MODELS = (".xml", ".mjcf", ".urdf")
"""Endings of files that describe a model and refer to further files."""
_REFERENCE = re.compile(r"""\b(?:file|file\w+|filename)\s*=\s*["']([^"']+)["']""")
_FOLDER = re.compile(r"""\b(?:meshdir|texturedir|assetdir)\s*=\s*["']([^"']+)["']""")

ModelSource: TypeAlias = Any
"""The path of an MJCF file, its text, a `mujoco.MjSpec` or a `mujoco.MjModel`."""
MjSpec: TypeAlias = Any
"""A `mujoco.MjSpec`."""
MjxModel: TypeAlias = Any
"""A `mujoco.mjx.Model`."""
MjxData: TypeAlias = Any
"""A `mujoco.mjx.Data`."""


@dataclass(frozen=True, eq=False)
class Model:
    """A compiled model, and the spec from which it was compiled, if there was one.

    - `source_files`: the files from which it was read, with their hashes at that time.
    - `begin`: arrays of the initial keyframe, by name; none without a keyframe.
    - `notes`: sentences on changes made to the model.
    """

    compiled: Any
    spec: Any = None
    contact_sensors: tuple[str, ...] = ()
    source_files: Mapping[str, str] = field(default_factory=dict)
    begin: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __getstate__(self) -> dict[str, Any]:
        # A spec cannot be pickled, and is compiled by now. The compiled model is sent bit by bit.
        return {**self.__dict__, "spec": None}


def load(
    source: ModelSource, contacts: tuple[str, ...] = (), keyframe: str | int | None = None,
    **options: int | None,
) -> Model:  # fmt: skip
    """Read and compile a model.

    **Arguments:**
    - `source`: the path of an MJCF file, its text, an `mujoco.MjSpec`, or an `mujoco.MjModel`.
    - `contacts`: paths `contact/GEOM` and `contact/GEOM/GEOM`, for each of which a sensor is added
      after the model's own.
    - `keyframe`: name or number of the keyframe in which simulations start.
    - `options`: values for fields of the model's options; None leaves a field unchanged.
    **Raises:** `MissingExtra` without MuJoCo; `FileNotFoundError`; `ValueError` for a text that is
    not a model, for contacts of an `MjModel`, to which no sensors can be added, and for a keyframe
    that the model lacks.
    """
    mujoco = require("mujoco", extra="mujoco")
    if isinstance(source, mujoco.MjModel):
        if contacts:
            raise ValueError(
                f"signal {contacts[0]!r} needs a sensor, which cannot be added to a compiled "
                "MjModel: give the MJCF file, its text or an MjSpec instead"
            )
        spec, compiled = None, copy.copy(source)
    else:
        spec, plain = _spec(mujoco, source)
        for k, path in enumerate(contacts):
            _add_contact_sensor(mujoco, spec, plain, path, f"__contact{k}")
        compiled = spec.compile() if contacts else plain
    for name, value in options.items():
        if value is not None:
            setattr(compiled.opt, name, value)
    # A simulation that becomes NaN must be seen, not silently begin again.
    compiled.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    sensors = tuple(f"__contact{k}" for k in range(len(contacts)))
    begin = {} if keyframe is None else _keyframe(compiled, keyframe)
    notes = tuple(_clear_idle_flags(mujoco, compiled))
    return Model(compiled, spec, sensors, _hashes_of_files(source), begin, notes)


def _clear_idle_flags(mujoco: ModuleType, compiled: MjModel) -> Iterator[str]:
    """Clear the flags that change no step and that MJX refuses; yield a sentence for each."""
    for name in ("mjENBL_ENERGY", "mjENBL_FWDINV"):
        flag = int(getattr(mujoco.mjtEnableBit, name))
        if compiled.opt.enableflags & flag:
            compiled.opt.enableflags &= ~flag
            yield f"the model's flag {name} is cleared: it changes no step, and MJX refuses it"


def _keyframe(compiled: MjModel, keyframe: str | int) -> dict[str, np.ndarray]:
    """Return the arrays of a keyframe."""
    known = names(compiled, "key")
    if isinstance(keyframe, str):
        if keyframe not in known:
            raise unknown_name("keyframe", keyframe, known)
        number = int(compiled.key(keyframe).id)
    else:
        number = keyframe
        if (
            isinstance(number, bool)
            or not isinstance(number, int)
            or not 0 <= number < compiled.nkey
        ):
            raise ValueError(
                f"keyframe must be a name or a number from 0 to {compiled.nkey - 1}; got "
                f"{keyframe!r}"
                if compiled.nkey
                else f"the model has no keyframe; got keyframe={keyframe!r}"
            )
    arrays = {
        name: getattr(compiled, f"key_{name}")[number] for name in ("qpos", "qvel", "act", "ctrl")
    }
    if compiled.nmocap:
        arrays["mocap_pos"] = compiled.key_mpos[number].reshape(-1, 3)
        arrays["mocap_quat"] = compiled.key_mquat[number].reshape(-1, 4)
    return {name: np.array(value) for name, value in arrays.items()}


def _hashes_of_files(source: ModelSource) -> dict[str, str]:
    """Return the hashes of the files of a model by their paths; none of one that is in no file."""
    if not isinstance(source, str | Path) or "<" in str(source):
        return {}
    file = Path(source).absolute()
    return {str(each): file_hash(each) for each in (file, *files_referred_to(file))}


def free_centres_of_mass(model: Model, bodies: Collection[int]) -> Model:
    """Return the same model compiled so that these bodies' centres of mass can move.

    MuJoCo omits parts of the mass matrix that are zero when compiled ("simple" bodies).

    **Raises:** `ValueError` if there is no spec to compile again.
    """
    mujoco = require("mujoco", extra="mujoco")
    old = model.compiled
    simple = [body for body in bodies if old.body_simple[body]]
    if not simple:
        return model
    if model.spec is None or int(model.spec.compiler.inertiafromgeom) == 1:
        raise ValueError(
            f"the centre of mass of body {old.body(simple[0]).name!r} lies at its origin, which "
            "MuJoCo fixes when it compiles: give the MJCF, without inertiafromgeom, not an MjModel"
        )
    spec = model.spec.copy()
    for body in spec.bodies:
        if body.id in simple:
            body.explicitinertial = True
            body.mass, body.inertia = old.body_mass[body.id], old.body_inertia[body.id]
            body.ipos = old.body_ipos[body.id] + np.array([1e-2, 2e-2, 3e-2])
            body.iquat = old.body_iquat[body.id]
    new = spec.compile()
    for name in ("mass", "inertia", "ipos", "iquat"):
        getattr(new, f"body_{name}")[:] = getattr(old, f"body_{name}")
    for name in ("iterations", "ls_iterations", "disableflags", "enableflags"):
        setattr(new.opt, name, getattr(old.opt, name))
    mujoco.mj_setConst(new, mujoco.MjData(new))
    return replace(model, compiled=new)


def mjx_module() -> Any:
    """Import the module `mujoco.mjx`, without its messages about optional packages.

    **Raises:** `MissingExtra`.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        return require("mujoco.mjx", extra="mujoco")


def _spec(mujoco: ModuleType, source: ModelSource) -> tuple[Any, Any]:
    """Return a specification of its own, and the model that it is compiled to."""
    spec: Any = source
    given = isinstance(source, mujoco.MjSpec)
    if not given and not isinstance(source, str | Path):
        raise ValueError(
            "a MuJoCo model is the path of an MJCF file, its text, an MjSpec or an MjModel; "
            f"got {type(source).__name__}"
        )
    try:
        if given:
            spec = spec.copy()
        elif "<" in str(source):
            spec = mujoco.MjSpec.from_string(str(source))
        else:
            if not Path(source).exists():
                raise FileNotFoundError(f"there is no MJCF file {str(source)!r}")
            open_file(source).close()
            spec = mujoco.MjSpec.from_file(str(source))
        return spec, spec.compile()
    except ValueError as error:
        where = "the MjSpec" if given else "MJCF text" if "<" in str(source) else str(source)
        words = " ".join(str(error).split())
        raise ValueError(f"{where} is not a MuJoCo model: {words}") from error


def _add_contact_sensor(
    mujoco: ModuleType, spec: MjSpec, model: MjModel, path: str, name: str
) -> None:
    first, second = _contact_geoms(model, path)
    geom, count = mujoco.mjtObj.mjOBJ_GEOM, 1
    pair = {} if second is None else {"reftype": geom, "refname": second}
    spec.add_sensor(
        name=name,
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=geom,
        objname=first,
        intprm=[count, 0, 1],  # The number of contacts that match.
        **pair,
    )


def _contact_geoms(model: MjModel, path: str) -> tuple[str, str | None]:
    parts, known = path.split("/")[1:], names(model, "geom")
    if "/".join(parts) in known:
        return "/".join(parts), None
    # Names may have slashes in them.
    for cut in range(1, len(parts)):
        first, second = "/".join(parts[:cut]), "/".join(parts[cut:])
        if first in known and second in known:
            return first, second
    wrong = next((part for part in parts if part not in known), path)
    raise unknown_name(f"geom in {path!r}: geom", wrong, known)


def files_referred_to(model: Path) -> list[Path]:
    """Return the files to which an XML model refers: includes, meshes, textures, height fields.

    **Arguments:**
    - `model`: the model's file; a file that is not a model refers to none.
    """
    found: dict[Path, None] = {}
    waiting, folders = [model.resolve()], {model.resolve().parent: None}
    while waiting and len(found) < MAX_FILES:
        file = waiting.pop()
        if file.suffix.lower() not in _MODELS:
            continue
        try:
            text = read_bytes(file).decode("utf-8", "replace")
        except OSError:
            continue
        folders[file.parent] = None
        for name in _FOLDER.findall(text):
            folders[(file.parent / name).resolve()] = None
        for name in _REFERENCE.findall(text):
            name = name.removeprefix("package://").removeprefix("file://")
            for folder in tuple(folders):
                path = (folder / name).resolve()
                if path != model.resolve() and path not in found and path.is_file():
                    found[path] = None
                    waiting.append(path)
    return list(found)
