"""Trainings by a user's function, each call in one of the processes of a pool.

Global random numbers are seeded before each call, so a policy depends only on the arguments of the
call, unless the function keeps something else for the next. A call that hangs, crashes or exits is
a row, as a simulation is. A function with an argument `resume` gets a folder with a copy of the
files that it left at the previous checkpoint; the original stays until the call has ended and is
stored.
"""

import contextlib
import json
import logging
import random
import shutil
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

from verifai_jax.addons.clusters.executors import gather
from verifai_jax.addons.rl.policies import Policy
from verifai_jax.addons.rl.policies import policy as load
from verifai_jax.addons.rl.policies.onnx_graph import read_graph
from verifai_jax.addons.training.sweeps.clock import Clock
from verifai_jax.addons.training.sweeps.fingerprint import digest
from verifai_jax.addons.training.sweeps.record import Curve
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.trainer import STEPS, FunctionTrainer, takes, whole_number
from verifai_jax.addons.training.sweeps.training_runs import (
    RunCheckpoint,
    TrainingRun,
    TrainingRuns,
)
from verifai_jax.core.compute.cores import available_cores
from verifai_jax.core.compute.executors import Executor
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.cache import Cache
from verifai_jax.core.store.foreign_archives import read_arrays
from verifai_jax.core.store.foreign_files import read_text
from verifai_jax.core.store.log import Arrays
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.systems.blackbox.workers import Pool

log = logging.getLogger("verifai_jax.sweeps")


