"""A MuJoCo model to train on, stepped by MJX.

    task = mjx_task(
        "reacher.xml",
        control_period=0.02,
        time_limit=100,
        reward=lambda before, action, after: -jnp.sum(after.site_xpos[0] ** 2),
        observe=lambda data: jnp.concatenate([data.qpos, data.qvel]),
        initial=lambda key, qpos, qvel: (jax.random.normal(key, qpos.shape), qvel),
    )

The trained policy is then tested by `mjx` or `mujoco` with the same model.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.core.checks import check_count
from verifai_jax.core.errors import check_names, require, suggests_options
from verifai_jax.rl.task.task import Action, Continuous
from verifai_jax.systems.mujoco.model import load
from verifai_jax.systems.pytree_checks import outline


class Body(NamedTuple):
    """A state: joints, activations, where the solver begins, and what this episode's model has."""

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    act: Float[Array, " na"]
    warmstart: Float[Array, " nv"]
    varied: dict[str, Array]


@dataclass(frozen=True, eq=False)
class MjxTask:
    """A task; made by `mjx_task`, which says what its parts are."""

    compiled: Any
    action: Action
    time_limit: int
    substeps: int
    reward: Callable[..., Any]
    observe_data: Callable[..., Any]
    initial: Callable[..., Any]
    terminate: Callable[..., Any]
    control: Callable[..., Any]
    vary: Callable[..., Any]
    made: dict[str, Any] = field(default_factory=dict, repr=False)

    def reset(self, key: Key[Array, ""]) -> Body:
        """At the model's own start, or as `initial` and `vary` say."""
        model, blank = self._mjx()
        start_key, vary_key = jax.random.split(key)
        qpos, qvel = self.initial(start_key, blank.qpos, blank.qvel)
        varied = {
            name: jnp.asarray(value, getattr(model, name).dtype)
            for name, value in self.vary(vary_key, model).items()
        }
        qpos, qvel = jnp.asarray(qpos, blank.qpos.dtype), jnp.asarray(qvel, blank.qvel.dtype)
        return Body(qpos, qvel, blank.act, jnp.zeros_like(blank.qacc_warmstart), varied)

    def step(
        self, key: Key[Array, ""], state: Body, action: Array
    ) -> tuple[Body, Float[Array, ""], Bool[Array, ""]]:
        """One control period. A state that is not finite ends the episode before it, unrewarded."""
        mjx = require("mujoco.mjx", extra="mujoco")
        model, before = self._at(state)
        data = before.replace(ctrl=jnp.asarray(self.control(action)).reshape(before.ctrl.shape))
        data = jax.lax.fori_loop(0, self.substeps, lambda _, d: mjx.step(model, d), data)
        after = Body(data.qpos, data.qvel, data.act, data.qacc_warmstart, state.varied)
        finite = jnp.array(True)
        for leaf in (after.qpos, after.qvel, after.act):
            finite &= jnp.all(jnp.isfinite(leaf))
        # A NaN would not stay in one episode: it would poison what is learnt from all of them.
        after = jax.tree.map(lambda new, old: jnp.where(finite, new, old), after, state)
        seen = self._at(after)[1]
        reward = jnp.asarray(self.reward(before, action, seen), jnp.float32).reshape(())
        over = jnp.asarray(self.terminate(seen), bool).reshape(())
        return after, jnp.where(finite, reward, 0.0), over | ~finite

    def observe(self, state: Body) -> Float[Array, " k"]:
        """What the policy sees."""
        return jnp.ravel(jnp.asarray(self.observe_data(self._at(state)[1]), jnp.float32))

    def _at(self, state: Body) -> tuple[Any, Any]:
        """The model of an episode, and data at a state: joints and where bodies and sites are."""
        mjx = require("mujoco.mjx", extra="mujoco")
        model, blank = self._mjx()
        if state.varied:
            model = model.tree_replace(state.varied)
        data = blank.replace(
            qpos=state.qpos, qvel=state.qvel, act=state.act, qacc_warmstart=state.warmstart
        )
        # What nobody looks at is not computed once it is compiled.
        return model, mjx.kinematics(model, data)

    def _mjx(self) -> tuple[Any, Any]:
        if not self.made:
            mjx = require("mujoco.mjx", extra="mujoco")
            # Constants of every program that is traced, so never traced themselves.
            with jax.ensure_compile_time_eval():
                self.made["model"] = mjx.put_model(self.compiled, impl="jax")
                self.made["data"] = mjx.make_data(self.compiled, impl="jax")
        return self.made["model"], self.made["data"]


