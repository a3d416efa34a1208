"""The executor of a cluster by its address.

with connect("dask://scheduler:8786") as executor:
vj.falsify(problem, run_on=vj.RunOn(executor=executor))

`RayExecutor` makes a task of Ray for each `submit`, and returns a future of `concurrent.futures`.
Ray finds a worker for each task, repeats a task whose worker died, and reuses worker processes with
their compiled programs.
"""

import concurrent.futures
import contextlib
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from verifai_jax.addons.clusters.executors import Shipment
from verifai_jax.core.compute.executors import Executor
from verifai_jax.core.messages.errors import require, unknown_name

KINDS = ("dask", "ray", "slurm")
"""Clusters that an address can name."""
SLURM_SECONDS = 300.0
"""Seconds of a block on Slurm, where each is a job of its own and waits in a queue."""
SLURM_JOBS = 16
"""Jobs at a time, unless the address says `jobs=`."""


@contextlib.contextmanager
def connect(address: str) -> Iterator[Executor]:
    """Connect to a cluster during a `with` block.

    **Arguments:**
    - `address`: `dask://HOST:PORT` of a scheduler; `ray://HOST:PORT` of a head node's client
      server, or `ray://auto` for the cluster of this machine; `slurm`, optionally with parameters
      of submitit: `slurm?slurm_partition=cpu&timeout_min=60&jobs=32`.
    **Raises:** `ValueError` for another address; `MissingExtra` if the package is not installed;
    `OSError` if there is no cluster.
    """
    kind, rest = _parse(address)
    if kind == "dask":
        distributed = require("distributed", extra="dask")
        try:
            client = distributed.Client(f"tcp://{rest}", timeout=10)
        except OSError as error:
            raise ConnectionError(f"there is no Dask scheduler at {rest}: {error}") from error
        with client:
            yield client.get_executor(pure=False)
    elif kind == "ray":
        executor = RayExecutor("auto" if rest == "auto" else f"ray://{rest}")
        try:
            yield executor
        finally:
            require("ray", extra="ray").shutdown()
    else:
        yield _slurm(dict(parse_qsl(rest)))


def _parse(address: str) -> tuple[str, str]:
    """Return the kind of cluster, and where it is or its parameters."""
    kind, _, parameters = address.partition("?")
    if kind == "slurm":
        return kind, parameters
    parts = urlsplit(address)
    if parts.scheme not in KINDS:
        raise unknown_name("kind of cluster", parts.scheme or address, KINDS)
    if parts.scheme == "slurm" or not parts.netloc:
        raise ValueError(
            f"a cluster is dask://HOST:PORT, ray://HOST:PORT, ray://auto or slurm; got {address!r}"
        )
    return parts.scheme, parts.netloc


def _slurm(parameters: dict[str, str]) -> Any:
    submitit = require("submitit", extra="slurm")
    jobs = int(parameters.pop("jobs", SLURM_JOBS))
    executor = submitit.AutoExecutor(folder="slurm_jobs", cluster="slurm")
    given: dict[str, Any] = {k: int(v) if v.isdecimal() else v for k, v in parameters.items()}
    executor.update_parameters(slurm_array_parallelism=jobs, **given)
    executor._max_workers = jobs
    executor.seconds_per_block = SLURM_SECONDS
    return executor


RETRIES = 3
"""Times that Ray runs a block again whose worker has died."""


class _RayFuture(concurrent.futures.Future):
    """The future of one task of Ray."""

    def __init__(self, ray: Any, reference: Any) -> None:
        super().__init__()
        self._ray, self._reference = ray, reference
        reference.future().add_done_callback(self._finish)

    def cancel(self) -> bool:
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
    """An executor with `submit`, like those of `concurrent.futures`, on a Ray cluster.

    **Arguments:**
    - `address`: the address of the cluster, as in `ray.init`; by default the cluster to which Ray
      is connected, or else a new one on this machine.
    - `cpus`: number of cores for a block.
    - `gpus`: number of GPUs for a block.
    **Raises:** `MissingExtra` if Ray is not installed; Ray's errors if it cannot connect.
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