class FunctionRuns(TrainingRuns):
    """All trainings of a sweep by a function; arguments as in `TrainingRuns`."""

    def __init__(
        self, study: Study, cache: Cache, clock: Clock, executor: Executor | None = None
    ) -> None:
        super().__init__(study, cache, clock)
        self._trainer = cast(FunctionTrainer, study.trainer)
        self._submit = None if executor is None else executor.submit
        trainer = self._trainer
        self._train = partial(train_once, trainer.train, trainer.observation)
        workers = trainer.workers or available_cores()
        self._pool = Pool(self._train, trainer.train, workers, trainer.timeout, retries=0)
        self._pool.what = "training"
        self._faults: dict[Hashable, str] = {}
        if cache.path is None:
            self._folder = Path(tempfile.mkdtemp(prefix="verifai_jax_trainings_"))
            weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        else:
            self._folder = cache.path.absolute().parent / "trainings"
        self._calls_back = takes(trainer.train, "checkpoint")
        if study.checkpoints and not (self._calls_back or takes(trainer.train, "resume")):
            log.warning(
                "%s has neither an argument resume nor checkpoint: it trains anew up to each "
                "checkpoint",
                trainer.name,
            )

    def add(self, values: Mapping[str, object], seed: int) -> int:
        steps = whole_number(values.get(STEPS, self._trainer.steps), STEPS)
        key, checkpoints = digest({**values}), self.study.checkpoints_of(steps)
        self.runs.append(TrainingRun(dict(values), seed, key, checkpoints, None))
        return len(self.runs) - 1

    def train(self, numbers: Sequence[int], rung: int, *, further: bool = False) -> None:
        """Train up to a checkpoint, storing those on the way; see `TrainingRuns.train`."""
        for at in range(rung + 1):
            waiting = []
            for number in numbers:
                if number in self.errors or at >= self.rungs(number):
                    continue
                self._recall(number, at)
                called = number not in self.errors and at in self._calls_of(number, rung)
                if called and not self._has_all(number, at):
                    waiting.append(number)
                elif (number, at) in self._checkpoints:
                    self._advanced(number, at)
            if waiting:
                self._call(waiting, at)
        if not further:
            self.forget(numbers)

    def _calls_of(self, number: int, rung: int) -> range:
        """Return the checkpoints up to which a run is trained by a call of their own."""
        last = min(rung, self.rungs(number) - 1)
        return range(last if self._calls_back else 0, last + 1)

    def forget(self, numbers: Sequence[int]) -> None:
        for number in numbers:
            shutil.rmtree(self._folder_of(number), ignore_errors=True)

    def _call(self, numbers: list[int], at: int) -> None:
        """Call the function for each of these, with at most one call per worker at a time."""
        calls: list[dict[str, Any]] = []
        numbers = [number for number in numbers if self._begins(number, at)]
        for number in numbers:
            run, folder = self.runs[number], self._folder_of(number, at).with_suffix(".part")
            steps = run.checkpoints[at]
            calls.append({"values": dict(run.values), "steps": steps, "folder": str(folder)})
            earlier = enumerate(run.checkpoints[:at])
            calls[-1]["checkpoints"] = [
                c for i, c in earlier if (number, i) not in self._checkpoints
            ]
            if (number, at) in self.changes:
                calls[-1]["starts"] = self.changes[number, at]
        seeds = [self.runs[number].seed for number in numbers]

        def ended(index: int, result: "Arrays | str") -> None:
            number = numbers[index]
            self._take_reported(number, at)
            if isinstance(result, str):
                self.errors[number] = one_line(result)
            else:
                self._end(number, at, result)

        if self._submit is not None:
            pairs = zip(calls, seeds, strict=True)
            futures = [self._submit(attempt, self._train, call, seed) for call, seed in pairs]
            gather(futures, ended, check=self.clock.check)
        else:
            over = threading.Event()
            if self._calls_back:
                threading.Thread(target=self._show, args=(calls, over), daemon=True).start()
            try:
                for index, outcome in self._pool.outcomes(calls, seeds, self.clock.limit):
                    if outcome.status == Status.OK:
                        ended(index, cast("Arrays", outcome.trace))
                    elif outcome.message:  # Others had not begun when the time was over.
                        ended(index, outcome.message)
            finally:
                over.set()
        self.clock.check()

    def _show(self, calls: Sequence[Mapping[str, Any]], over: threading.Event) -> None:
        """Show how far the trainings are that report it; runs in a thread."""
        while not over.wait(1.0):
            steps = [reported_steps(Path(call["folder"])) for call in calls]
            if running := [(n, call["steps"]) for n, call in zip(steps, calls, strict=True) if n]:
                done, total = (sum(each) for each in zip(*running, strict=True))
                self.clock.advance(0, f"in training: {done:,} of {total:,} steps")

    def _begins(self, number: int, at: int) -> bool:
        """Make the folder of a call, with what the call before it left, or say why it cannot be."""
        folder = self._folder_of(number, at).with_suffix(".part")
        shutil.rmtree(folder, ignore_errors=True)
        for reported in folder.parent.glob(_reported(folder, "*").name):
            reported.unlink()
        if not (at and self._folder_of(number, at - 1).exists()):
            folder.mkdir(parents=True)
            return True
        try:
            shutil.copytree(self._folder_of(number, at - 1), folder, symlinks=True)
        except OSError as error:
            self.errors[number] = one_line(f"its files in resume cannot be copied: {error}")
        return number not in self.errors

    def _take_reported(self, number: int, at: int) -> None:
        """Store the policies that a call reported at earlier checkpoints, however it ended."""
        for earlier in range(at if self._calls_back else 0):
            steps = self.runs[number].checkpoints[earlier]
            file = _reported(self._folder_of(number, at), steps)
            if (number, earlier) not in self._checkpoints and file.exists():
                self._store(number, earlier, read_arrays(file, file.name))
                file.unlink()

    def _end(self, number: int, at: int, arrays: Arrays) -> None:
        """Store a finished call, and then let go of the one before it."""
        folder = self._folder_of(number, at)
        shutil.rmtree(folder, ignore_errors=True)
        part = folder.with_suffix(".part")
        part.mkdir(parents=True, exist_ok=True)
        part.rename(folder)
        self._store(number, at, arrays)
        if at:
            shutil.rmtree(self._folder_of(number, at - 1), ignore_errors=True)

    def _store(self, number: int, at: int, arrays: Arrays) -> None:
        self.cache.put({self.cache_name(number, at): arrays})
        self._set_checkpoint(number, at, arrays)
        self._advanced(number, at)

    def _folder_of(self, number: int, at: int | None = None) -> Path:
        run = self.runs[number]
        folder = self._folder / f"{run.key}-{run.seed}"
        return folder if at is None else folder / str(run.checkpoints[at])

    def _advanced(self, number: int, at: int) -> None:
        self.clock.advance(self._steps(number, at) - self._steps(number, at - 1))

    def _set_checkpoint(self, number: int, rung: int, arrays: Arrays) -> None:
        held = {n.removeprefix(ARRAY): a for n, a in arrays.items() if n.startswith(ARRAY)}
        finite = all(bool(np.all(np.isfinite(a))) for a in held.values())
        what = f"the policy of {self.cache_name(number, rung)}"
        plain = {name: np.nan_to_num(array) for name, array in held.items()}
        graph, weights, start = read_graph(json.loads(bytes(arrays["graph"])), plain, what)
        policy = Policy(jax.device_get(weights), graph, jax.device_get(start))
        why = self._why_not_of_the_form(policy) or self._why_not_simulated(policy)
        if why:
            self.errors.setdefault(number, why)
            return
        curve = Curve(arrays["steps"], arrays["mean_return"])
        seconds = float(arrays["seconds"])
        self._checkpoints[number, rung] = RunCheckpoint(policy, finite, curve, seconds)

    def _why_not_of_the_form(self, policy: Policy) -> str:
        """Say that actions have another shape than those of the example, which fits the problem."""
        example = self._trainer.untrained_policy("")
        seen = policy.compute.example(policy.weights)  # pyright: ignore[reportFunctionMemberAccess]
        try:
            made, wanted = (
                jax.eval_shape(partial(_first_action, each), seen) for each in (policy, example)
            )
        except Exception:  # The example may be of other observations.
            return ""
        if made.shape == wanted.shape:
            return ""
        return (
            f"the trained policy returns actions of shape {list(made.shape)}, and example= of the "
            f"trainer, with which the problem was checked, of shape {list(wanted.shape)}"
        )

    def _why_not_simulated(self, policy: Policy) -> str:
        """Say that the problem cannot be simulated with a policy; asked once for each form."""
        leaves, form = jax.tree.flatten(policy)
        key = form, tuple((np.shape(leaf), np.asarray(leaf).dtype) for leaf in leaves)
        if key not in self._faults:
            self._faults[key] = ""
            try:
                self.study.problem(cast(Any, policy)).check()
            except Exception as error:
                self._faults[key] = one_line(str(error))
        return self._faults[key]


