"""MuJoCo models as tasks to train on, stepped by MJX.

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

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Key, Shaped

from verifai_jax.addons.rl.task.stepping import abstract_action
from verifai_jax.addons.simulators.mujoco.model import load, mjx_module
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import check_names, suggests_options
from verifai_jax.systems.actions import Action, Continuous
from verifai_jax.systems.pytree_checks import outline

MjModel: TypeAlias = Any
MjxData: TypeAlias = Any
MjxModel: TypeAlias = Any
"""`mujoco.MjModel`, `mujoco.mjx.Data` and `Model`, which are imported only where they are used."""
Reward = Callable[[MjxData, Array, MjxData], ArrayLike]
Observe = Callable[[MjxData], ArrayLike]
Initial = Callable[[Key[Array, ""], Array, Array], tuple[ArrayLike, ArrayLike]]
Terminate = Callable[[MjxData], ArrayLike]
Control = Callable[[Array], ArrayLike]
Vary = Callable[[Key[Array, ""], MjxModel], Mapping[str, ArrayLike]]


class MjxState(NamedTuple):
    """The state of an episode: joints and activations, as in MuJoCo; accelerations from which the
    constraint solver starts; fields of the model that have their own values in this episode, by
    name.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    act: Float[Array, " na"]
    warmstart: Float[Array, " nv"]
    varied: dict[str, Array]


@dataclass(frozen=True, eq=False)
class MjxTask:
    """A task of a MuJoCo model, made by `mjx_task`, which documents its parts.

    - `compiled`: the model.
    - `substeps`: number of model steps in one step of the task.
    """

    compiled: MjModel
    action: Action
    time_limit: int
    substeps: int
    reward: Reward
    observe_data: Observe
    initial: Initial
    terminate: Terminate
    control: Control
    vary: Vary

    def reset(self, key: Key[Array, ""]) -> MjxState:
        """Return the model's start, changed by `initial` and `vary`."""
        model, blank = self._mjx
        start_key, vary_key = jax.random.split(key)
        qpos, qvel = self.initial(start_key, blank.qpos, blank.qvel)
        varied = {
            name: jnp.asarray(value, getattr(model, name).dtype)
            for name, value in self.vary(vary_key, model).items()
        }
        qpos, qvel = jnp.asarray(qpos, blank.qpos.dtype), jnp.asarray(qvel, blank.qvel.dtype)
        return MjxState(qpos, qvel, blank.act, jnp.zeros_like(blank.qacc_warmstart), varied)

    def step(
        self, key: Key[Array, ""], state: MjxState, action: Shaped[Array, "..."]
    ) -> tuple[MjxState, Float[Array, ""], Bool[Array, ""]]:
        """Take one control period.

        If the next state is not finite the episode ends in the previous state, without a reward.
        """
        mjx = mjx_module()
        model, before = self._at(state)
        data = before.replace(ctrl=jnp.asarray(self.control(action)).reshape(before.ctrl.shape))
        data = jax.lax.fori_loop(0, self.substeps, lambda _, d: mjx.step(model, d), data)
        after = MjxState(data.qpos, data.qvel, data.act, data.qacc_warmstart, state.varied)
        finite = jnp.all(jnp.isfinite(jnp.concatenate([after.qpos, after.qvel, after.act])))
        # A NaN would not stay in one episode: it would poison what is learnt from all of them.
        after = jax.tree.map(lambda new, old: jnp.where(finite, new, old), after, state)
        following = self._at(after)[1]
        reward = jnp.asarray(self.reward(before, action, following), jnp.float32).reshape(())
        over = jnp.asarray(self.terminate(following), bool).reshape(())
        return after, jnp.where(finite, reward, 0.0), over | ~finite

    def observe(self, state: MjxState) -> Float[Array, " k"]:
        """Return what the policy observes, `[k]`."""
        return jnp.ravel(jnp.asarray(self.observe_data(self._at(state)[1]), jnp.float32))

    def _at(self, state: MjxState) -> tuple[MjxModel, MjxData]:
        """Return the model of an episode, and data with positions of bodies and sites."""
        mjx = mjx_module()
        model, blank = self._mjx
        if state.varied:
            model = model.tree_replace(state.varied)
        data = blank.replace(
            qpos=state.qpos, qvel=state.qvel, act=state.act, qacc_warmstart=state.warmstart
        )
        # The compiler removes the parts that reward, observation and end do not use.
        return model, mjx.kinematics(model, data)

    @cached_property
    def _mjx(self) -> tuple[MjxModel, MjxData]:
        mjx = mjx_module()
        # Constants of every program that is traced, so never traced themselves.
        with jax.ensure_compile_time_eval():
            model = mjx.put_model(self.compiled, impl="jax")
            return model, mjx.make_data(self.compiled, impl="jax")


