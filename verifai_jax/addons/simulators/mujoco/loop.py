"""The closed loop around a MuJoCo model, for both engines: state, control, signals, termination.

Both backends call `sample` between control periods, the native one on a whole batch under `vmap`.
So both perform the same computation, in the same order of operations.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from verifai_jax.addons.simulators.mujoco.bindings import Bindings, RecordingFeatures
from verifai_jax.addons.simulators.mujoco.part_paths import Location, names, reading
from verifai_jax.core.compute.purity import watch
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.user_code.user_errors import explain_user_error
from verifai_jax.systems.base import Seed
from verifai_jax.systems.channels import Channels, Link, NamedNumbers, Passing
from verifai_jax.systems.pytree_checks import (
    as_precise_as,
    check_like,
    check_signals,
    in_working_precision,
    outline,
)

Features = Mapping[str, Any]
Signals = Mapping[str, str | Callable[..., Any]] | Callable[..., Mapping[str, Any]]
HUGE = 1e10
"""MuJoCo's `mjMAXVAL`: it calls a larger state unstable, and takes a larger control for zero."""


class State(NamedTuple):
    """The state of a simulation for controller, signals and terminate, on both backends.

    All entries are current except the sensors of acceleration and force (accelerometer, force,
    torque, touch, actuatorfrc): they describe the last physics step before the sample, and are zero
    at time 0.
    """

    time: Float[Array, ""]
    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    act: Float[Array, " na"]
    sensordata: Float[Array, " nsensordata"]
    xpos: Float[Array, "nbody 3"]
    xquat: Float[Array, "nbody 4"]
    xipos: Float[Array, "nbody 3"]
    subtree_com: Float[Array, "nbody 3"]
    geom_xpos: Float[Array, "ngeom 3"]
    site_xpos: Float[Array, "nsite 3"]
    ten_length: Float[Array, " ntendon"]
    actuator_length: Float[Array, " nu"]


class Sample(NamedTuple):
    """The signals at one sample, and the inputs of the control period that follows.

    - `inputs`: `ctrl`, and the forces that features apply.
    - `frozen`: whether the state stays fixed from here on.
    """

    inputs: dict[str, Float[Array, "..."]]
    signals: dict[str, Array]
    frozen: Bool[Array, ""]


class Progress(NamedTuple):
    """The carry from sample to sample, apart from the physics."""

    memory: Any
    age: Int[Array, ""]
    finite: Bool[Array, ""]
    states: Any = ()


