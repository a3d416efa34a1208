"""Paths to the parts of a Brax environment, and copies of it with parts set.

location = system_location(env, "link.inertia.mass[pole]", "hopper")
env = with_system(env, with_value(env.unwrapped.sys, location, 2.0, "mass"))
"""

import contextlib
import copy
import difflib
import importlib.metadata
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Key

from verifai_jax.addons.simulators.environments.episode import used_inputs
from verifai_jax.core.messages.errors import UnknownNameError, require, unknown_name

Env: TypeAlias = Any
"""A `brax.envs.Env`; Brax is an optional package, so its types cannot be imported here."""
BraxSystem: TypeAlias = Any
"""A `brax.System`, or a part of one."""
# Arrays of MuJoCo by the beginnings of their names, and what their rows are called after.
_ROWS = {
    "body_": "mjOBJ_BODY",
    "geom_": "mjOBJ_GEOM",
    "site_": "mjOBJ_SITE",
    "jnt_": "mjOBJ_JOINT",
    "actuator_": "mjOBJ_ACTUATOR",
}


class Location(NamedTuple):
    """An array in a Brax system, or a row or one entry of it."""

    parts: tuple[str, ...]
    index: tuple[int, ...] | None

    def __str__(self) -> str:
        index = "" if self.index is None else f"[{', '.join(map(str, self.index))}]"
        return ".".join(self.parts) + index


@contextlib.contextmanager
def explain_errors(env: Env, name: str, what: str, backend: str | None = None) -> Iterator[None]:
    """Raise errors from inside Brax again, with the environment, the backend and the versions."""
    try:
        with warnings.catch_warnings():
            # Brax still uses names that MuJoCo has moved, and nobody can do anything about it.
            warnings.simplefilter("ignore", DeprecationWarning)
            # Each model that is loaded says that Brax's environments are no longer maintained.
            warnings.filterwarnings("ignore", message="Brax System")
            yield
    except (TypeError, ValueError, AttributeError, IndexError, KeyError, NotImplementedError) as e:
        with contextlib.suppress(Exception):
            backend = backend or env.backend
        versions = ", ".join(f"{p} {importlib.metadata.version(p)}" for p in ("mujoco", "jax"))
        on = f" on the backend {backend!r}" if backend else ""
        raise ValueError(
            f"{name}{on} does not work with brax {importlib.metadata.version('brax')}, {versions}: "
            f"its {what} raised {type(e).__name__}: {str(e).splitlines()[0] if str(e) else ''}"
        ) from e


def system_location(env: Env, path: str, name: str) -> Location:
    """Return the location of a path such as `link.inertia.mass[pole]` or `geom_friction[floor, 0]`.

    **Raises:** `UnknownNameError` for a part or an entry that does not exist; `ValueError` for an
    environment without `sys`, or a part without numbers.
    """
    sys = getattr(env.unwrapped, "sys", None)
    if sys is None:
        raise ValueError(
            f"{name} has no sys whose parts features could set: use "
            "configure=(env, features) -> env"
        )
    match = re.fullmatch(r"([\w.]+)(?:\[([^\]]+)\])?", path.strip())
    parts = tuple(match.group(1).split(".")) if match else (path,)
    leaf: Any = sys
    for part in parts:
        if not hasattr(leaf, part) or part.startswith("__"):
            known = _paths(sys)
            near = difflib.get_close_matches(".".join(parts), known, n=2, cutoff=0.5)
            hint = f"did you mean {' or '.join(map(repr, near))}?" if near else "it has no such."
            raise UnknownNameError(f"unknown part of the system of {name} {path!r}; {hint}")
        leaf = getattr(leaf, part)
    numeric = isinstance(leaf, jax.Array | np.ndarray | float | np.number)
    if not numeric or not jnp.issubdtype(jnp.result_type(leaf), jnp.inexact):
        raise ValueError(
            f"{'.'.join(parts)} of {name} holds no real numbers that a feature could set; "
            f"got {type(leaf).__name__}"
        )
    text = match.group(2) if match else None
    if text is None:
        return Location(parts, None)
    if np.ndim(leaf) == 0:
        raise ValueError(f"{'.'.join(parts)} of {name} is one number and has no entry {text!r}")
    row, *columns = (entry.strip() for entry in text.split(","))
    if len(columns) >= np.ndim(leaf):
        raise ValueError(
            f"{'.'.join(parts)} of {name} has shape {list(np.shape(leaf))}, and [{text}] names "
            f"{len(columns) + 1} indices"
        )
    index = [_row(row, parts, np.shape(leaf)[0], _row_names(sys, parts), name)]
    for axis, column in enumerate(columns, 1):
        index.append(_row(column, parts, np.shape(leaf)[axis], {}, name))
    return Location(parts, tuple(index))


