"""The interface of executors: the `submit` of `concurrent.futures`, which all of them have."""

import concurrent.futures
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Executor(Protocol):
    """Any object with the `submit` of `concurrent.futures`."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Any:
        """Call `function(*arguments)` on a worker, and return its future."""
        ...


def check_executor(executor: object) -> None:
    """Refuse anything that is not an executor, and a process pool whose workers would hang.

    **Raises:** `TypeError` for an object without `submit`; `ValueError` for a pool that forks.
    """
    if not callable(getattr(executor, "submit", None)):
        raise TypeError(
            "executor must have concurrent.futures' submit, such as Dask's client.get_executor(), "
            f"vj.clusters.RayExecutor() or a process pool; got {type(executor).__name__}"
        )
    context = getattr(executor, "_mp_context", None)
    method = getattr(context, "get_start_method", lambda: "")()
    if isinstance(executor, concurrent.futures.ProcessPoolExecutor) and method == "fork":
        raise ValueError(
            "the process pool forks this process, and JAX does not work in a forked process; make "
            "it with ProcessPoolExecutor(mp_context=multiprocessing.get_context('spawn'))"
        )
