"""The interface of executors: the `submit` of `concurrent.futures`, which all of them have."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Executor(Protocol):
    """Any object with the `submit` of `concurrent.futures`."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Any:
        """Call `function(*arguments)` on a worker, and return its future."""
        ...