def _paths(sys: BraxSystem) -> list[str]:
    return [
        ".".join(getattr(key, "name", str(key)) for key in path)
        for path, _ in jax.tree.leaves_with_path(sys)
    ]


def _row_names(sys: BraxSystem, parts: tuple[str, ...]) -> dict[str, int]:
    """Return the names of an array's rows and their indices, where they have names."""
    if parts[0] == "link":
        return {link: i for i, link in enumerate(sys.link_names)}
    kind = next((kind for start, kind in _ROWS.items() if parts[-1].startswith(start)), None)
    model = getattr(sys, "mj_model", None)
    if kind is None or model is None:
        return {}
    mujoco = require("mujoco", extra="brax")
    named = {}
    for i in range(len(getattr(sys, parts[0]))):
        if label := mujoco.mj_id2name(model, getattr(mujoco.mjtObj, kind), i):
            named[label] = i
    return named


def _row(text: str, parts: tuple[str, ...], length: int, named: dict[str, int], name: str) -> int:
    if text in named:
        return named[text]
    if not re.fullmatch(r"-?\d+", text):
        raise unknown_name(
            f"entry of {'.'.join(parts)} of {name}", text, named or map(str, range(length))
        )
    if not -length <= int(text) < length:
        raise ValueError(f"{'.'.join(parts)} of {name} has {length} entries; got the number {text}")
    return int(text) % length


def joint_location(env: Env, path: str, name: str) -> Location:
    """Return the location of a path such as `q[hinge]` in the initial `q` or `qd`."""
    match = re.fullmatch(r"(\w+)\[([^\]]+)\]", path.strip())
    part = match.group(1) if match else path
    if part not in ("q", "qd") or match is None:
        raise unknown_name(f"part of {name}'s initial state", path, ["q[0]", "qd[0]"])
    sys = env.unwrapped.sys
    length = sys.q_size() if part == "q" else sys.qd_size()
    named = {}
    model = getattr(sys, "mj_model", None)
    if model is not None:
        mujoco = require("mujoco", extra="brax")
        first = model.jnt_qposadr if part == "q" else model.jnt_dofadr
        # A joint of several numbers has no entry of its own.
        single = {int(kind) for kind in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)}
        for i in range(model.njnt):
            if int(model.jnt_type[i]) in single:
                named[mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, i)] = int(first[i])
    return Location((part,), (_row(match.group(2), (part,), length, named, name),))


def with_value(sys: BraxSystem, location: Location, value: ArrayLike, feature: str) -> Any:
    """Return the system with one array, or one entry of it, replaced."""
    old: Any = sys
    for part in location.parts:
        old = getattr(old, part)
    old = jnp.asarray(old)
    target = old if location.index is None else old[location.index]
    if jnp.shape(value) != target.shape:
        entry = (*(location.index or ()), *[0] * target.ndim)
        raise ValueError(
            f"feature {feature!r} has shape {list(jnp.shape(value))} and {location} has "
            f"{list(target.shape)}; name one entry, as in '{Location(location.parts, entry)}', or "
            "use configure=(sys, features) -> sys"
        )
    new = jnp.asarray(value, jnp.result_type(old, value))
    if location.index is not None:
        new = old.astype(new.dtype).at[location.index].set(new)
    return _replaced(sys, location.parts, new)


def _replaced(node: BraxSystem, parts: tuple[str, ...], value: ArrayLike) -> Any:
    if not parts:
        return value
    child = _replaced(getattr(node, parts[0]), parts[1:], value)
    return node.replace(**{parts[0]: child})


def with_system(env: Env, sys: BraxSystem) -> Any:
    """Return a copy of the environment, inside its wrappers, with another `sys`."""
    other = copy.copy(env)
    if "env" in vars(other) and "sys" not in vars(other):
        other.env = with_system(other.env, sys)
    else:
        other.sys = sys
    return other


