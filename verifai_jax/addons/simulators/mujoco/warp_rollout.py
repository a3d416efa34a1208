"""MuJoCo Warp: a batch in lock-step on a GPU, or slowly on a CPU, for the loop of `native_rollout`.

`WarpBatch` has those methods of `mujoco.batch.Batch` that the loop calls. The values of a model
that differ between rows, and what MuJoCo derives from them, come from such a batch in C and are
copied to the device, so they are the same on both engines. All numbers on the device are float32.
"""

import copy
import warnings
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool

from verifai_jax.addons.simulators.mujoco.bindings import APPLIED, STATE, Bindings
from verifai_jax.addons.simulators.mujoco.part_paths import MjModel
from verifai_jax.core.messages.errors import MissingExtra, require

TINY = 1e-9
"""A bound value instead of zero: Warp leaves out forces whose numbers are zero in the model."""


def warp_module() -> ModuleType:
    """Import `mujoco_warp`, without messages of each kernel that it loads.

    **Raises:** `MissingExtra`.
    """
    require("warp", extra="warp").config.quiet = True
    return require("mujoco_warp", extra="warp")


def why_not(bindings: Bindings) -> str | None:
    """Return the reason why MuJoCo Warp cannot simulate a model; None if it can."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # Such friction may give NaN, which is a status of the row.
            warnings.filterwarnings("ignore", ".*may cause NaN")
            _put(bindings.model.compiled, bindings)
    except MissingExtra as error:
        return str(error)
    except (NotImplementedError, ValueError, UserWarning) as error:
        said = str(error).removesuffix(".")
        return f"MuJoCo Warp does not support this model: {said}; backend 'native' does"
    return None


def _put(compiled: MjModel, bindings: Bindings) -> Any:
    """Return the model on the device, with the model's own values."""
    mujoco = require("mujoco", extra="mujoco")
    compiled = copy.copy(compiled)
    # Flags that forbid what Warp never does, such as to reset a simulation that becomes NaN.
    flags = mujoco.mjtDisableBit
    compiled.opt.disableflags &= ~int(flags.mjDSBL_AUTORESET | flags.mjDSBL_MIDPHASE)
    for name in bindings.arrays:
        owner, name = (compiled.opt, name[4:]) if name.startswith("opt.") else (compiled, name)
        value = np.asarray(getattr(owner, name))
        filled = np.where(value == 0, TINY, value)
        setattr(owner, name, filled) if value.ndim else setattr(owner, name, float(filled))
    model = warp_module().put_model(compiled)
    model.opt.warn_overflow = 0
    return model


