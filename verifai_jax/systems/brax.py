"""A Brax environment with a policy in the loop as a system.

    brax("inverted_pendulum", policy, steps=100, features={"pole": "link.inertia.mass[pole]"})
    brax("hopper", policy, backend="positional", duration=2.0, initial={"height": "q[1]"})
    brax(MyEnvironment(), policy, steps=50, signals=["x", "v"], dt=0.1)

The result is a pure function `(features, key) -> Trace` of one episode, which is never reset.
"""

import contextlib
import copy
import difflib
import importlib.metadata
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.errors import (
    MissingExtra,
    UnknownNameError,
    check_names,
    require,
    suggests_options,
    unknown_name,
)
from verifai_jax.systems.episode import (
    Episode,
    Moment,
    at_time,
    check_signals_option,
    deciding,
    inputs_used,
    period,
    read,
    rollout,
    step_count,
    varies,
    vector_action,
)
from verifai_jax.systems.structure import outline
from verifai_jax.trace import Trace
from verifai_jax.waveform import bound

OLDEST = (0, 14)
BACKENDS = ("generalized", "spring", "positional", "mjx")

# Arrays of MuJoCo by the beginnings of their names, and what their rows are called after.
_ROWS = {
    "body_": "mjOBJ_BODY",
    "geom_": "mjOBJ_GEOM",
    "site_": "mjOBJ_SITE",
    "jnt_": "mjOBJ_JOINT",
    "actuator_": "mjOBJ_ACTUATOR",
}


class Place(NamedTuple):
    """An array somewhere in a system, or one entry of it."""

    parts: tuple[str, ...]
    index: int | None

    def __str__(self) -> str:
        return ".".join(self.parts) + ("" if self.index is None else f"[{self.index}]")


@dataclass(frozen=True, eq=False)
class Brax:
    """A closed loop `(features, key) -> Trace`; made by `brax`, which says what its parts are."""

    env: Any
    name: str
    policy: Any
    policy_memory: Any
    steps: int
    dt: float
    features: Mapping[str, Place]
    configure: Callable[..., Any] | None
    initial: Mapping[str, Place] | Callable[..., Any] | None
    signals: Any

    @property
    def duration(self) -> float:
        """Simulated seconds."""
        return self.steps * self.dt

    @property
    def reverse_hint(self) -> str:
        """Why derivatives in reverse may not exist."""
        return (
            f"{self.name}: the constraint solver of Brax's mjx backend loops until it converges; "
            "spring and positional take a fixed number of steps"
        )

    def __call__(self, features: Any, key: Any = None) -> Trace:
        """Simulate one episode, not reset at its end."""
        features = bound(features, self.duration)
        self._check(features)
        fixed = None if varies(features) else self._configured(features, 0.0)

        def env_at(time: Any) -> Any:
            return self._configured(features, time) if fixed is None else fixed

        def start(key: Any) -> Moment:
            env, now = env_at(0.0), at_time(features, 0.0)
            if callable(self.initial):
                return _moment(self.initial(env, now, key), self.name)
            if self.initial:
                env = _starting(env, {place: now[name] for name, place in self.initial.items()})
            with _explained(self.env, self.name, "reset"):
                return _moment(env.reset(key), self.name)

        def step(time: Any, state: Any, action: Any, key: Any) -> Moment:
            env = env_at(time)
            with _explained(self.env, self.name, "step"):
                return _moment(env.step(state, action), self.name)

        def see(time: Any, moment: Moment, action: Any) -> Any:
            now = at_time(features, time)
            return read(self.signals, moment, action, now, _named(moment.state), self.name)

        decide, size = deciding(self.policy, self.policy_memory), self.env.action_size

        def fitting(observation: Any, memory: Any, key: Any) -> Any:
            action, memory = decide(observation, memory, key)
            return vector_action(action, size, self.name), memory

        return rollout(
            Episode(self.name, start, step, fitting, self.policy_memory, see, self.steps, self.dt),
            key,
        )

    def _configured(self, features: Any, time: Any) -> Any:
        """The environment under the features of an instant."""
        now, env = at_time(features, time), self.env
        if self.features:
            sys = env.unwrapped.sys
            for name, place in self.features.items():
                sys = _with(sys, place, now[name], name)
            env = _with_system(env, sys)
        if self.configure is None:
            return env
        if not hasattr(env.unwrapped, "sys"):
            configured = self.configure(copy.copy(env), now)
            if not hasattr(configured, "step"):
                raise ValueError(
                    f"configure must return the environment {self.name}, which has no sys of its "
                    f"own; got {outline(configured)}"
                )
            return configured
        sys = self.configure(env.unwrapped.sys, now)
        if not isinstance(sys, type(env.unwrapped.sys)):
            raise ValueError(
                f"configure must return the sys of {self.name}, a "
                f"{type(env.unwrapped.sys).__name__}; got {outline(sys)}"
            )
        return _with_system(env, sys)

    def _check(self, features: Any) -> None:
        """Refuse names of features that do not exist, and features that nothing would read."""
        initial = self.initial if isinstance(self.initial, Mapping) else {}
        if not isinstance(features, Mapping):
            if self.features or initial:
                raise ValueError(f"features must be a dictionary; got {outline(features)}")
            return
        check_names("feature", [*self.features, *initial], features)
        if any(map(callable, (self.configure, self.signals, self.initial))):
            return
        for name in features:
            if name not in self.features and name not in initial:
                raise ValueError(
                    f"feature {name!r} changes nothing in {self.name}: bind it by "
                    f"features={{{name!r}: part of the system}} or initial={{{name!r}: 'q[0]'}}"
                )


