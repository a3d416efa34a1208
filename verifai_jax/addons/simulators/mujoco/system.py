"""A MuJoCo model in a closed loop as a system `(features, key) -> Trace`, on one of three engines.

mujoco("envs/mujoco_cartpole.xml", duration=4.0, control_period=0.02,
       bind={"masspole": "body/pole/mass", "x0": "joint/slider/qpos"},
       controller=policy, signals={"x": "joint/slider/qpos"})
mjx(...)                              # the same in JAX: vmap, gradients, GPU
native(...)                           # the same in C: all cores, a batch in lock-step
mujoco(..., backend="warp")           # the same in MuJoCo Warp, without gradients
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree

from verifai_jax.addons.simulators.delay_options import DelayOption, as_delay, links_of
from verifai_jax.addons.simulators.mujoco.bindings import Bound, resolve_bindings
from verifai_jax.addons.simulators.mujoco.loop import Loop, Signals
from verifai_jax.addons.simulators.mujoco.mjx_rollout import (
    has_constraints,
    reverse_hint,
    rollout,
    why_not,
)
from verifai_jax.addons.simulators.mujoco.model import ModelSource, load
from verifai_jax.addons.simulators.mujoco.native_rollout import Native
from verifai_jax.addons.simulators.mujoco.warp_rollout import WarpBatch
from verifai_jax.addons.simulators.mujoco.warp_rollout import why_not as why_not_warp
from verifai_jax.core.compute.fingerprint import used_inputs
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import require, suggests_options, unknown_name
from verifai_jax.core.values.trace import Trace
from verifai_jax.core.values.waveform import set_durations
from verifai_jax.systems.base import Features, Seed, System
from verifai_jax.systems.channels import Link, Passing, first_refusal
from verifai_jax.systems.clock import count_periods
from verifai_jax.systems.delays import joined
from verifai_jax.systems.forks import Rollout
from verifai_jax.systems.ode.integrators import check_factor

FILM = "verifai_jax.addons.simulators.pictures.mujoco_film"
BACKENDS = ("native", "mjx", "warp")
ON_HOST = ("native", "warp")
"""Backends in which JAX runs the controller alone, between the steps of the physics."""


@dataclass(frozen=True, eq=False)
class MuJoCo(System):
    """A closed loop `(features, key) -> Trace`; made by `mujoco`, which documents its parts.

    - `backend`: `"native"`, `"mjx"`, `"warp"`, or `"auto"` until a run chooses.
    """

    # Measured on the cart-pole in MJX: four forward sweeps take 0.8 of one reverse sweep's time,
    # and half of its time to compile.
    forward_up_to: ClassVar[int] = 4
    # Lanes wait for the one whose contacts take most iterations: a ball at 144 000 steps/s with 128
    # together, 47 000 with 512.
    lanes: ClassVar[int] = 128
    loop: Loop
    backend: str = "auto"
    # Of the native backend; another loop has its own, but the same at every step of the physics.
    programs: dict[Any, Any] = field(default_factory=dict, repr=False, init=False)

    def __repr__(self) -> str:
        compiled = self.loop.compiled
        name = compiled.names.split(b"\0")[0].decode(errors="replace") or "a model"
        sizes = f"{compiled.nq} coordinates, {compiled.nu} actuators"
        return f"MuJoCo({name}, {sizes}, {self.duration:zg} s, backend={self.backend!r})"

    def __getstate__(self) -> dict[str, Any]:
        # Another process makes its own programs, and its own batches of MuJoCo.
        kept = {name: value for name, value in self.__dict__.items() if name != "_native"}
        return {**kept, "programs": {}}

    @property
    def duration(self) -> float:
        """Duration of a simulation in seconds."""
        return self.loop.duration

    @cached_property
    def backends(self) -> tuple[str, ...]:
        """The engines that can simulate this model; `"warp"` only where it was asked for."""
        mjx = ("mjx",) if self.why_not("mjx") is None else ()
        return ("native", *mjx, *(("warp",) if self.backend == "warp" else ()))

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on changes made to the model, and on a controller that runs in Python."""
        return (*self.loop.bindings.model.notes, *self.loop.said.values())

    @property
    def constants(self) -> dict[str, str | np.ndarray]:
        """Options and arrays of the model by name, without those that MuJoCo derives."""
        mujoco, compiled = require("mujoco", extra="mujoco"), self.loop.compiled
        found: dict[str, str | np.ndarray] = {}
        for name in dir(compiled.opt):
            value = getattr(compiled.opt, name)
            if isinstance(value, int | float | np.ndarray) and not name.startswith("_"):
                kinds = getattr(mujoco, f"mjt{name.capitalize()}", None)
                found[f"option/{name}"] = np.asarray(value) if kinds is None else kinds(value).name
        for name in dir(compiled):
            value = getattr(compiled, name) if name[-1] != "0" else None
            if isinstance(value, np.ndarray) and value.dtype.kind == "f":
                found[name] = value
        return found

    def filmed(self, replay: Any) -> Any:
        return lazy_import(FILM, "filmed")(self, replay)

    def why_slow_to_compile(self, gradient: bool) -> str:
        compiled = self.loop.compiled
        stages = compiled.opt.integrator == 1  # Runge-Kutta
        if self.backend != "mjx" or not (stages or gradient) or not has_constraints(compiled):
            return ""
        reason = "its constraints are solved in a loop"
        reason += ", four times in each Runge-Kutta step" if stages else ""
        sweeps = ", whose derivatives take forward sweeps" if stages and gradient else ""
        reason += sweeps or (", through which derivatives are taken" if gradient else "")
        euler = 'integrator="implicitfast" in the model, or ' if stages else ""
        search = ' with a search without gradients, such as "cross_entropy"' if gradient else ""
        return (
            f"MJX compiles this model for minutes: {reason}. Cheaper: {euler}"
            f'backend="native"{search}, which compiles nothing of the physics'
        )

    def why_error(self, features: Features) -> str | None:
        """Return a message that names a delay or fault with an invalid number."""
        return first_refusal(self.loop.links, features, "this system")

    def passing(self, features: Features) -> Passing:
        """Return the controller's inputs and outputs."""
        return self.loop.passing()

    def with_links(self, links: tuple[Link, ...]) -> "MuJoCo":
        return replace(self, loop=replace(self.loop, links=joined(self.loop.links, links)))

    @property
    def likely(self) -> str:
        """The engine that is probably faster on a CPU: contacts slow MJX, policies slow native.

        In measurements MJX was three times as fast as native without constraints (a cart-pole), and
        seven times slower with a contact (a ball).
        """
        return "native" if has_constraints(self.loop.compiled) else "mjx"

    def why_not(self, backend: str) -> str | None:
        if backend not in BACKENDS:
            raise unknown_name("backend", backend, (*BACKENDS, "auto"))
        if backend == "native":
            return None
        return (why_not_warp if backend == "warp" else why_not)(self.loop.bindings)

    def with_backend(self, name: str) -> "MuJoCo":
        if name != "auto" and (reason := self.why_not(name)) is not None:
            raise ValueError(f"backend {name!r} is not possible: {reason}")
        return replace(
            self, backend=name, loop=replace(self.loop, on_host=name in ON_HOST, said={})
        )

    @property
    def traced_factor(self) -> bool:
        """True if JAX may trace the factor of `refined`."""
        return not self.black_box

    def refined(self, factor: int) -> "MuJoCo":
        """Return the same loop with a finer step; samples, decisions and end keep their times.

        Sensors of acceleration and force then describe the last of the smaller steps.

        **Raises:** `ValueError` for a factor that is not a positive integer.
        """
        if not (self.traced_factor and isinstance(factor, jax.Array)):
            check_factor(factor)
        finer = replace(self, loop=replace(self.loop, finer=self.loop.finer * factor))
        object.__setattr__(finer, "programs", self.programs)
        return finer

    @property
    def black_box(self) -> bool:
        """True if JAX cannot trace it: natively, in Warp, or for a model that needs one of them."""
        return self.backend in ON_HOST or (self.backend == "auto" and "mjx" not in self.backends)

    @cached_property
    def reverse_hint(self) -> str:
        """A sentence on how to make reverse mode work, if it does not."""
        return reverse_hint(self.loop.compiled) or ""

    def check(self, features: Features) -> None:
        self.loop.check(set_durations(features, self.duration))

    def abstract(self, features: Features) -> Trace:
        """Return the shapes of one simulation's trace."""
        loop, features = self.loop, set_durations(features, self.duration)

        def trace(features: Features) -> Trace:
            zeros = {name: jnp.zeros(shape) for name, shape in loop.shapes.items()}
            sampled, progress = loop.sample(
                jnp.int32(0), zeros, loop.initial_progress(features), features
            )
            signals = {
                name: jnp.broadcast_to(value, (loop.periods + 1, *value.shape))
                for name, value in sampled.signals.items()
            }
            ends = loop.terminate is not None
            return Trace(
                signals, dt=loop.control_period, valid=progress.age if ends else None,
                status=jnp.int32(0), held=ends, finite=loop.finite_signals(),
            )  # fmt: skip

        return jax.eval_shape(trace, features)

    def may_draw(self, features: Features) -> bool:
        if any(link.draws for link in self.loop.links):
            return True
        features, key = (
            set_durations(features, self.duration),
            jax.eval_shape(lambda: jax.random.key(0)),
        )
        program = jax.make_jaxpr(lambda key, features: self.loop.start(features, key))
        return used_inputs(program(key, features))[0]

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        """Simulate once: traced by JAX in MJX."""
        if not self.black_box:
            return self.rollout(features, key).trace()
        features = set_durations(features, self.duration)
        key = jax.random.key(0) if key is None else key
        batch = self.simulate_batch(
            jax.tree.map(lambda leaf: np.asarray(leaf)[None], features), jnp.asarray(key)[None]
        )
        return jax.tree.map(lambda leaf: leaf[0], batch)

    @property
    def can_fork(self) -> bool:
        """True for MJX: other simulations keep more than their forks would."""
        return not self.black_box

    def rollout(self, features: Features, key: Seed = None) -> Rollout:
        features = set_durations(features, self.duration)
        self.loop.check(features)
        return rollout(self.loop, features, key)

    def simulate_batch(self, features: Features, keys: Key[Array, " n"]) -> Trace:
        """Simulate a batch natively or in Warp; all leaves have a leading axis `[n]`."""
        return self._native.simulate(set_durations(features, self.duration), keys)

    @cached_property
    def _native(self) -> Native:
        warp = partial(WarpBatch, bindings=self.loop.bindings) if self.backend == "warp" else None
        return Native(self.loop, programs=self.programs, make=warp)