ARRAY = "array/"
"""Prefix of the names of a policy's arrays among the stored arrays of a training."""


def _first_action(policy: Any, observation: Any) -> Any:
    memory = getattr(policy, "initial_memory", None)
    return policy.act(observation) if memory is None else policy.act(observation, memory)[0]


def train_once(
    train: Callable[..., Any], observation: Any, call: Mapping[str, Any], seed: int
) -> Trace:
    """Call the training function, and convert its policy to arrays; runs in a process.

    - `call`: the hyper-parameters `values`, the total `steps`, the `folder` to resume from, the
      earlier `checkpoints`, and `starts`, if the function receives it.

    **Returns:** the arrays, which the pool passes on unchanged.
    """
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - what other frameworks draw from.
    if (torch := sys.modules.get("torch")) is not None:
        torch.manual_seed(seed)
    folder = Path(call["folder"])
    reports = Reports(call["checkpoints"], folder, observation)
    given = {"resume": folder, "checkpoint": reports}
    options: dict[str, Any] = {name: value for name, value in given.items() if takes(train, name)}
    if "starts" in call:
        options["starts"] = call["starts"]
    began = time.perf_counter()
    with contextlib.chdir("."):  # Where it is for the next call too.
        made = train(jax.random.key(seed), dict(call["values"]), steps=call["steps"], **options)
    seconds = time.perf_counter() - began
    curve: Mapping[str, Any] = reports.curve
    if isinstance(made, tuple) and len(made) == 2 and isinstance(made[1], Mapping):
        made, curve = (made[0], made[1]) if {*made[1]} == {*curve} else (made, curve)
    if "checkpoint" in options and (
        missing := [at for at in call["checkpoints"] if at > reports.last]
    ):
        raise ValueError(f"checkpoint was not called at {missing[0]} steps or after them")
    return cast(Trace, _encode(made, observation, curve, seconds))


