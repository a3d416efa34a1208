"""A pool of processes that simulate: a hang or a crash costs one simulation, not the run.

Each worker is a new Python process, so no state of this process (threads, JAX, locks) is partly
copied into it. It has its own session: Ctrl-C reaches only this process, and ending a worker also
ends the processes that it has started; on Linux those in sessions of their own too.
"""

import contextlib
import itertools
import logging
import math
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from multiprocessing import Pipe
from typing import Any

from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.systems.base import Features, Outcome
from verifai_jax.systems.blackbox import worker_process
from verifai_jax.systems.blackbox.worker_process import MARK, START, main_guard, pickled_setup

log = logging.getLogger("verifai_jax.workers")
WORKER_ENVIRONMENT = {
    "JAX_PLATFORMS": "cpu",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Environment of a worker, unless the user has set it: one core and no GPU each, since the workers
themselves run in parallel."""
POLL_SECONDS = 0.5
"""Time between two checks that a silent worker is alive."""
SLOW_IMPORT_SECONDS = 30.0
"""Time until the log says that a worker is still importing."""
MAX_IMPORT_SECONDS = 1800.0
"""Time until a worker that is still importing is ended."""
STILL_IMPORTS = "a worker process has not imported the simulator"
DROPPED = "an answer of a worker belonged to another simulation and was dropped"
"""The note of a simulation before whose answer there came one to another question."""
REMEMBERED = 1 << 16
"""Simulations whose workers a pool remembers."""
_numbers = itertools.count()


class StartError(RuntimeError):
    """An error for workers that cannot start, so that their pool cannot simulate."""


class Pool:
    """Processes that each run one simulation at a time; started when first needed.

    **Arguments:**
    - `simulation(features, seed) -> Trace`: picklable, like `function`.
    - `function`: the user's function, which errors name.
    - `workers`, `timeout` (in seconds), `retries`: see `blackbox`.
    **Raises:** `ValueError` for numbers out of range, and a function that a new process cannot
    import.
    """

    what = "simulation"
    """The word for a call in messages."""

    def __init__(
        self, simulation: Callable[[Any, int], Trace], function: Callable[..., object],
        workers: int, timeout: float | None, retries: int,
    ) -> None:  # fmt: skip
        check_count("workers", workers)
        if timeout is not None and not (isinstance(timeout, int | float) and timeout > 0):
            raise ValueError(f"timeout must be a positive number of seconds; got {timeout!r}")
        check_count("retries", retries, 0)
        if os.name != "posix":
            raise ValueError(
                "workers need Linux or macOS; leave them out, or use a remote simulator"
            )
        self._begin(workers, timeout, retries, pickled_setup(simulation, function))

    def __reduce__(self) -> tuple[Any, ...]:
        # Elsewhere it is a pool of its own, which finds the function by its name too.
        return _pool, (self.workers, self.timeout, self.retries, self._setup)

    def _begin(self, workers: int, timeout: float | None, retries: int, setup: bytes) -> None:
        self.workers, self.timeout, self.retries = workers, timeout, retries
        self._setup = setup
        self._slots = threading.Semaphore(workers)
        # Its own operations are all the locking that it needs.
        self._idle: deque[_Worker] = deque()
        self._seen: dict[int, int] = {}  # Which worker has simulated what last.
        # When the pool is garbage, and at the interpreter's exit.
        weakref.finalize(self, _end, self._idle)

    def outcomes(
        self, features: Sequence[Features], seeds: Sequence[int], until: float = math.inf
    ) -> Iterator[tuple[int, Outcome]]:
        """Simulate all rows, and yield each index with its outcome as soon as that is known.

        A row that is simulated again goes to another worker than before, if there are several.
        Workers continue while the caller processes an outcome. If the caller stops, or is
        interrupted, running simulations are ended.

        **Arguments:**
        - `until`: instant of `time.monotonic` at which all are ended, with the status `TIMEOUT`,
          and without a message those that had not begun.
        **Raises:** `StartError` if no worker can start.
        """
        if worker_process.preparing:
            raise StartError(main_guard())
        batch, waiting = _Batch(features, seeds), set(range(len(features)))
        threads = [
            threading.Thread(target=self._work, args=(batch,), daemon=True)
            for _ in range(min(self.workers, len(batch.tasks)))
        ]
        try:
            for thread in threads:
                thread.start()
            while waiting:
                left = None if until == math.inf else max(0.0, until - time.monotonic())
                result = batch.results.get(timeout=left)
                if isinstance(result, BaseException):
                    raise result
                waiting.remove(result[0])
                yield result
        except (KeyboardInterrupt, queue.Empty) as end:
            # What has ended by now is not lost: the caller has it before the interruption goes on.
            batch.stop()
            for thread in threads:
                thread.join()
            while not batch.results.empty():
                result = batch.results.get()
                if not isinstance(result, BaseException):
                    waiting.remove(result[0])
                    yield result
            if isinstance(end, KeyboardInterrupt):
                raise
            ended, unbegun = f"the {self.what} was ended, as all time was over", ""
            later = {index for index, *_ in batch.tasks}
            for index in sorted(waiting):
                message = unbegun if index in later else ended
                yield index, Outcome(None, Status.TIMEOUT, message)
        finally:
            if waiting:
                batch.stop()
            for thread in threads:
                thread.join()

    def renewed(self) -> "Pool":
        """Return a pool of new workers for the same simulation."""
        return _pool(self.workers, self.timeout, self.retries, self._setup)

    def close(self) -> None:
        """End the idle workers; busy ones are ended by their batch."""
        _end(self._idle)

    def _work(self, batch: "_Batch") -> None:
        """Simulate what is left of the batch in one worker after the other; runs in a thread."""
        while not self._slots.acquire(timeout=POLL_SECONDS):
            if batch.stopped:
                return
        worker = None
        try:
            while not batch.stopped and batch.tasks:
                worker = worker or self._worker(batch)
                taken = batch.take(worker, self._seen)
                if taken is None:
                    break
                index, task, what = taken
                if self._seen.get(what) == worker.number:
                    worker = self._another(batch, worker)
                deaths = 0
                while True:
                    worker = worker or self._worker(batch)
                    outcome = worker.simulate(task, self.timeout)
                    if outcome is not None and outcome.status != Status.TIMEOUT:
                        self._remember(what, worker)
                        break
                    batch.leave(worker)
                    end, worker = worker.end(), None
                    if outcome is not None:
                        outcome = outcome._replace(message=f"the {self.what} {outcome.message}")
                    if outcome is not None or batch.stopped:
                        break
                    deaths += 1
                    log.warning("%s while it simulated number %d of the batch", end, index)
                    if deaths > self.retries:
                        message = f"{end} (attempt {deaths} of {self.retries + 1})"
                        outcome = Outcome(None, Status.ERROR, message)
                        break
                if outcome is not None:
                    batch.results.put((index, outcome))
        except BaseException as error:  # A thread must not die silently: its batch would wait.
            batch.results.put(error)
        finally:
            if worker is not None:
                batch.leave(worker)
                if batch.stopped:
                    worker.end()
                else:
                    self._idle.append(worker)
            self._slots.release()

    def _remember(self, what: int, worker: "_Worker") -> None:
        self._seen.pop(what, None)
        self._seen[what] = worker.number
        if len(self._seen) > REMEMBERED:
            with contextlib.suppress(KeyError, StopIteration, RuntimeError):
                del self._seen[next(iter(self._seen))]

    def _another(self, batch: "_Batch", worker: "_Worker") -> "_Worker":
        """Return another worker than this one, where there may be several."""
        if not self._idle:
            # A slot that no thread holds stands for a process that does not run yet.
            if not self._slots.acquire(blocking=False):
                return worker
            try:
                other = self._new(batch)
                batch.leave(worker)
                self._idle.append(worker)
                return other
            finally:
                self._slots.release()
        batch.leave(worker)
        # Exchanged without a moment when it would be missing, and another thread start a new one.
        self._idle.append(worker)
        return self._worker(batch, self._idle.popleft)

    def _worker(self, batch: "_Batch", idle: "Callable[[], _Worker] | None" = None) -> "_Worker":
        """Return an idle worker that is alive, or a new one that is ready."""
        while True:
            try:
                worker = (idle or self._idle.pop)()
            except IndexError:
                return self._new(batch)
            if worker.process.poll() is None:
                batch.enter(worker)
                return worker
            worker.end()

    def _new(self, batch: "_Batch") -> "_Worker":
        """Return a new worker that is ready."""
        end = ""
        for _ in range(self.retries + 1):
            worker = _Worker(self._setup)
            batch.enter(worker)
            try:
                if worker.ready():
                    return worker
            except StartError:
                batch.leave(worker)
                worker.end()
                raise
            batch.leave(worker)
            end = worker.end()
            if batch.stopped:
                break
        raise StartError(f"{end} before it was ready to simulate")


def _pool(workers: int, timeout: float | None, retries: int, setup: bytes) -> Pool:
    pool = Pool.__new__(Pool)
    pool._begin(workers, timeout, retries, setup)
    return pool


def _end(idle: "deque[_Worker]") -> None:
    """End these workers, all at a time."""
    ending = []
    while idle:
        ending.append(idle.pop())
        ending[-1].pipe.close()
    for worker in ending:
        worker.end()


class _Batch:
    """The rows that are left to simulate, the results of the others, and the busy workers."""

    def __init__(self, features: Sequence[Features], seeds: Sequence[int]) -> None:
        self.tasks: deque[tuple[int, tuple[Features, int], int]] = deque(
            (index, task, hash(pickle.dumps(task)))
            for index, task in enumerate(zip(features, seeds, strict=True))
        )
        self.results: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.stopped = False
        self._busy: set[_Worker] = set()
        self._leaving: set[_Worker] = set()  # Those of the busy ones that take no more.
        self._lock = threading.Lock()

    def take(
        self, worker: "_Worker", seen: Mapping[int, int]
    ) -> tuple[int, tuple[Features, int], int] | None:
        """Return what a worker simulates next: its index, itself, and a number that stands for it.

        None if nothing is left, or only what it has simulated before and others will now.
        """
        with self._lock:
            for index, task in enumerate(self.tasks):
                if seen.get(task[2]) != worker.number:
                    del self.tasks[index]
                    return task
            if self.tasks and self._busy <= {worker, *self._leaving}:
                return self.tasks.popleft()
            # Whatever else is at work comes back for it. It must not count on this worker, in turn:
            # both would leave what is left to the other.
            self._leaving.add(worker)
            return None

    def enter(self, worker: "_Worker") -> None:
        with self._lock:
            self._busy.add(worker)
            self._leaving.discard(worker)
            if self.stopped:
                worker.kill()

    def leave(self, worker: "_Worker") -> None:
        with self._lock:
            self._busy.discard(worker)

    def stop(self) -> None:
        """End the running simulations, and begin no more."""
        with self._lock:
            self.stopped = True
            for worker in self._busy:
                worker.kill()


class _Worker:
    """One process and the pipe to it."""

    def __init__(self, setup: bytes) -> None:
        self.number = next(_numbers)
        self.mark = f"{os.environ.get(MARK, '')}{os.getpid()}-{self.number}/"
        self.asked = self.dropped = 0
        self.pipe, theirs = Pipe()
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-c", START.format(path=sys.path, fd=theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
                env={**WORKER_ENVIRONMENT, **os.environ, "VERIFAI_JAX_CORES": "1", MARK: self.mark},
            )
        except OSError as error:
            raise StartError(f"no worker process could start: {error}") from error
        finally:
            theirs.close()
        self._setup = setup

    def ready(self) -> bool:
        """Return True once the worker has imported the simulator; False if its process died.

        **Raises:** `StartError` with what the import raised.
        """
        begun = said = time.monotonic()
        try:
            self.pipe.send_bytes(self._setup)
            while not self.pipe.poll(POLL_SECONDS):
                if self.process.poll() is not None:
                    return False
                if time.monotonic() - said > SLOW_IMPORT_SECONDS:
                    said = time.monotonic()
                    log.warning("worker process %d is still importing", self.process.pid)
                if time.monotonic() - begun > MAX_IMPORT_SECONDS:
                    raise StartError(f"{STILL_IMPORTS} after {MAX_IMPORT_SECONDS:zg} s")
            problem = self.pipe.recv()
        except (EOFError, OSError):
            return False
        if problem:
            raise StartError(problem)
        return True

    def simulate(self, task: tuple[Features, int], timeout: float | None) -> Outcome | None:
        """Return the outcome of one simulation; None if the process died."""
        begun = time.monotonic()
        self.asked += 1
        try:
            self.pipe.send((self.asked, *task))
            while True:
                left = math.inf if timeout is None else begun + timeout - time.monotonic()
                # A process that it has started may hold the pipe open after its death.
                if self.pipe.poll(min(max(left, 0.0), POLL_SECONDS)):
                    number, outcome = self.pipe.recv()
                    if number == self.asked:
                        if not self.dropped or not isinstance(outcome.trace, Trace):
                            return outcome
                        notes = {**outcome.trace.notes, DROPPED: self.dropped}
                        self.dropped = 0
                        return outcome._replace(trace=replace(outcome.trace, notes=notes))
                    # Such as of a copy of the worker that its simulator has forked.
                    self.dropped += 1
                    continue
                if self.process.poll() is not None:
                    return None
                if left <= 0:
                    return Outcome(None, Status.TIMEOUT, f"took longer than {timeout:zg} s")
        except Exception:  # The pipe is closed, or somebody else has written into it.
            return None

    def kill(self) -> None:
        """Kill the process, and those that it has started."""
        if self.process.poll() is None:
            try:
                os.killpg(self.process.pid, signal.SIGKILL)
            except (ProcessLookupError, PermissionError):
                self.process.kill()

    def end(self) -> str:
        """End the process and those that it has started; return how it ended."""
        # One whose pipe is closed, here or there, is about to end by itself.
        ending = self.pipe.closed or self.pipe.poll(0)
        try:
            code = self.process.wait(2.0 if ending else 0.0)
        except subprocess.TimeoutExpired:
            self.kill()
            code = self.process.wait()
        # Its number is not given to another process while its group has members.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        worker_process.end_marked(self.mark)
        self.pipe.close()
        return f"the worker process {_manner(code)}"


def _manner(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"was killed by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