def with_finer_step(env: Env, factor: int | Int[Array, ""], name: str) -> Any:
    """Return a copy of the environment whose physics step is divided by `factor`.

    JAX may trace the factor if `steps_plainly` is true for the environment.

    **Raises:** `ValueError` for an environment whose physics depends on the step.
    """
    other = copy.copy(env)
    if "env" in vars(other) and "sys" not in vars(other):
        other.env = with_finer_step(other.env, factor, name)
        return other
    frames, backend = getattr(other, "_n_frames", None), getattr(other, "_backend", None)
    if frames is None or not hasattr(getattr(other, "sys", None), "opt"):
        raise ValueError(f"{name} is not a PipelineEnv of Brax, whose step is known")
    if backend not in ("generalized", "mjx"):
        raise ValueError(
            f"{name} on Brax's backend {backend!r}: its constraints are as stiff as its step makes "
            "them, so that another step is another model"
        )
    sys = other.sys
    other.sys = sys.tree_replace({"opt.timestep": sys.opt.timestep / factor})
    other._n_frames = frames * factor
    if isinstance(factor, jax.Array):
        other.__class__ = _with_counted_frames(type(other))
    return other


def steps_plainly(env: Env) -> bool:
    """Return whether a step of the environment is Brax's own loop over physics frames."""
    pipeline = require("brax.envs.base", extra="brax").PipelineEnv
    kind = type(env.unwrapped)
    plain = getattr(kind, "pipeline_step", None) is getattr(pipeline, "pipeline_step", ...)
    return plain and "pipeline_step" not in vars(env.unwrapped)


@cache
def _with_counted_frames(kind: type) -> type:
    """Return the class of an environment whose number of frames JAX traces.

    Brax scans over the frames and must know their number.
    """

    def pipeline_step(self: Any, state: Any, action: Array) -> Any:
        def frame(_: Any, state: Any) -> Any:
            return self._pipeline.step(self.sys, state, action, self._debug)

        return jax.lax.fori_loop(0, self._n_frames, frame, state)

    return type(kind.__name__, (kind,), {"pipeline_step": pipeline_step})


def with_start(env: Env, values: Mapping[Location, ArrayLike]) -> Any:
    """Return a copy whose reset starts from these entries of `q` and `qd`, and observes them."""
    other = copy.copy(env)
    if "env" in vars(other) and "sys" not in vars(other):
        other.env = with_start(other.env, values)
        return other
    begin = other.pipeline_init

    def pipeline_init(
        q: Float[Array, " q"], qd: Float[Array, " qd"], *rest: Any, **options: Any
    ) -> Any:
        for location, value in values.items():
            if location.parts == ("q",):
                q = jnp.asarray(q).at[location.index].set(value)
            else:
                qd = jnp.asarray(qd).at[location.index].set(value)
        return begin(q, qd, *rest, **options)

    other.pipeline_init = pipeline_init
    return other


def check_parts_are_read(env: Env, name: str, locations: Mapping[str, Location]) -> None:
    """Refuse a part of the system that neither reset nor step reads, since it has no effect.

    Each backend reads its own copies of masses, gains and similar values.
    """
    if not locations:
        return
    sys = env.unwrapped.sys

    def leaf(location: Location) -> Any:
        value: Any = sys
        for part in location.parts:
            value = getattr(value, part)
        return jnp.asarray(value)

    def play(values: Sequence[Array], key: Key[Array, ""], action: Float[Array, " action"]) -> Any:
        changed = sys
        for location, value in zip(locations.values(), values, strict=True):
            changed = _replaced(changed, location.parts, value)
        played = with_system(env, changed)
        with explain_errors(env, name, "reset and step"):
            return jax.tree.leaves(played.step(played.reset(key), action))

    values = [leaf(location) for location in locations.values()]
    used = used_inputs(play, values, jax.random.key(0), jnp.zeros(env.action_size))
    for (feature, location), read_at_all in zip(locations.items(), used, strict=False):
        if not read_at_all:
            raise ValueError(
                f"feature {feature!r} sets {location}, which {name} on the backend {env.backend!r} "
                "does not read. The mjx backend reads MuJoCo's arrays (body_mass, dof_damping, "
                "...), the others mostly Brax's (link.inertia.mass, actuator.gear, ...)"
            )