class Reports:
    """What a training function reports: how far it is, its returns, and policies at checkpoints,
    which it writes beside the folder of the call.
    """

    def __init__(self, checkpoints: Sequence[int], folder: Path, observation: Any) -> None:
        self.curve: dict[str, list[float]] = {"steps": [], "mean_return": []}
        self.last, self._began = 0, time.perf_counter()
        self._checkpoints, self._folder, self._observation = checkpoints, folder, observation

    def __call__(self, steps: int, policy: Any, mean_return: float | None = None) -> None:
        """Report a policy after so many environment steps; see `Trainer`."""
        steps = check_count("the steps of a checkpoint", steps)
        if steps <= self.last:
            raise ValueError(f"checkpoint was called at {steps} steps after {self.last} steps")
        passed = [at for at in self._checkpoints if self.last < at <= steps]
        self.last = steps
        if mean_return is not None:
            self.curve["steps"].append(steps)
            self.curve["mean_return"].append(float(mean_return))
        for at in passed:
            self._take(policy, _reported(self._folder, at))
        self._folder.with_suffix(".steps").write_text(str(self.last))

    def _take(self, policy: Any, path: Path) -> None:
        seconds = time.perf_counter() - self._began
        arrays = _encode(policy, self._observation, self.curve, seconds)
        with replacing(path) as made, made.open("wb") as file:
            np.savez(file, **cast(Any, arrays))


def _reported(folder: Path, steps: object) -> Path:
    """Return the file with the policy that the call of a folder reported at a checkpoint."""
    return folder.with_suffix(f".{steps}.npz")


def reported_steps(folder: Path) -> int:
    """Return the steps that a training with this folder has reported; 0 before the first."""
    try:
        return int(read_text(folder.with_suffix(".steps")) or 0)
    except (OSError, ValueError):
        return 0


def _encode(
    made: Any, observation: Any, curve: Mapping[str, Any], seconds: float
) -> dict[str, np.ndarray]:
    graph, arrays, start = load(made, observation=observation).as_graph(observation)
    steps, returns = (np.asarray(curve[name]) for name in ("steps", "mean_return"))
    if steps.shape != returns.shape or steps.ndim != 1 or (np.diff(steps, prepend=0) <= 0).any():
        raise ValueError(
            "a learning curve has a mean_return for each of its steps, which are positive and "
            f"increase; got {len(np.ravel(steps))} steps and {len(np.ravel(returns))} returns"
        )
    held = {**arrays, **{name: s for (name, _), s in zip(graph.memory, start, strict=True)}}
    return {
        "graph": np.frombuffer(json.dumps(graph.to_json()).encode(), np.uint8),
        "steps": steps.astype(np.int64),
        "mean_return": returns.astype(np.float64),
        "seconds": np.asarray(seconds, np.float64),
        **{f"{ARRAY}{name}": array for name, array in held.items()},
    }


def attempt(
    train: Callable[[Mapping[str, Any], int], Trace], call: Mapping[str, Any], seed: int
) -> "Arrays | str":
    """Return the result of `train_once`, or its error as text; runs on a worker."""
    try:
        return cast("Arrays", train(call, seed))
    except Exception as error:
        return format_error(error)