@suggests_options
def brax(
    env: Any,
    policy: Any,
    *,
    steps: int | None = None,
    duration: float | None = None,
    backend: str | None = None,
    features: Mapping[str, str] | Iterable[str] = (),
    configure: Callable[..., Any] | None = None,
    initial: Mapping[str, str] | Callable[..., Any] | None = None,
    signals: Mapping[str, Any] | Sequence[str] | Callable[..., Mapping[str, Any]] | None = None,
    dt: float | None = None,
    policy_memory: Any = None,
    options: Mapping[str, Any] | None = None,
) -> Brax:
    """A system `(features, key) -> Trace` from an environment of Brax and a policy.

    **Arguments:**

    - `env`: the name of an environment, or an `Env` of your own without training wrappers.
    - `policy`: `observation -> action`, or `(observation, key) -> action` for a random one; a
      function, or an object with a method `act`, such as an `rl.Policy`.
    - `steps`: of the episode at most, or `duration` in seconds. The trace has a sample after the
      reset and after each step, and its last valid sample is the one at which the environment is
      done.
    - `backend`: `"generalized"`, `"spring"`, `"positional"` or `"mjx"`, for an environment by name;
      its own default when left out.
    - `features`: which feature sets which part of the environment's `sys`, by attributes joined by
      dots: `{"gravity": "opt.gravity[2]", "mass": "link.inertia.mass[pole]"}`. An entry is named by
      its number; of a link (`link...`) or of MuJoCo's arrays (`body_...`, `geom_...`) also by the
      name that the model gives it. Nothing that was once derived from it is computed again.
    - `configure(sys, features) -> sys`: for anything else; for an environment without `sys`,
      `(env, features) -> env`, with a copy of it.
    - `initial`: which feature sets which entry of the initial position or velocity, by number or by
      the joint's name: `{"angle": "q[hinge]", "speed": "qd[0]"}`; the rest is as the environment's
      reset draws it. Or a function `(env, features, key) -> brax State`.
    - `signals`: names of all entries of the observation, or `{name: index or key of it}`; `action`
      and `reward` come along. Or a function `(state, observation, action, reward, features) ->
      dict`, whose state is Brax's. When left out: `q`, `qd`, the metrics, `observation`, `action`
      and `reward`, as far as they are scalars and vectors. An action of one number is a scalar.
    - `dt`: seconds of a step; `env.dt` when left out.
    - `policy_memory`: what a policy with memory remembers at first. It is then called
      `(observation, memory)` or `(observation, memory, key)` and returns `(action, memory)`.
    - `options`: keyword arguments of an environment by name.

    A `Signal` feature reaches `sys` and functions as its value at the beginning of the step.

    **Raises:** `MissingExtra` without brax, or with one that is too old; `UnknownNameError` for an
    unknown environment, backend or part; `ValueError` for a part that the backend does not read,
    and numbers that do not fit; once the system is traced, for a policy, a state or signals that
    do not, and for an environment that does not work with the installed versions.
    """
    _import("brax.envs")
    _check_version()
    if isinstance(env, str):
        name = env
        env = _made(name, backend, dict(options or {}))
    else:
        name = type(getattr(env, "unwrapped", env)).__name__
        if backend is not None or options:
            raise ValueError(
                f"backend and options are for an environment by its name; got {name} itself"
            )
    _check_env(env, name)
    if dt is None:
        try:
            dt = env.dt
        except AttributeError as error:
            raise ValueError(f"{name} has no dt: give dt=..., seconds of a step") from error
    seconds = period(dt)
    check_signals_option(signals)
    deciding(policy, policy_memory)
    bindings = features if isinstance(features, Mapping) else {path: path for path in features}
    places = {feature: _place(env, path, name) for feature, path in bindings.items()}
    starts = initial
    if isinstance(initial, Mapping):
        if not hasattr(env, "pipeline_init"):
            raise ValueError(
                f"{name} has no pipeline_init: initial must be a function (env, features, key) -> "
                "State"
            )
        starts = {feature: _joint_place(env, path, name) for feature, path in initial.items()}
    _check_read(env, name, places)
    return Brax(
        env=env,
        name=name,
        policy=policy,
        policy_memory=policy_memory,
        steps=step_count(steps, duration, seconds),
        dt=seconds,
        features=places,
        configure=configure,
        initial=starts,  # pyright: ignore[reportArgumentType]
        signals=signals,
    )