@dataclass(frozen=True, eq=False)
class Loop:
    """All parts of a system except its engine; `mujoco` documents them."""

    bindings: Bindings
    controller: Callable[..., Any] | None
    controller_memory: Any
    initial: Callable[..., Any] | None
    signals: Signals | None
    terminate: Callable[..., Any] | None
    control_period: float
    periods: int
    substeps: int
    # Integration steps in one of the model's; JAX may trace it.
    finer: Any = 1
    # What observations and controls pass through: delays, in control periods, and faults.
    links: tuple[Link, ...] = ()
    # Whether a controller that JAX cannot trace is called by the host; and of one, why it is.
    on_host: bool = False
    said: dict[str, str] = field(default_factory=dict, repr=False)

    @property
    def compiled(self) -> Any:
        """The `mujoco.MjModel`."""
        return self.bindings.model.compiled

    @property
    def duration(self) -> float:
        """Duration of a simulation in seconds."""
        return self.periods * self.control_period

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each array of the state, including sensors added for contacts."""
        m = self.compiled
        return {
            "qpos": (m.nq,),
            "qvel": (m.nv,),
            "act": (m.na,),
            "sensordata": (m.nsensordata,),
            **dict.fromkeys(("xpos", "xipos", "subtree_com"), (m.nbody, 3)),
            "xquat": (m.nbody, 4),
            "geom_xpos": (m.ngeom, 3),
            "site_xpos": (m.nsite, 3),
            "ten_length": (m.ntendon,),
            "actuator_length": (m.nu,),
        }

    @cached_property
    def locations(self) -> dict[str, Location]:
        """The locations of signals that are given by a path."""
        if callable(self.signals):
            return {}
        chosen = self._default_signals() if self.signals is None else self.signals
        found = {}
        added = list(self.bindings.model.contact_sensors)
        for name, path in chosen.items():
            if callable(path):
                continue
            if isinstance(path, str) and path.startswith("contact/"):
                path = f"sensor/{added.pop(0)}"
            found[name] = reading(self.compiled, path)
        return found

    def _default_signals(self) -> dict[str, str]:
        paths: dict[str, str] = {}
        for joint in names(self.compiled, "joint"):
            paths |= {joint: f"joint/{joint}/qpos", f"{joint}_vel": f"joint/{joint}/qvel"}
        paths |= {sensor: f"sensor/{sensor}" for sensor in names(self.compiled, "sensor")}
        if not paths:
            raise ValueError("the model names no joint or sensor: give signals={'x': 'joint/...'}")
        return paths

    @cached_property
    def delayed_sensors(self) -> np.ndarray:
        """A mask of those `sensordata` that describe the last physics step, `[nsensordata]`."""
        delayed = np.zeros(self.compiled.nsensordata, bool)
        for i in range(self.compiled.nsensor):
            if self.compiled.sensor_needstage[i] >= 3:
                start = int(self.compiled.sensor_adr[i])
                delayed[start : start + int(self.compiled.sensor_dim[i])] = True
        return delayed

    def start(self, features: Features, key: Seed) -> dict[str, Array]:
        """Return `qpos`, `qvel` and `act` at time 0."""
        start = self.bindings.start(features)
        if self.initial is None:
            return start
        made = self.initial(features, key, start["qpos"], start["qvel"])
        role = "(qpos, qvel), each in the shape of the model's"
        if not (isinstance(made, tuple) and len(made) == 2):
            raise ValueError(f"initial must return {role}; got {outline(made)}")
        for name, value in zip(("qpos", "qvel"), made, strict=True):
            if np.shape(value) != start[name].shape:
                raise ValueError(
                    f"initial must return {role}; {name} must have shape "
                    f"{list(start[name].shape)}, got {list(np.shape(value))}"
                )
            start[name] = jnp.asarray(value, start[name].dtype)
        return start

    def initial_progress(self, features: Features, key: Seed = None) -> Progress:
        """Return the progress before the first sample."""
        zero = jnp.zeros((), jnp.result_type(float))
        state, _ = self.state(zero, {})
        states = self.channels(features).begin(state, self.rest(), key)
        memory = in_working_precision(self.controller_memory)
        return Progress(memory, jnp.int32(0), jnp.array(True), states)

    def channels(self, features: Features) -> Channels:
        """Return the links in the path of observations and controls in one simulation."""
        return Channels(self.links, self.control_period, features)

    def passing(self) -> Passing:
        """Return the controller's inputs and outputs, with names of sensors, joints and actuators.

        **Raises:** `ValueError` for a loop without a controller.
        """
        if self.controller is None:
            raise ValueError(
                "faults act between a model and its controller; there is no controller"
            )
        state, _ = jax.eval_shape(lambda: self.state(jnp.zeros((), jnp.result_type(float)), {}))
        compiled, named = self.compiled, {}
        for kind, path in (("joint", "joint/{}/qpos"), ("sensor", "sensor/{}")):
            for name in names(compiled, kind):
                where = reading(compiled, path.format(name))
                index = tuple(int(i) for i in where.index)
                named[name] = NamedNumbers("observation", where.array, index)
        for number, name in enumerate(names(compiled, "actuator")):
            named.setdefault(name, NamedNumbers("action", "", (number,)))
        control = jax.ShapeDtypeStruct((compiled.nu,), state.time.dtype)
        limited, ranges = np.all(compiled.actuator_ctrllimited), compiled.actuator_ctrlrange.T
        return Passing(
            state, control, self.control_period, self.duration, named, ("time",),
            (ranges[0], ranges[1]) if limited and compiled.nu else None,
        )  # fmt: skip

    def rest(self) -> Float[Array, " nu"]:
        """Return the control if there is no controller: the keyframe's, or zero."""
        real = jnp.result_type(float)
        return jnp.asarray(self.bindings.model.begin.get("ctrl", np.zeros(self.compiled.nu)), real)

    def sample(
        self, k: Int[Array, ""], arrays: Mapping[str, Array], progress: Progress, features: Features
    ) -> tuple[Sample, Progress]:
        """Read the state at sample `k`, and compute the inputs until the next sample.

        `arrays` must contain at least those arrays of the state that `reads` names.
        """
        time = progress.age.astype(jnp.result_type(float)) * self.control_period
        state, sensors = self.state(time, arrays)
        frozen = k >= self.periods
        if self.terminate is not None:
            frozen |= self.terminate(state, features)
        channels = self.channels(features)
        seen, states = channels.observation(progress.states, state, time, frozen)
        ctrl, memory = self.control(seen, progress.memory, features)
        ctrl, states = channels.action(states, ctrl, time, frozen)
        inputs = {"ctrl": ctrl, **self.bindings.applied_at(features, time)}
        signals = self.signal_values(state, sensors, inputs["ctrl"], features)
        finite = progress.finite
        for value in (*inputs.values(), *(arrays[name] for name in ("qpos", "qvel", "act"))):
            finite &= jnp.all(jnp.abs(value) <= HUGE)
        # The links know of the end themselves: a long line of past values is not copied for it.
        after = Progress(memory, progress.age + 1, finite, ())
        unchanged = progress._replace(finite=finite, states=())
        after = jax.tree.map(lambda new, old: jnp.where(frozen, old, new), after, unchanged)
        return Sample(inputs, signals, frozen), after._replace(states=states)

    def state(self, time: Array, arrays: Mapping[str, Array]) -> tuple[State, Array]:
        """Return the state as users see it, and all sensors; missing arrays are zero."""
        full = {
            name: arrays.get(name, jnp.zeros(shape, time.dtype))
            for name, shape in self.shapes.items()
        }
        sensors = full["sensordata"]
        # Sensors that were added for contacts lie after the model's own.
        own = sensors[: self.compiled.nsensordata - len(self.bindings.model.contact_sensors)]
        return State(time, **{**full, "sensordata": own}), sensors

    def control(self, state: State, memory: PyTree, features: Features) -> tuple[Any, Any]:
        """Return the controller's output as `[nu]`, and its memory."""
        nu = self.compiled.nu
        if self.controller is None:
            return self.rest().astype(state.time.dtype), memory
        decided = self._decide(state, memory, features)
        if self.controller_memory is None:
            control = decided
        else:
            control, after = decided
            memory = as_precise_as(after, memory)
        control = jnp.asarray(control, state.time.dtype)
        return control.reshape(nu), memory

    def _decide(self, state: State, memory: PyTree, features: Features) -> Any:
        """Call the controller: under JAX, or on the host where JAX cannot trace it and it may."""
        assert self.controller is not None
        first = (
            (state.time, state) if self.controller_memory is None else (state.time, state, memory)
        )
        if "controller" not in self.said:
            try:
                return self.controller(*first, features)
            except Exception as error:
                if not self.on_host or not isinstance(state.time, Tracer):
                    raise
                self.said["controller"] = self._why_on_host((*first, dict(features)), error)
        form = jax.ShapeDtypeStruct((self.compiled.nu,), state.time.dtype)
        if self.controller_memory is not None:
            like = jax.tree.map(lambda m: jax.ShapeDtypeStruct(jnp.shape(m), m.dtype), memory)
            form = (form, like)
        given = (*first, {name: features[name] for name in features})
        return jax.pure_callback(self._on_host, form, *given, vmap_method="sequential")

    def _on_host(self, *arguments: Any) -> Any:
        """Call the controller with arrays of NumPy, and return such."""
        assert self.controller is not None
        decided = self.controller(*jax.tree.map(np.asarray, arguments))
        control, memory = (decided, None) if self.controller_memory is None else decided
        control = np.asarray(control, arguments[0].dtype).reshape(self.compiled.nu)
        if memory is None:
            return control
        like = lambda old, new: np.asarray(new, old.dtype)  # noqa: E731
        return control, jax.tree.map(like, arguments[2], memory)

    def _why_on_host(self, arguments: tuple[Any, ...], error: Exception) -> str:
        """Return why a controller runs on the host, once it has run there."""
        self._on_host(*jax.tree.map(lambda leaf: np.zeros(np.shape(leaf), leaf.dtype), arguments))
        return (
            "the controller runs in Python, for one simulation after another, because JAX cannot "
            f"trace it: {explain_user_error(error, system=False)}"
        )

    def signal_values(
        self, state: State, sensors: Array, ctrl: Array, features: Features
    ) -> dict[str, Any]:
        """Return the signals at one sample."""
        if callable(self.signals):
            return dict(self.signals(state.time, state, ctrl, features))
        arrays = {**state._asdict(), "sensordata": sensors, "ctrl": ctrl}
        values = {}
        for name, chosen in (self.signals or self.locations).items():
            if callable(chosen):
                values[name] = chosen(state.time, state, ctrl, features)
            else:
                where = self.locations[name]
                values[name] = jnp.ravel(arrays[where.array])[where.index].reshape(where.shape)
        return values

    def finite_signals(self) -> tuple[str, ...]:
        """Return the signals that are part of the state, so that they are finite if it is."""
        parts = ("qpos", "qvel", "act", "ctrl")
        return tuple(name for name, location in self.locations.items() if location.array in parts)

    def arrays_read(self, features: Features) -> frozenset[str]:
        """Return the names of the state's arrays that a function or a signal reads."""
        fields = [name for name in State._fields if name != "time"]
        zero = jnp.zeros(())
        state, _ = jax.eval_shape(lambda: self.state(zero, {}))

        def everything(state: State, features: Features, memory: PyTree) -> Any:
            control, memory = self.control(state, memory, features)
            ended = () if self.terminate is None else self.terminate(state, features)
            if callable(self.signals):
                chosen: Any = self.signals(state.time, state, control, features)
            else:
                chosen = [
                    one(state.time, state, control, features)
                    for one in (self.signals or {}).values()
                    if callable(one)
                ]
            return control, memory, ended, chosen

        traced = jax.make_jaxpr(everything)(state, features, self.controller_memory).jaxpr
        touched = [v for equation in traced.eqns for v in equation.invars] + list(traced.outvars)
        read = {
            name
            for name, variable in zip(State._fields, traced.invars, strict=False)
            if any(variable is one for one in touched)
        }
        read |= {location.array for location in self.locations.values()}
        read |= {name for link in self.links for name in link.arrays}
        return frozenset(read & set(fields))

    def check(self, features: Features) -> None:
        """Refuse features and functions that do not fit; by abstract evaluation only.

        **Raises:** `ValueError`.
        """
        self.bindings.check(features)
        linked = [name for link in self.links for name in link.features]
        check_names("feature of action_delay:", linked, features)
        for link in self.links:
            link.check(features)
        nu = self.compiled.nu
        used = {binding.feature for binding in self.bindings.all} | {*linked}
        key = jax.eval_shape(lambda: jax.random.key(0))

        def everything(features: Features, key: Key[Array, ""]) -> Any:
            watched = RecordingFeatures(features, used)
            start = self.start(watched, key)
            state, sensors = self.state(jnp.zeros((), jnp.result_type(float)), start)
            memory = in_working_precision(self.controller_memory)
            if self.controller is not None:
                self._check_controller(state, memory, watched)
            control, _ = self.control(state, memory, watched)
            signals = self.signal_values(state, sensors, control, watched)
            check_signals(signals)
            if self.terminate is not None:
                ended = jnp.asarray(self.terminate(state, watched))
                if ended.shape != () or ended.dtype != jnp.bool_:
                    raise ValueError(f"terminate must return one truth value; got {outline(ended)}")
            return signals, control

        # A new function each time: JAX remembers what it traced by the function.
        seen = watch(self, lambda: jax.make_jaxpr(lambda *a: everything(*a))(features, key))
        if seen.why_impure is not None:
            raise ValueError(f"controller, or another function of the model, {seen.remedy}")
        if any(b.location.array == "ctrl" for b in self.bindings.applied) and self.controller:
            raise ValueError("a feature is bound to a ctrl that the controller already sets")
        for name in features:
            if name not in used:
                raise ValueError(
                    f"feature {name!r} is used by nothing: bind it to a part of the model, or read "
                    f"it in controller, initial, signals or terminate (nu={nu})"
                )

    def _check_controller(self, state: State, memory: PyTree, features: Features) -> None:
        nu = self.compiled.nu
        assert self.controller is not None
        if self.controller_memory is None:
            control = self._decide(state, memory, features)
        else:
            decided = self._decide(state, memory, features)
            role = "(control, memory), its memory in the form of controller_memory"
            if not (isinstance(decided, tuple) and len(decided) == 2):
                raise ValueError(f"controller must return {role}; got {outline(decided)}")
            control = decided[0]
            check_like(decided[1], memory, "controller", role, same_precision=False)
        shape = getattr(control, "shape", None) if not np.isscalar(control) else ()
        if shape != (nu,) and not (shape == () and nu == 1):
            known = ", ".join(names(self.compiled, "actuator"))
            raise ValueError(
                f"the model has {nu} actuators ({known}), so controller must return a control of "
                f"shape [{nu}]; got {outline(control)}"
            )
