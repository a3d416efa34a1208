"""The executor of a cluster by its address.

with connect("dask://scheduler:8786") as executor:
vj.falsify(problem, executor=executor)
"""

import contextlib
from collections.abc import Iterator
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from verifai_jax.clusters.ray_executor import RayExecutor
from verifai_jax.core.errors import require, unknown_name
from verifai_jax.core.executors import Executor

KINDS = ("dask", "ray", "slurm")
"""Clusters that an address can name."""
SLURM_SECONDS = 300.0
"""Seconds of a block on Slurm, where each is a job of its own and waits in a queue."""
SLURM_JOBS = 16
"""Jobs at a time, unless the address says `jobs=`."""


@contextlib.contextmanager
def connect(address: str) -> Iterator[Executor]:
    """Connect to a cluster for as long as the context lasts.

    **Arguments:**

    - `address`: `dask://HOST:PORT` of a scheduler; `ray://HOST:PORT` of a head node's client
      server, or `ray://auto` for the cluster that this machine is part of; `slurm`, with parameters
      of submitit where they are wanted: `slurm?slurm_partition=cpu&timeout_min=60&jobs=32`.

    **Raises:** `ValueError` for another address; `MissingExtra` where the package is not installed;
    `OSError` where there is no cluster.
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