def _import(module: str) -> Any:
    """A module of Brax, without what it and its packages say of themselves at each import."""
    require("brax", extra="brax")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return require(module, extra="brax")


def _check_version() -> None:
    version = importlib.metadata.version("brax")
    numbers = tuple(int(n) for n in re.findall(r"\d+", version)[:3])
    if numbers < OLDEST:
        raise MissingExtra(
            f"brax {version} is installed, verifai_jax needs {'.'.join(map(str, OLDEST))} or "
            "later: pip install 'verifai_jax[brax]'"
        )


def _made(name: str, backend: str | None, options: dict[str, Any]) -> Any:
    """An environment of Brax's own, by its name."""
    envs = _import("brax.envs")
    known = getattr(envs, "_envs", {})
    if known and name not in known:
        raise unknown_name("environment of brax", name, known)
    if backend is not None:
        if backend not in BACKENDS:
            raise unknown_name("backend", backend, BACKENDS)
        options["backend"] = backend
    with _explained(None, name, "construction", backend):
        return envs.get_environment(name, **options)


def _check_env(env: Any, name: str) -> None:
    """Refuse what is no environment, or one that resets itself."""
    for part in ("reset", "step", "action_size"):
        if not hasattr(type(env), part) and not hasattr(env, part):
            raise ValueError(
                f"env must be the name of an environment or a brax Env; got {env!r}, "
                f"which has no {part}"
            )
    wrappers = _import("brax.envs.wrappers.training")
    training = tuple(
        getattr(wrappers, wrapper)
        for wrapper in ("AutoResetWrapper", "EpisodeWrapper", "VmapWrapper")
        if hasattr(wrappers, wrapper)
    )
    inner = env
    while inner is not None:
        if isinstance(inner, training):
            raise ValueError(
                f"{type(inner).__name__} is for training: one episode that is not reset needs "
                f"{name} without it, brax.envs.get_environment or env.unwrapped"
            )
        inner = vars(inner).get("env") if hasattr(inner, "__dict__") else None


@contextlib.contextmanager
def _explained(env: Any, name: str, what: str, backend: str | None = None) -> Iterator[None]:
    """Say which environment, backend and versions an error within Brax belongs to."""
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


def _moment(state: Any, name: str) -> Moment:
    missing = [part for part in ("obs", "reward", "done") if not hasattr(state, part)]
    if missing:
        raise ValueError(
            f"{name}: reset, step and initial must return a brax State; got {outline(state)}"
        )
    return Moment(state, state.obs, state.reward, state.done)


def _named(state: Any) -> dict[str, Any]:
    """The parts of a brax State that have names of their own."""
    physics = getattr(state, "pipeline_state", None)
    parts = {part: getattr(physics, part, None) for part in ("q", "qd")}
    return {
        name: value for name, value in (parts | dict(state.metrics)).items() if value is not None
    }


