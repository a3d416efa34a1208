"""MuJoCo in JAX: one simulation as a pure function, to be vmapped, jitted and differentiated.

A physics step is MuJoCo's, divided into two parts: kinematics, contacts and sensors of the present
state, then forces and integration. The controller runs between them, so only the accelerations and
forces that it reads are those of the previous step.
"""

import copy
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from verifai_jax.addons.simulators.mujoco.bindings import Bindings
from verifai_jax.addons.simulators.mujoco.derived_constants import recompute_constants
from verifai_jax.addons.simulators.mujoco.loop import Loop, Progress, Sample
from verifai_jax.addons.simulators.mujoco.model import MjxData, MjxModel, Model, mjx_module
from verifai_jax.addons.simulators.mujoco.part_paths import MjModel
from verifai_jax.core.compute.derivatives import with_derivative_of
from verifai_jax.core.messages.errors import require
from verifai_jax.core.values.trace import Status
from verifai_jax.systems.base import Features, Seed
from verifai_jax.systems.forks import LoopState, Rollout

# Values at which MJX looks once, to see whether there is any friction; features may change them.
_SWITCHES = ("dof_frictionloss", "tendon_frictionloss")
MIN_POSITIVE = 1e-9
"""Friction instead of zero: MJX takes a row of friction without friction for an equality."""


class Physics(NamedTuple):
    """The carry from one physics step to the next."""

    qpos: Array
    qvel: Array
    act: Array
    qacc_warmstart: Array
    sensordata: Array


def rollout(loop: Loop, features: Features, key: Seed) -> Rollout:
    """Return one simulation as a loop over its samples."""
    mjx = mjx_module()
    model, blank = prepare_model(loop.bindings, features)
    if not _is_one(loop.finer):
        model = model.tree_replace({"opt.timestep": model.opt.timestep / loop.finer})
    substeps = loop.substeps * loop.finer
    start = loop.start(features, key)
    blank = blank.replace(**{n: v for n, v in start.items() if n not in Physics._fields})
    physics = Physics(
        **{name: start[name] for name in ("qpos", "qvel", "act")},
        qacc_warmstart=jnp.zeros_like(start["qvel"]),
        sensordata=blank.sensordata,
    )
    progress = loop.initial_progress(features, key)
    arrays = {name: jnp.zeros(shape, physics.qpos.dtype) for name, shape in loop.shapes.items()}
    form: Sample = jax.eval_shape(lambda: loop.sample(jnp.int32(0), arrays, progress, features)[0])

    def step(
        physics: Physics, time: Array,
        decide: Callable[[MjxData], tuple[Iterable[tuple[str, Array]], PyTree]],
    ) -> tuple[Physics, Any]:  # fmt: skip
        data = blank.replace(time=time, **physics._asdict())
        data = mjx.sensor_pos(model, mjx.fwd_position(model, data))
        data = mjx.sensor_vel(model, mjx.fwd_velocity(model, data))
        inputs, rest = decide(data)
        data = data.replace(**{name: v.reshape(getattr(data, name).shape) for name, v in inputs})
        data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
        data = (
            solve_constraints(model, data)
            if data._impl.efc_J.size
            else data.replace(qacc=data.qacc_smooth)
        )
        data = mjx.sensor_acc(model, data)
        moved = _integrator(mjx, model)(model, data)
        after = {name: getattr(moved, name) for name in Physics._fields}
        # Runge-Kutta evaluates the sensors at its inner stages too.
        return Physics(**{**after, "sensordata": data.sensordata}), rest

    def sample(carry: LoopState, k: Int[Array, ""]) -> Any:
        before, finite = carry.plant
        progress = Progress(carry.memory, carry.age, finite, carry.links)
        time = progress.age.astype(before.qpos.dtype) * loop.control_period

        def substep(carry: PyTree, j: Int[Array, ""]) -> Any:
            physics, sampled, after = carry

            def decide(data: MjxData) -> Any:
                def look() -> Any:
                    arrays = {name: getattr(data, name) for name in loop.shapes}
                    return loop.sample(k, arrays, progress, features)

                if _is_one(substeps):
                    decided = look()
                else:
                    # The counter is common to all lanes of a batch: this stays a branch.
                    decided = jax.lax.cond(j == 0, look, lambda: (sampled, after))
                return decided[0].inputs.items(), decided

            physics, (sampled, after) = step(physics, time + j * model.opt.timestep, decide)
            return (physics, sampled, after), None

        blank_sample = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), form)
        begun = (before, blank_sample, progress)
        if isinstance(substeps, int):
            (after, sampled, progress), _ = jax.lax.scan(substep, begun, jnp.arange(substeps))
        else:  # Traced: a loop without a derivative in reverse mode.
            after, sampled, progress = jax.lax.fori_loop(
                0, substeps, lambda j, carry: substep(carry, j)[0], begun
            )
        held = jax.tree.map(lambda new, old: jnp.where(sampled.frozen, old, new), after, before)
        return _state_of(held, progress), sampled.signals

    def scan(step: Callable[..., Any], carry: PyTree, length: int) -> Any:
        # Reverse mode keeps the state at each sample, and does a control period again for what is
        # between: memory does not grow with the substeps.
        return jax.lax.scan(jax.checkpoint(step, prevent_cse=False), carry, jnp.arange(length))

    def status(last: LoopState) -> Any:
        status = jnp.where(last.plant[1], jnp.int32(Status.OK), jnp.int32(Status.NONFINITE))
        return jnp.where(loop.channels(features).valid(), status, jnp.int32(Status.ERROR))

    return Rollout(
        _state_of(physics, progress), sample, loop.periods + 1, loop.control_period, status,
        loop.terminate is not None, loop.finite_signals(), scan,
    )  # fmt: skip


