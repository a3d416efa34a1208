"""Ray as an executor: `submit` makes a task of Ray, whose future is one of `concurrent.futures`.

    ray.init(address="auto")
    vj.falsify(problem, executor=RayExecutor())

Ray finds a worker for each task, runs the task again where its worker dies, and reuses worker
processes, which keep what they have compiled.
"""

import concurrent.futures
from collections.abc import Callable
from typing import Any

from verifai_jax.core.errors import require
from verifai_jax.core.executors import Shipment

RETRIES = 3
"""Times that Ray runs a block again whose worker has died."""


class _RayFuture(concurrent.futures.Future):
    """The future of one task of Ray."""

    def __init__(self, ray: Any, reference: Any) -> None:
        super().__init__()
        self._ray, self._reference = ray, reference
        reference.future().add_done_callback(self._finish)

    def cancel(self) -> bool:
        """Take the task out of Ray's queue."""
        if self.done():
            return False
        self._ray.cancel(self._reference)
        return super().cancel()

    def _finish(self, future: Any) -> None:
        if not self.set_running_or_notify_cancel():
            return
        if (error := future.exception()) is not None:
            self.set_exception(error)
        else:
            self.set_result(future.result())


class RayExecutor:
    """`concurrent.futures`' `submit` on a cluster of Ray.

    **Arguments:**

    - `address`: the address of the cluster, as of `ray.init`; the one that Ray is connected to
      already, or else a new one on this machine, when left out.
    - `cpus`: cores that a block takes.
    - `gpus`: GPUs that a block takes.

    **Raises:** `MissingExtra` where Ray is not installed; what Ray raises where it cannot connect.
    """

    def __init__(self, address: str | None = None, *, cpus: float = 1, gpus: float = 0) -> None:
        self._ray = require("ray", extra="ray")
        if address is not None or not self._ray.is_initialized():
            self._ray.init(address=address, logging_level="warning")
        self._options = {"num_cpus": cpus, "num_gpus": gpus, "max_retries": RETRIES}
        self._cpus = cpus
        self._tasks: dict[Callable[..., Any], Any] = {}
        self._sent: tuple[str, Any] = ("", None)

    @property
    def _max_workers(self) -> int:
        return max(1, int(self._ray.cluster_resources().get("CPU", 1) / max(self._cpus, 1e-3)))

    def submit(
        self, function: Callable[..., Any], /, *arguments: Any
    ) -> "concurrent.futures.Future[Any]":
        """Call `function(*arguments)` on a worker, and return its future."""
        if function not in self._tasks:
            self._tasks[function] = self._ray.remote(**self._options)(function)
        given = [self._put(a) if isinstance(a, Shipment) else a for a in arguments]
        return _RayFuture(self._ray, self._tasks[function].remote(*given))

    def _put(self, shipment: Shipment[Any]) -> Any:
        """Put an object into Ray's store, once for all of its blocks."""
        if self._sent[0] != shipment.token:
            self._sent = (shipment.token, self._ray.put(shipment))
        return self._sent[1]