def _place(env: Any, path: str, name: str) -> Place:
    """Where a path such as `link.inertia.mass[pole]` leads.

    **Raises:** `UnknownNameError` for a part or an entry that does not exist; `ValueError` for an
    environment without `sys`, or a part that holds no numbers.
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
        return Place(parts, None)
    if np.ndim(leaf) == 0:
        raise ValueError(f"{'.'.join(parts)} of {name} is one number and has no entry {text!r}")
    return Place(parts, _row(text, parts, np.shape(leaf)[0], _row_names(sys, parts), name))


def _paths(sys: Any) -> list[str]:
    return [
        ".".join(getattr(key, "name", str(key)) for key in path)
        for path, _ in jax.tree.leaves_with_path(sys)
    ]


def _row_names(sys: Any, parts: tuple[str, ...]) -> dict[str, int]:
    """What the rows of an array are called, where they are called anything."""
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


def _joint_place(env: Any, path: str, name: str) -> Place:
    """Which entry of `q` or `qd` a path such as `q[hinge]` means."""
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
    return Place((part,), _row(match.group(2), (part,), length, named, name))


def _with(sys: Any, place: Place, value: Any, feature: str) -> Any:
    """The system with one array, or one entry of it, set."""
    old: Any = sys
    for part in place.parts:
        old = getattr(old, part)
    old = jnp.asarray(old)
    target = old if place.index is None else old[place.index]
    if jnp.shape(value) != target.shape:
        raise ValueError(
            f"feature {feature!r} has shape {list(jnp.shape(value))} and {place} has "
            f"{list(target.shape)}; name one entry, as in '{'.'.join(place.parts)}[0]', or use "
            "configure=(sys, features) -> sys"
        )
    new = jnp.asarray(value, jnp.result_type(old, value))
    if place.index is not None:
        new = old.astype(new.dtype).at[place.index].set(new)
    return _replaced(sys, place.parts, new)


def _replaced(node: Any, parts: tuple[str, ...], value: Any) -> Any:
    if not parts:
        return value
    child = _replaced(getattr(node, parts[0]), parts[1:], value)
    return node.replace(**{parts[0]: child})


def _with_system(env: Any, sys: Any) -> Any:
    """A copy of the environment, within its wrappers, with another `sys`."""
    other = copy.copy(env)
    if "env" in vars(other) and "sys" not in vars(other):
        other.env = _with_system(other.env, sys)
    else:
        other.sys = sys
    return other


def _starting(env: Any, values: Mapping[Place, Any]) -> Any:
    """A copy whose reset starts from these entries of `q` and `qd`, and observes what they give."""
    other = copy.copy(env)
    if "env" in vars(other) and "sys" not in vars(other):
        other.env = _starting(other.env, values)
        return other
    begin = other.pipeline_init

    def pipeline_init(q: Any, qd: Any, *rest: Any, **options: Any) -> Any:
        for place, value in values.items():
            if place.parts == ("q",):
                q = jnp.asarray(q).at[place.index].set(value)
            else:
                qd = jnp.asarray(qd).at[place.index].set(value)
        return begin(q, qd, *rest, **options)

    other.pipeline_init = pipeline_init
    return other


def _check_read(env: Any, name: str, places: Mapping[str, Place]) -> None:
    """Refuse a part of the system that neither reset nor step looks at: it would change nothing.

    Each backend reads its own copies of masses, gains and the like.
    """
    if not places:
        return
    sys = env.unwrapped.sys

    def leaf(place: Place) -> Any:
        value: Any = sys
        for part in place.parts:
            value = getattr(value, part)
        return jnp.asarray(value)

    def play(values: Any, key: Any, action: Any) -> Any:
        changed = sys
        for place, value in zip(places.values(), values, strict=True):
            changed = _replaced(changed, place.parts, value)
        played = _with_system(env, changed)
        with _explained(env, name, "reset and step"):
            return jax.tree.leaves(played.step(played.reset(key), action))

    values = [leaf(place) for place in places.values()]
    used = inputs_used(play, values, jax.random.key(0), jnp.zeros(env.action_size))
    for (feature, place), read_at_all in zip(places.items(), used, strict=False):
        if not read_at_all:
            raise ValueError(
                f"feature {feature!r} sets {place}, which {name} on the backend {env.backend!r} "
                "does not read. The mjx backend reads MuJoCo's arrays (body_mass, dof_damping, "
                "...), the others mostly Brax's (link.inertia.mass, dof.damping, ...)"
            )