class WarpBatch:
    """Simulations of a model with MuJoCo Warp, through the interface of `mujoco.batch.Batch`.

    **Arguments:**
    - `compiled`: a `mujoco.MjModel`; `rows`: the number of simulations.
    - `bindings`: what features change in it.
    """

    def __init__(self, compiled: MjModel, rows: int, bindings: Bindings) -> None:
        self.compiled, self.rows, self.bindings = compiled, rows, bindings
        self.mjw, self.warp = warp_module(), require("warp", extra="warp")
        self.values = require("mujoco.batch", extra="mujoco").Batch(compiled, rows)
        # Warp never computes the poses of geoms that cannot move.
        self.fixed = {name: self.values.bind(name) for name in ("geom_xpos", "geom_xmat")}
        self.host: dict[str, np.ndarray] = {}
        self.capacity: dict[str, int] = {}
        self.data = self._make()

    @cached_property
    def model(self) -> Any:
        model = _put(self.compiled, self.bindings)
        if self.warp.get_device().is_cuda:
            model.opt.deterministic = True  # A row that is simulated again must be the same.
        return model

    def _make(self) -> Any:
        return self.mjw.make_data(self.compiled, nworld=self.rows, **self.capacity)

    def expand(self, name: str) -> np.ndarray:
        """Return the values of a field of the model, by row, to be written before `reset`."""
        return self.values.expand(name)

    def set_const(self) -> None:
        """Compute the constants that MuJoCo derives from the model's values."""
        self.values.set_const()

    def bind(self, name: str) -> np.ndarray:
        """Return an array of the state by row, which calls read and write."""
        if name not in self.host:
            here = getattr(self.data, name).numpy()
            self.host[name] = np.array(here, np.float32)
        return self.host[name]

    def reset(self, stage: int) -> None:
        """Begin with the model's values of each row, which must be written by then."""
        module, model = require("mujoco.batch", extra="mujoco"), self.model
        for name in module.MODEL_FIELDS:
            if (values := self.values.expanded(name)) is not None:
                if name == "opt.impratio":
                    name, values = "opt.impratio_invsqrt", 1 / np.sqrt(values)
                owner, name = (model.opt, name[4:]) if name.startswith("opt.") else (model, name)
                # What it lacks serves rays and sleep alone.
                if (old := getattr(owner, name, None)) is not None and old.shape[:1] == (1,):
                    values = np.float32(values).reshape(self.rows, *old.numpy().shape[1:])
                    setattr(owner, name, self.warp.array(values, dtype=old.dtype))
        self.mjw.reset_data(model, self.data)
        self.values.reset(stage=max(stage, 1))
        self._put_fixed()
        self._pull(np.ones(self.rows, bool))

    def _put_fixed(self) -> None:
        for name, values in self.fixed.items():
            there = getattr(self.data, name)
            there.assign(np.float32(values).reshape(there.numpy().shape))

    def forward(self, stage: int) -> None:
        """Compute what follows from positions, and at stage 2 from velocities, with its sensors."""
        self._push()
        self._derive(stage)
        self._pull(np.ones(self.rows, bool))

    def step(self, ids: Bool[np.ndarray, " n"] | None, nstep: int, stage: int) -> None:
        """Advance rows by some steps, then compute as `forward` does; the others keep their state.

        **Raises:** `mujoco.batch.SimulationError` with the rows in which contacts were lost.
        """
        kinds, state = self.mjw.OverflowType, self.mjw.State
        module, mujoco = require("mujoco.batch", extra="mujoco"), require("mujoco", extra="mujoco")
        going = np.ones(self.rows, bool) if ids is None else ids
        self._push()
        spec = int(state.INTEGRATION)
        size = mujoco.mj_stateSize(self.compiled, spec)
        before = self.warp.zeros((self.rows, size), dtype=float)
        self.mjw.get_state(self.model, self.data, before, spec)
        room = kinds.NEFC | kinds.NJMAX_NNZ | kinds.BROADPHASE | kinds.NARROWPHASE | kinds.CCD
        while True:
            self.data.overflow.zero_()
            self._advance(nstep)
            flags = self.data.overflow.numpy()
            if not np.any(flags & int(room)):
                break
            # Contacts did not fit: the same steps again, with room for twice as many.
            data = self.data
            self.capacity = {"nconmax": 2 * data.naconmax // self.rows, "njmax": 2 * data.njmax}
            self.data = self._make()
            self._put_fixed()
            self.mjw.set_state(self.model, self.data, before, spec)
        if stage:
            self._derive(stage)
        lost = kinds.HFIELD | kinds.CONTACT_MATCH | kinds.EPA_HORIZON | kinds.TACTILE
        failed = going & (flags & int(lost) != 0)
        self._pull(going & ~failed)
        if failed.any():
            raise module.SimulationError(np.flatnonzero(failed), "contacts exceed Warp's buffers")

    def _advance(self, nstep: int) -> None:
        for _ in range(nstep):
            self.mjw.step(self.model, self.data)

    def _derive(self, stage: int) -> None:
        self.mjw.fwd_position(self.model, self.data, factorize=False)
        self.mjw.sensor_pos(self.model, self.data)
        if stage > 1:
            self.mjw.fwd_velocity(self.model, self.data)
            self.mjw.sensor_vel(self.model, self.data)

    def _push(self) -> None:
        """Copy the state and the inputs of all rows to the device."""
        for name in {*STATE, *APPLIED} & {*self.host}:
            # What has become NaN is never read again, and must not touch anything.
            there, values = getattr(self.data, name), np.nan_to_num(self.host[name])
            there.assign(values.reshape(there.numpy().shape))

    def _pull(self, rows: Bool[np.ndarray, " n"]) -> None:
        """Copy what is bound from the device, in some rows."""
        for name in {*self.host} - {*APPLIED}:
            self.host[name][rows] = getattr(self.data, name).numpy()[rows]
