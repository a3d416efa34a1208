"""Work on other machines, through any executor with the `submit` of `concurrent.futures`.

    shipment = ship(problem, executor, target="specs/cartpole.py:balance")
    futures = [executor.submit(evaluate_block, shipment, i) for i in range(16)]
    gather(futures, lambda i, result: ...)              # as each ends; on errors cancels the rest

Dask's `client.get_executor()`, `mpi4py.futures`, submitit's executors, a process pool and the
adapter for Ray (`clusters.RayExecutor`) all have `submit`, and start, find and replace workers. The
executor sends code and data; nothing here opens a socket or pickles.
"""

import concurrent.futures
import os
import pickle
import re
import threading
import time
import uuid
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, Protocol, TypeVar

from verifai_jax.core.compute.executors import Executor
from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.core.user_code.targets import load_target

T = TypeVar("T")
USUAL_WORKERS = 8
"""Workers of an executor that does not say how many it has."""
KEPT = 8
"""Number of objects that a worker keeps with their programs; the least recently used is dropped."""
SECONDS = 1.0
"""Seconds of work that a call takes, about, unless the executor says `seconds_per_block`."""
LOOK = 0.02
"""Seconds between two looks at futures that nothing can wait for together."""
SENDS_CODE = ("dask", "distributed", "ray", "submitit", "loky", "joblib", "verifai_jax")
"""Packages whose executors send functions and classes that no module of the worker has."""
_NO_MODULE = re.compile(r"No module named '([\w.]+)'")


class WorkerError(RuntimeError):
    """An error of a worker that died and was not replaced, or that lacks something it needs."""


class Future(Protocol):
    """The part of the interface of `concurrent.futures.Future` that all executors have."""

    def result(self) -> Any:
        """Wait for the result and return it, or raise the error of the call."""

    def done(self) -> bool:
        """Return whether there is a result."""
        ...

    def cancel(self) -> Any:
        """Remove the call from the queue if it has not started."""


def count_workers(executor: Executor) -> int:
    """Return how many calls the executor runs at a time, if it can tell."""
    client = getattr(executor, "_client", None)
    if client is not None and hasattr(client, "nthreads"):
        return max(1, sum(client.nthreads().values()))
    workers = getattr(executor, "_max_workers", None)
    return workers if isinstance(workers, int) and workers > 0 else USUAL_WORKERS


def seconds_per_block(executor: Executor) -> float:
    """Return the approximate seconds of a call's work; longer if each call is a cluster job."""
    return float(getattr(executor, "seconds_per_block", SECONDS))


def gather(
    futures: Sequence[Future], ended: Callable[[int, Any], None],
    further: Callable[[], Sequence[Future]] = tuple, check: Callable[[], None] = lambda: None,
) -> None:  # fmt: skip
    """Wait for all futures, and call `ended(index, result)` when each has ended.

    `further()` returns more futures whenever some have ended; indices continue. `check()` is called
    once a second or more often, and may raise, so that a call that hangs ends the waiting.

    If one fails, or the user interrupts, queued calls are cancelled; results that exist by then are
    still reported.

    **Raises:** `WorkerError` if a worker died and was not replaced; the error of the call.
    """
    waiting = dict(enumerate(futures))
    count = len(waiting)
    try:
        while waiting:
            finished = [index for index, future in waiting.items() if future.done()]
            if not finished:
                check()
                _wait(list(waiting.values()))
                continue
            failure = None
            for index in finished:
                try:
                    result = waiting.pop(index).result()
                except Exception as error:
                    failure = failure or error
                    continue
                ended(index, result)
            if failure is not None:
                raise _explained(failure) from failure
            more = further()
            waiting.update(enumerate(more, count))
            count += len(more)
    finally:
        for future in waiting.values():
            future.cancel()


def _wait(futures: list[Future]) -> None:
    plain = [each for each in futures if isinstance(each, concurrent.futures.Future)]
    if len(plain) == len(futures):
        concurrent.futures.wait(plain, 1.0, concurrent.futures.FIRST_COMPLETED)
    else:
        time.sleep(LOOK)