@suggests_options
def mjx_task(
    model: Any,
    *,
    control_period: float,
    time_limit: int,
    reward: Callable[..., Any],
    observe: Callable[..., Any] | None = None,
    initial: Callable[..., Any] | None = None,
    terminate: Callable[..., Any] | None = None,
    action: Action | None = None,
    control: Callable[..., Any] | None = None,
    vary: Callable[..., Any] | None = None,
) -> MjxTask:
    """A `Task` of a MuJoCo model.

    **Arguments:**

    - `model`: the path of an MJCF file, its text, an `mujoco.MjSpec` or an `mujoco.MjModel`.
    - `control_period`: seconds of a step, a multiple of the model's timestep.
    - `time_limit`: in steps, after which an episode is cut off.
    - `reward(before, action, after) -> number`: of one step. `before` and `after` are MJX data
      with joints, activations, and positions of bodies, geoms and sites; no sensors or forces.
    - `observe(data) -> [k]`: what a policy sees; `qpos` and `qvel` when left out.
    - `initial(key, qpos, qvel) -> (qpos, qvel)`: the start; the model's own when left out.
    - `terminate(data) -> bool`: ends an episode for good.
    - `action`: the kind of action; one from -1 to 1 for each actuator when left out.
    - `control(action) -> [nu]`: the actuators' signals. When left out: a continuous action itself,
      from -1 to 1 spread over the actuators' `ctrlrange` where all have one.
    - `vary(key, model) -> {field: array}`: fields of the MJX model that differ from one episode to
      the next, `{"body_mass": ...}`. Constants that MuJoCo derives from them stay as they are.

    **Raises:** `MissingExtra` without MuJoCo; `FileNotFoundError`; `ValueError` for a model that
    does not compile or that MJX cannot do, times that do not fit, and functions that do not.
    """
    compiled = load(model).compiled
    timestep = float(compiled.opt.timestep)
    substeps = round(control_period / timestep)
    if substeps < 1 or abs(substeps * timestep - control_period) > 1e-6 * timestep:
        raise ValueError(
            "control_period must be a positive multiple of the model's timestep "
            f"{timestep:g} s; got {control_period!r}"
        )
    check_count("time_limit", time_limit)
    if compiled.nu == 0:
        raise ValueError("the model has no actuator for an action to act on")
    chosen = Continuous(-1.0, 1.0, int(compiled.nu)) if action is None else action
    if control is None:
        if not isinstance(chosen, Continuous) or chosen.size != compiled.nu:
            raise ValueError(
                f"{chosen} needs control=..., a function to the signals of {compiled.nu} actuators"
            )
        control = _spread(compiled) if action is None else _itself
    task = MjxTask(
        compiled=compiled,
        action=chosen,
        time_limit=time_limit,
        substeps=substeps,
        reward=reward,
        observe_data=observe or (lambda data: jnp.concatenate([data.qpos, data.qvel])),
        initial=initial or (lambda key, qpos, qvel: (qpos, qvel)),
        terminate=terminate or (lambda data: False),
        control=control,
        vary=vary or (lambda key, model: {}),
    )
    _check(task)
    return task


def _check(task: MjxTask) -> None:
    try:
        model, _ = task._mjx()
    except NotImplementedError as error:
        raise ValueError(f"MJX cannot do this model: {error}") from error
    key = jax.eval_shape(lambda: jax.random.key(0))
    fields = [name for name in vars(model) if hasattr(getattr(model, name), "dtype")]
    check_names(
        "field of the MJX model", jax.eval_shape(lambda k: task.vary(k, model), key), fields
    )
    start = jax.eval_shape(task.reset, key)
    for name, wanted in (("qpos", task.compiled.qpos0.shape), ("qvel", (task.compiled.nv,))):
        if getattr(start, name).shape != wanted:
            raise ValueError(
                f"initial must return (qpos, qvel), {name} of shape {list(wanted)}; "
                f"got {outline(getattr(start, name))}"
            )
    shape, kind = ((), jnp.int32)
    if isinstance(task.action, Continuous):
        shape, kind = ((task.action.size,), jnp.float32)
    action = jax.ShapeDtypeStruct(shape, kind)
    jax.eval_shape(task.step, key, start, action)
    jax.eval_shape(task.observe, start)


def _itself(action: Array) -> Array:
    return action


def _spread(compiled: Any) -> Callable[[Array], Array]:
    if not compiled.actuator_ctrllimited.all():
        return _itself
    low, high = compiled.actuator_ctrlrange.T
    return lambda action: jnp.asarray((high + low) / 2) + jnp.asarray((high - low) / 2) * action
