"""A configuration of a sweep with its policy, in a folder that other programs can read.

best = load_configuration(sweep.export("best"))     # best/configuration.json, best/policy.onnx
best.train(study)                                   # trained again, to the same bits
"""

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from verifai_jax._version import __version__
from verifai_jax.addons.rl.policies import policy as load
from verifai_jax.addons.training.sweeps.clock import Clock
from verifai_jax.addons.training.sweeps.record import TrainedPolicy
from verifai_jax.addons.training.sweeps.running import runs_of
from verifai_jax.addons.training.sweeps.study import Study, StudyError
from verifai_jax.addons.training.sweeps.trainer import takes
from verifai_jax.core.compute.devices import describe_processor
from verifai_jax.core.store import files
from verifai_jax.core.store.cache import Cache
from verifai_jax.core.store.foreign_files import read_bytes
from verifai_jax.core.store.locks import write_lock
from verifai_jax.core.store.replacements import replacing_all

CONFIGURATION, POLICY = "configuration.json", "policy.onnx"
log = logging.getLogger("verifai_jax.sweeps")


@dataclass(frozen=True, eq=False)
class TrainedConfiguration:
    """A configuration that was trained: all that is needed to train it again, and its policy.

    - `study`: the name of the study.
    - `hyperparameters`: their values, with `steps` if it was swept: those of the whole training.
    - `seed`, `steps`: the training seed, and the environment steps of the policy.
    - `called`: the steps with which a training function was called that reports checkpoints.
    - `certificate`: `verdict`, `failures`, `simulations`, the ends of the interval, and the nominal
      return.
    - `before`: for one of a population the earlier `[steps, hyperparameters]`: what it was trained
      with, up to so many steps.
    - `weights`: the checksum of the policy's numbers.
    - `version`, `processor`: what determines the last digits of a training.
    - `policy`: the policy.
    """

    study: str
    hyperparameters: dict[str, Any]
    seed: int
    steps: int
    called: int
    certificate: dict[str, Any]
    weights: int
    version: str
    processor: str
    policy: TrainedPolicy = field(repr=False)
    before: list[Any] = field(default_factory=list)

    def export(self, folder: str | Path) -> Path:
        """Write the configuration as JSON and its policy as ONNX; return the folder.

        **Raises:** `MissingExtra` without the package onnx; `OSError` if the file system refuses.
        """
        folder = Path(folder)
        with write_lock(folder), replacing_all(folder, (POLICY, CONFIGURATION)) as made:
            self.policy.save(made / POLICY)
            onnx = files.checksum(read_bytes(made / POLICY))
            record = {n: value for n, value in vars(self).items() if n != "policy"} | {"onnx": onnx}
            files.write_record(made / CONFIGURATION, files.plain(record))
        return folder

    def train(self, study: Study) -> TrainedPolicy:
        """Train the configuration again with its study, which has the trainer.

        Where version and processor are the same the policy is the same, to the last bit; if it is
        not, a warning says so.

        **Raises:** `StudyError` for a study of another name or without a checkpoint at `steps`, and
        with the reason if the training fails.
        """
        if study.name != self.study:
            raise StudyError(f"the configuration is of {self.study!r}; got study {study.name!r}")
        runs = runs_of(study, Cache(), Clock(study.name, None, False))
        lineage = [*(values for _, values in self.before), self.hyperparameters]
        number = runs.add(lineage[0], self.seed)
        checkpoints = runs.runs[number].checkpoints
        for at in (*(at for at, _ in self.before), self.steps, self.called):
            if at not in checkpoints:
                raise StudyError(f"its policy is that of {at} steps; got {checkpoints}")
        for (at, _), values in zip(self.before, lineage[1:], strict=True):
            number = runs.fork(number, checkpoints.index(at), values)
        own = getattr(study.trainer, "train", None)
        trains_to = self.called if own is not None and takes(own, "checkpoint") else self.steps
        runs.train([number], checkpoints.index(trains_to))
        trained = runs.checkpoint(number, checkpoints.index(self.steps))
        if trained is None:
            raise StudyError(f"the configuration does not train: {runs.errors[number]}")
        if weights_of(trained.policy) != self.weights:
            there = f"{self.processor}, version {self.version}"
            here = f"{describe_processor()}, version {__version__}"
            log.warning("the policy of %s has other numbers here: %s", there, here)
        return trained.policy


def weights_of(policy: PyTree) -> int:
    """Return the checksum of all numbers of a policy."""
    total = 0
    for leaf in jax.tree.leaves(policy):
        total = files.checksum(np.ascontiguousarray(leaf).tobytes(), total)
    return total


def load_configuration(folder: str | Path) -> TrainedConfiguration:
    """Read a configuration that `Sweep.export` has written. The files never name code.

    **Raises:** `FileNotFoundError` for a folder without one; `DamagedError` for one that has
    changed since; the errors of `vj.policy`.
    """
    record, file = files.read_record(Path(folder) / CONFIGURATION), Path(folder) / POLICY
    # Exports of earlier versions lack `onnx` and `called`.
    if "onnx" in record and record.pop("onnx") != files.checksum(read_bytes(file)):
        raise files.DamagedError(f"{file} is not the policy of {CONFIGURATION}, or is damaged")
    record.setdefault("called", record.get("steps"))
    try:
        return TrainedConfiguration(**record, policy=load(file))
    except TypeError as error:
        raise files.DamagedError(f"{folder} has no configuration of a sweep: {error}") from error