def _explained(error: Exception) -> Exception:
    """Return an error that says what happened, where a worker died."""
    if isinstance(error, concurrent.futures.BrokenExecutor):
        return WorkerError(
            "a worker process of the executor died (killed, or out of memory), and a process pool "
            "does not replace it; what was finished before is kept: resume with a new pool, or use "
            "Dask or Ray, which run such work again on another worker"
        )
    # Ray wraps what a call raised.
    error = cause if isinstance(cause := getattr(error, "cause", None), Exception) else error
    if (missing := _NO_MODULE.search(str(error))) is not None:
        return WorkerError(
            f"a worker has no module {missing[1]!r}: workers need the packages that are used here, "
            "and the modules of the project, from the same folder or by PYTHONPATH"
        )
    names = {kind.__name__ for kind in type(error).__mro__}
    if names & {"KilledWorker", "WorkerCrashedError", "NodeDiedError"}:
        return WorkerError(
            "workers died repeatedly on the same block, so the cluster gave up on it: "
            f"{one_line(format_error(error))}"
        )
    return error


class Shipment(Generic[T]):
    """An object sent to workers, which keep it together with the programs compiled for it.

    **Arguments:**
    - `thing`: the object to send.
    - `target`: its name `FILE.py:NAME`; if given, workers load it by this name instead.
    - `same`: a function that describes an object as texts by topic, to check that an object loaded
      by name equals this one.

    `made` holds the objects that a worker has made for it.
    """

    def __init__(
        self, thing: T, target: str | None = None,
        same: Callable[[Any], Mapping[str, str]] | None = None,
    ) -> None:  # fmt: skip
        self.thing, self.target, self.same = thing, target, same
        self.token = uuid.uuid4().hex
        self.made: dict[str, Any] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        if self.target is None:
            return _receive, (self.token, self.thing)
        assert self.same is not None
        return _receive_target, (
            self.token, type(self.thing), self.target, self.same, dict(self.same(self.thing)),
        )  # fmt: skip


_received: "OrderedDict[str, Shipment[Any]]" = OrderedDict()
_receiving = threading.Lock()


def _keep(token: str, make: Callable[[], "Shipment[Any]"]) -> "Shipment[Any]":
    with _receiving:
        if token not in _received:
            _received[token] = make()
            _received[token].token = token
            while len(_received) > KEPT:
                _received.popitem(last=False)
        _received.move_to_end(token)
        return _received[token]


def _receive(token: str, thing: Any) -> "Shipment[Any]":
    return _keep(token, lambda: Shipment(thing))


def _receive_target(
    token: str, kind: type[Any], target: str, same: Callable[[Any], Mapping[str, str]],
    wanted: Mapping[str, str],
) -> "Shipment[Any]":  # fmt: skip
    def load() -> Shipment[Any]:
        thing = load_target(target, kind)
        for what, text in same(thing).items():
            if text != wanted[what]:
                raise ValueError(
                    f"{target} on the worker differs from the one here: its {what} is {text}, here "
                    f"{wanted[what]}; a process pool loads it by its name, so give one that can be "
                    "pickled, or use Dask or Ray, which send it as it is"
                )
        return Shipment(thing)

    return _keep(token, load)


def ship(
    thing: T, executor: Executor, target: str | None = None,
    same: Callable[[Any], Mapping[str, str]] | None = None,
) -> Shipment[T]:  # fmt: skip
    """Prepare an object to be sent through an executor.

    If the executor sends code, the object is pickled together with functions of files loaded as
    targets. Otherwise it must be picklable, or workers load it by its name.

    **Raises:** `ValueError` if neither is possible.
    """
    shipment = Shipment(thing)
    if isinstance(executor, concurrent.futures.ThreadPoolExecutor):
        return shipment
    if type(executor).__module__.partition(".")[0] in SENDS_CODE:
        _send_targets_as_code()
        return shipment
    try:
        pickle.dumps(shipment)
    except Exception as error:
        if target is not None and same is not None:
            return Shipment(thing, os.path.abspath(target) if os.sep in target else target, same)
        raise ValueError(
            f"{type(executor).__name__} cannot send the {type(thing).__name__.lower()} to its "
            f"workers ({one_line(format_error(error))[:200]}); name it, "
            "Problem(..., target='specs/FILE.py:NAME'), so that they load it themselves, or use "
            "Dask or Ray, which can send functions that are not in a module"
        ) from error
    return shipment


def _send_targets_as_code() -> None:
    """Let files that were loaded as targets be sent whole: no worker can import them by name."""
    import sys

    for name in ("cloudpickle", "ray.cloudpickle"):
        if (pickler := sys.modules.get(name)) is not None:
            for module_name, module in list(sys.modules.items()):
                if module_name.startswith("_target_"):
                    pickler.register_pickle_by_value(module)
