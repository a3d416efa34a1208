"""Where and with which code simulations run.

falsify(problem, run_on=RunOn(engine="native"))
estimate(problem, run_on=RunOn(executor=client.get_executor()))
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.evaluation.engine import WANTED, Wanted

if TYPE_CHECKING:
    from verifai_jax.core.compute.executors import Executor


@dataclass(frozen=True)
class RunOn:
    """Where simulations run; what is left out is chosen.

    - `engine`: `"xla"`, or `"native"`: rows from the 513th on are simulated by vector code that the
      machine's own C++ compiler builds. It is two to five times as fast if no large network is in
      the loop, and equal up to rounding; XLA decides values near zero, and simulates what cannot be
      translated. `"auto"` uses native code if the budget is large enough to repay compiling and the
      search does not learn.
    - `backend`: the backend of a system that has several (`"mjx"`, `"native"`). By default both are
      timed here and the faster one that the search can use is taken, so name it for the same table
      on every machine.
    - `executor`: an executor whose workers simulate: Dask's `client.get_executor()`,
      `clusters.RayExecutor()`, a process pool, or anything else with the `submit` of
      `concurrent.futures`. On workers with this machine's kind of processor the result is the same,
      bit for bit.

    **Raises:** `UnknownNameError` for an unknown engine; `TypeError` for anything that is not an
    executor; `ValueError` for a process pool that forks. A verb refuses what it does not use.
    """

    engine: Wanted | None = None
    backend: str | None = None
    executor: "Executor | None" = None

    def __post_init__(self) -> None:
        if self.engine is not None and self.engine not in WANTED:
            raise unknown_name("engine", str(self.engine), WANTED)
        if self.executor is not None:
            from verifai_jax.core.compute.executors import check_executor

            check_executor(self.executor)