def _state_of(physics: Physics, progress: Progress) -> LoopState:
    plant = (physics, progress.finite)
    return LoopState(plant, progress.memory, progress.states, progress.age)


def _is_one(count: int | Int[Array, ""]) -> bool:
    return isinstance(count, int) and count == 1


def solve_constraints(model: MjxModel, data: MjxData) -> Any:
    """Return the data after MJX's constraint solver, differentiable in forward and reverse mode.

    The accelerations minimise a convex cost, so their derivative is that of one Newton step at the
    minimum (implicit function theorem). The iterations, a loop of unknown length, are not
    differentiated; the derivative is exact if the result has converged.
    """
    mjx = mjx_module()
    create, update = _solver()
    constant_model, constant = jax.lax.stop_gradient((model, data))
    solution = mjx.solve(constant_model, constant)
    newton = model.tree_replace({"opt.solver": mjx.SolverType.NEWTON})
    constant_newton = constant_model.tree_replace({"opt.solver": mjx.SolverType.NEWTON})
    start = data.replace(qacc=solution.qacc)
    here = create(newton, start, grad=False)
    residual = here.Ma - data.qfrc_smooth - here.qfrc_constraint
    zero = jnp.zeros_like(residual)
    curved = jax.lax.stop_gradient(here).replace(Ma=residual, qfrc_constraint=zero)
    step = update(constant_newton, constant.replace(qfrc_smooth=zero), curved).Mgrad
    qacc = with_derivative_of(solution.qacc, -step)
    there = create(newton, start.replace(qacc=qacc), grad=False)
    return data.tree_replace(
        {
            "qacc": qacc,
            "qfrc_constraint": with_derivative_of(solution.qfrc_constraint, there.qfrc_constraint),
            "_impl.efc_force": with_derivative_of(solution._impl.efc_force, there.efc_force),
        }
    )


def _solver() -> tuple[Any, Any]:
    from mujoco.mjx._src import solver

    return solver.Context.create, solver._update_gradient


def prepare_model(bindings: Bindings, features: Features) -> tuple[Any, Any]:
    """Return the MJX model for one row of features, and blank MJX data.

    **Raises:** `NotImplementedError` for a model that MJX does not support.
    """
    model, blank = _mjx_model(bindings)
    return with_leaves(model, bindings, features), blank


def with_leaves(model: MjxModel, bindings: Bindings, features: Features) -> Any:
    """Return an MJX model with the values set by features, and all values derived from them."""
    if not bindings.arrays:
        return model
    leaves = bindings.leaves(features)
    changes = {}
    for name, value in leaves.items():
        old = _leaf(model, name)
        if name in _SWITCHES:
            value = jnp.maximum(value, MIN_POSITIVE)
        changes[name] = value.reshape(old.shape).astype(old.dtype)
    model = model.tree_replace(changes)
    return recompute_constants(model) if bindings.moves_constants else model


def _mjx_model(bindings: Bindings) -> tuple[Any, Any]:
    """Return the compiled model on the device, in the present precision; made once."""
    mjx = mjx_module()
    precision = bool(jax.config.read("jax_enable_x64"))
    if precision not in bindings.models:
        compiled = copy.copy(bindings.model.compiled)
        for binding in bindings.parameters:
            array, where = binding.location.array, binding.location.index
            if array in _SWITCHES:
                flat = getattr(compiled, array).reshape(-1)
                flat[where] = np.maximum(flat[where], MIN_POSITIVE)
            if array in ("opt.density", "opt.viscosity", "opt.wind"):
                compiled.opt.density = max(compiled.opt.density, MIN_POSITIVE)
        # Constants of every program that is traced, so never traced themselves.
        with jax.ensure_compile_time_eval():
            model = mjx.put_model(compiled, impl="jax")
            bindings.models[precision] = (model, mjx.make_data(model))
    return bindings.models[precision]