@suggests_options
def mujoco(
    model: ModelSource,
    *,
    duration: float,
    control_period: float,
    bind: Bound | None = None,
    controller: Callable[..., Any] | None = None,
    controller_memory: PyTree = None,
    initial: Callable[..., Any] | None = None,
    signals: Signals | None = None,
    terminate: Callable[..., Any] | None = None,
    backend: str = "auto",
    solver_iterations: int | None = None,
    ls_iterations: int | None = None,
    keyframe: str | int | None = None,
    action_delay: DelayOption = 0,
) -> MuJoCo:
    """Make a system `(features, key) -> Trace` from a MuJoCo model and a controller.

    **Arguments:**
    - `model`: the path of an MJCF file, its text, an `mujoco.MjSpec` or an `mujoco.MjModel`.
    - `duration`: in seconds, a multiple of `control_period`.
    - `control_period`: seconds between two runs of the controller, a multiple of the model's
      timestep, and the sampling period of the trace. Control and forces are held in between.
    - `bind`: a dictionary from a feature to the path that it sets, `"body/pole/mass"`, to
      `Scaled(path)` for a factor on the model's value, or to a list of these. See docs/mujoco.md
      for all paths.
    - `controller(time, state, features) -> control`: returns `[nu]`, or one number for one
      actuator; `state` is a `systems.mujoco.loop.State`. JAX traces it. With `backend="native"` or
      `"warp"` one that JAX cannot trace, such as one in NumPy or PyTorch, is called with NumPy
      arrays, once for each decision.
    - `controller_memory`: as in `ode`.
    - `initial(features, key, qpos, qvel) -> (qpos, qvel)`: the state at time 0, after `bind`.
    - `signals`: a dictionary from a signal to a path (`"joint/slider/qpos"`,
      `"body/torso/xpos[2]"`, `"sensor/imu"`, or `"contact/floor/foot"` for the number of contacts)
      or to a function `(time, state, control, features) -> value`; or one function that returns the
      dictionary. By default: joints as `NAME` and `NAME_vel`, and sensors by their names.
    - `terminate(state, features) -> bool`: as in `ode`.
    - `backend`: `"mjx"`, `"native"`, or `"auto"`: a run takes MJX if it needs gradients, otherwise
      the faster one. `"warp"` is MuJoCo Warp, an extra without gradients (docs/mujoco.md).
    - `solver_iterations`, `ls_iterations`: iterations of the constraint solver and of its line
      search, instead of the model's.
    - `keyframe`: name or number of the model's keyframe in which each simulation starts, before
      `bind`. Its `ctrl` is the control if there is no controller.
    - `action_delay`: number of control periods after which a decision of the controller takes
      effect, or the feature that gives it with its maximum, `{"latency": 5}`. Until the first
      decision takes effect, the control is the keyframe's, or zero.
    **Returns:** a `MuJoCo` system.
    **Raises:** `MissingExtra` without MuJoCo; `FileNotFoundError`; `ValueError` for a model that
    does not compile or that the backend lacks, inconsistent times, and paths not in the model.
    """
    if backend not in (*BACKENDS, "auto"):
        raise unknown_name("backend", backend, (*BACKENDS, "auto"))
    if controller is None and controller_memory is not None:
        raise ValueError("controller_memory needs a controller; got none")
    for name, part in (("controller", controller), ("initial", initial), ("terminate", terminate)):
        if part is not None and not callable(part):
            raise ValueError(f"{name} must be a function; got {part!r}")
    for name, count in (("solver_iterations", solver_iterations), ("ls_iterations", ls_iterations)):
        if count is not None:
            check_count(name, count)
    if not (bind is None or isinstance(bind, Mapping)):
        raise ValueError(f"bind must be a dictionary of paths by feature; got {bind!r}")
    if not (signals is None or callable(signals) or isinstance(signals, Mapping)):
        raise ValueError(f"signals must be a dictionary or a function; got {signals!r}")
    contacts = ()
    if isinstance(signals, Mapping):
        if not signals:
            raise ValueError("signals has no signal in it")
        contacts = tuple(
            path
            for path in signals.values()
            if isinstance(path, str) and path.startswith("contact/")
        )
    delay = as_delay(action_delay, "action_delay")
    if delay.max_steps and controller is None:
        raise ValueError("action_delay needs a controller; got none")
    loaded = load(
        model, contacts, keyframe, iterations=solver_iterations, ls_iterations=ls_iterations
    )
    timestep = float(loaded.compiled.opt.timestep)
    loop = Loop(
        bindings=resolve_bindings(loaded, bind),
        controller=controller,
        controller_memory=controller_memory,
        initial=initial,
        signals=signals,
        terminate=terminate,
        control_period=float(control_period),
        periods=count_periods(duration, control_period, "duration", "control_period"),
        substeps=count_periods(control_period, timestep, "control_period", "the model's timestep"),
        links=links_of(delay),
    )
    _ = loop.locations
    system = MuJoCo(loop)
    return system if backend == "auto" else system.with_backend(backend)


def mjx(model: ModelSource, **options: Any) -> MuJoCo:
    """Make a system from a MuJoCo model simulated by MJX in JAX; arguments as in `mujoco`."""
    return mujoco(model, backend="mjx", **options)


def native(model: ModelSource, **options: Any) -> MuJoCo:
    """Make a system from a MuJoCo model simulated in C on all cores; arguments as in `mujoco`."""
    return mujoco(model, backend="native", **options)