@suggests_options
def mjx_task(
    model: object, *, control_period: float, time_limit: int, reward: Reward,
    observe: Observe | None = None, initial: Initial | None = None,
    terminate: Terminate | None = None, action: Action | None = None,
    control: Control | None = None, vary: Vary | None = None,
) -> MjxTask:  # fmt: skip
    """Make a `Task` from a MuJoCo model.

    **Arguments:**
    - `model`: the path of an MJCF file, its text, an `mujoco.MjSpec` or an `mujoco.MjModel`.
    - `control_period`: duration of a step in seconds, a multiple of the model's timestep.
    - `time_limit`: number of steps after which an episode is truncated.
    - `reward(before, action, after) -> number`: the reward of one step. `before` and `after` are
      MJX data with joints, activations, and positions of bodies, geoms and sites; they contain no
      sensors or forces.
    - `observe(data) -> [k]`: the policy's observation; `qpos` and `qvel` when left out.
    - `initial(key, qpos, qvel) -> (qpos, qvel)`: the start; the model's own when left out.
    - `terminate(data) -> bool`: ends an episode for good.
    - `action`: the kind of action; one from -1 to 1 for each actuator when left out.
    - `control(action) -> [nu]`: the actuators' signals. By default a continuous action itself; if
      all actuators have a `ctrlrange`, [-1, 1] is mapped to these.
    - `vary(key, model) -> {field: array}`: fields of the MJX model that differ between episodes,
      `{"body_mass": ...}`. Constants that MuJoCo derives from them are not updated.
    **Returns:** a task; its states are `MjxState`.
    **Raises:** `MissingExtra` without MuJoCo; `FileNotFoundError`; `ValueError` for a model that
    does not compile or that MJX does not support, times that are not multiples of the model's
    timestep, and functions whose results have a wrong shape.
    """
    compiled = load(model).compiled
    timestep = float(compiled.opt.timestep)
    substeps = round(control_period / timestep)
    if substeps < 1 or abs(substeps * timestep - control_period) > 1e-6 * timestep:
        raise ValueError(
            "control_period must be a positive multiple of the model's timestep "
            f"{timestep:zg} s; got {control_period!r}"
        )
    check_count("time_limit", time_limit)
    if compiled.nu == 0:
        raise ValueError("the model has no actuator for an action to act on")
    kind = Continuous(-1.0, 1.0, int(compiled.nu)) if action is None else action
    if control is None:
        if not isinstance(kind, Continuous) or kind.size != compiled.nu:
            raise ValueError(
                f"{kind} needs control=..., a function that returns the signals of "
                f"{compiled.nu} actuators"
            )
        control = _over_control_range(compiled) if action is None else jnp.asarray
    task = MjxTask(
        compiled=compiled, action=kind, time_limit=time_limit, substeps=substeps, reward=reward,
        observe_data=observe or (lambda data: jnp.concatenate([data.qpos, data.qvel])),
        initial=initial or (lambda key, qpos, qvel: (qpos, qvel)),
        terminate=terminate or (lambda data: False), control=control,
        vary=vary or (lambda key, model: {}),
    )  # fmt: skip
    _check(task)
    return task


def _check(task: MjxTask) -> None:
    try:
        model, _ = task._mjx
    except NotImplementedError as error:
        raise ValueError(f"MJX does not support this model: {error}") from error
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
    action = abstract_action(task.action)
    jax.eval_shape(task.step, key, start, action)
    jax.eval_shape(task.observe, start)


def _over_control_range(compiled: MjModel) -> Control:
    if not compiled.actuator_ctrllimited.all():
        return jnp.asarray
    low, high = compiled.actuator_ctrlrange.T
    return lambda action: jnp.asarray((high + low) / 2) + jnp.asarray((high - low) / 2) * action