def why_not(bindings: Bindings) -> str | None:
    """Return the reason why MJX cannot simulate a model; None if it can."""
    try:
        _mjx_model(bindings)
    except NotImplementedError as error:
        return f"MJX does not support this model: {error}{_cure(bindings.model)}"
    compiled = bindings.model.compiled
    arrays = {"body_pos", "body_quat", "site_pos", "site_quat"}
    if compiled.neq and bindings.arrays & arrays:
        return "MJX does not recompute the anchors of equality constraints that features move"
    if compiled.nplugin:
        return "MJX has no plugins"
    return None


def _cure(model: Model) -> str:
    """Return the lines that make MJX take a model, tried out; empty if none are known."""
    mujoco = require("mujoco", extra="mujoco")
    compiled, lines = copy.copy(model.compiled), []
    known = {int(kind) for kind in mjx_module().SensorType}
    sensors = sorted({int(kind) for kind in compiled.sensor_type} - known)
    if sensors and model.spec is not None:
        spec, kinds = model.spec.copy(), [mujoco.mjtSensor(kind) for kind in sensors]
        for sensor in [each for each in spec.sensors if each.type in kinds]:
            spec.delete(sensor)
        compiled = spec.compile()
        compiled.opt.enableflags = model.compiled.opt.enableflags
        shown = ", ".join(f"mujoco.mjtSensor.{kind.name}" for kind in kinds)
        lines.append(f"for s in [s for s in spec.sensors if s.type in ({shown},)]: spec.delete(s)")
    refused = _refusal(compiled)
    cures = list(_CURES)
    while refused is not None and cures:
        line, attribute, value = cures.pop(0)
        changed = copy.copy(compiled)
        _assign(mujoco, changed, attribute, value)
        now = _refusal(changed)
        if now != refused:
            # What did not help against the refusal before may help against this one.
            cures = [cure for cure in _CURES if cure[0] not in lines and cure[1] != attribute]
            compiled, refused, lines = changed, now, [*lines, line]
    if refused is not None or not lines:
        return ""
    file = next(iter(model.source_files), "model.xml")
    spec = f"spec = mujoco.MjSpec.from_file({Path(file).name!r})"
    return f". Give it the model so: `{'; '.join([spec, *lines])}`, and `spec` instead of the file"


_CURES = (
    ("spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON", "solver", "mjtSolver.mjSOL_NEWTON"),
    (
        "spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST",
        "integrator",
        "mjtIntegrator.mjINT_IMPLICITFAST",
    ),
    (
        "spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER",
        "integrator",
        "mjtIntegrator.mjINT_EULER",
    ),
    ("spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL", "cone", "mjtCone.mjCONE_PYRAMIDAL"),
    ("spec.option.enableflags = 0", "enableflags", 0),
    ("for geom in spec.geoms: geom.margin = geom.gap = 0", "geom", 0.0),
)
"""Lines on a spec, and what each does to a compiled model: the nearest to the model comes first."""


def _assign(mujoco: ModuleType, compiled: MjModel, attribute: str, value: Any) -> None:
    """Do to a compiled model what a line of `_CURES` does to its spec."""
    if attribute == "geom":
        compiled.geom_margin[:] = compiled.geom_gap[:] = value
        return
    if isinstance(value, str):
        kind, name = value.split(".")
        value = getattr(getattr(mujoco, kind), name)
    setattr(compiled.opt, attribute, value)


def _refusal(compiled: MjModel) -> str | None:
    """Return what MJX says against a model; None if it takes it."""
    try:
        mjx = mjx_module()
        mjx.make_data(mjx.put_model(compiled, impl="jax"))
    except NotImplementedError as error:
        return str(error)
    return None


def _leaf(model: MjxModel, name: str) -> Any:
    for part in name.split("."):
        model = getattr(model, part)
    return model


def _integrator(mjx: ModuleType, model: MjxModel) -> Any:
    kind = mjx.IntegratorType
    return {kind.EULER: mjx.euler, kind.RK4: mjx.rungekutta4, kind.IMPLICITFAST: mjx.implicit}[
        model.opt.integrator
    ]


def reverse_hint(compiled: MjModel) -> str | None:
    """Return why reverse mode does not work, and how to make it work; empty if it works."""
    if compiled.opt.integrator != 1 or not has_constraints(compiled):  # 1: Runge-Kutta
        return None
    return (
        "MJX solves constraints in a loop of unknown length, which has no reverse-mode derivative "
        'inside its Runge-Kutta steps: give the model integrator="implicitfast" or "Euler"'
    )


def has_constraints(compiled: MjModel) -> bool:
    """Return True for a model that can have contacts, limits, friction or equalities."""
    data = mjx_module().make_data(compiled, impl="jax")
    return bool(data._impl.efc_J.size)
