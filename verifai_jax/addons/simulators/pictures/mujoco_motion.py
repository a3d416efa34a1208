"""Positions of a MuJoCo model's bodies in a simulation by MuJoCo itself, MJX, or Brax.

motion = record(replay)                        # the model of these features, and where it was
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from verifai_jax.addons.simulators.environments import Brax
from verifai_jax.addons.simulators.mujoco.system import MuJoCo
from verifai_jax.addons.simulators.pictures.frames import caption_of, decided_at
from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.values.waveform import set_durations
from verifai_jax.evaluation.replay import Replay


@dataclass(frozen=True, eq=False)
class Motion:
    """A model, and its positions at each valid sample.

    - `model`: a separate `mujoco.MjModel`, with the features applied.
    - `clock`: time of each sample in seconds.
    - `pushes`: external forces and torques on the bodies.
    - `caption`: the caption of the frames.
    - `decisive`: the sample that decided a failure; None if the property held.
    """

    model: Any
    clock: Float[np.ndarray, " samples"]
    qpos: Float[np.ndarray, "samples nq"]
    pushes: Float[np.ndarray, "samples nbody 6"]
    caption: str = ""
    decisive: int | None = None


def can_draw(system: object) -> bool:
    """Return whether a system has a MuJoCo model that can be drawn."""
    return isinstance(system, MuJoCo) or _model_of(system) is not None


def _model_of(system: object) -> Any:
    """Return the MuJoCo model of an environment of Brax or MuJoCo Playground; None without one."""
    if not isinstance(system, Brax):
        return None
    env = getattr(system.env, "unwrapped", system.env)
    return getattr(getattr(env, "sys", None), "mj_model", getattr(env, "mj_model", None))


def record(replay: Replay) -> Motion:
    """Simulate a replay once more with the same engine, and keep the positions.

    **Raises:** `ValueError` for a system without a MuJoCo model.
    """
    system: Any = replay.problem.system
    if not can_draw(system):
        raise ValueError(f"the system of problem {replay.problem.name!r} has no MuJoCo model")
    clock = np.asarray(replay.trace.clock(), np.float64)
    samples = len(clock)
    leaves, acting = {}, {}
    if isinstance(system, Brax) and system.signals is None and "q" in replay.trace.signals:
        # Its positions are among the signals then.
        qpos = np.asarray(replay.trace["q"], np.float64).reshape(samples, -1)
    else:
        # Kept with the problem, as they are compiled once.
        simulate, placed = replay.problem.programs.get(RECORDERS, None, lambda: _recorder(system))
        precise = any(np.asarray(v).dtype == np.float64 for v in replay.trace.signals.values())
        features = set_durations(replay.features, system.duration)
        with jax.enable_x64(precise):
            trace = simulate(features, getattr(replay, "key", None))
            qpos = np.asarray(trace["qpos"], np.float64)[:samples]
            if placed is not None:
                loop: Any = system.loop  # pyright: ignore[reportAttributeAccessIssue]
                times = loop.control_period * np.arange(loop.periods + 1)
                leaves, acting = placed(features, times)
    model = copy.copy(system.loop.compiled if isinstance(system, MuJoCo) else _model_of(system))
    if qpos.shape[1] != model.nq:
        raise ValueError(
            f"the model of problem {replay.problem.name!r} has {model.nq} positions, and its "
            f"simulation {qpos.shape[1]}, so that it cannot be drawn"
        )
    for name, value in leaves.items():
        owner, field = (model.opt, name[4:]) if name.startswith("opt.") else (model, name)
        array = getattr(owner, field)
        array[...] = np.asarray(value).reshape(array.shape)
    pushes = np.zeros((samples, model.nbody, 6))
    if "xfrc_applied" in acting:
        pushes[...] = acting["xfrc_applied"][:samples]
    return Motion(model, clock, qpos, pushes, caption_of(replay), decided_at(replay))


RECORDERS: Slot[None, tuple[Callable[..., Any], Callable[..., Any] | None]] = Slot("recorders")
"""Compiled functions that simulate one replay of a problem with its positions."""


def _recorder(system: Any) -> tuple[Any, Any]:
    """Return the system with its positions as the only signal, and what features set, compiled."""
    if isinstance(system, Brax):
        return jax.jit(replace(system, signals=_positions_of_state)), None
    loop = system.loop

    def positions(time: Any, state: Any, control: Any, features: Any) -> dict[str, Any]:
        return {"qpos": state.qpos}

    def placed(features: Any, times: Any) -> tuple[Any, Any]:
        acting = jax.vmap(lambda time: loop.bindings.applied_at(features, time))(times)
        return loop.bindings.leaves(features), acting

    recorder = replace(system, loop=replace(loop, signals=positions))
    return recorder if recorder.black_box else jax.jit(recorder), jax.jit(placed)


def _positions_of_state(
    state: Any, observation: Any, action: Any, reward: Any, features: Any
) -> dict[str, Any]:
    """Return the positions of a state of Brax, or of MuJoCo Playground."""
    physics = getattr(state, "pipeline_state", None)
    return {"qpos": state.data.qpos if physics is None else physics.q}
