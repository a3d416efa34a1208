"""The same search from many seeds in one compiled program: how soon, and how surely, it falsifies.

    trials = repeat(problem, "gradient", budget=300, batch=8, seeds=50)
    trials.falsified, trials.median_simulations         # seeds that found a failure; how soon
    trials.first_failure                                # [seeds], counted from 1; inf without one

Whole rounds (ask, simulate, judge, differentiate, tell) run in one `lax.scan`, all seeds side by
side: for comparing searches, where a run a seed would spend its time between rounds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.core.devices import enable_compile_cache, spread_over_devices
from verifai_jax.core.errors import suggests_options
from verifai_jax.core.keys import run_keys, simulation_key
from verifai_jax.core.precision import in_precision
from verifai_jax.core.trace import Status
from verifai_jax.evaluation.engine import Engine
from verifai_jax.falsification.lockstep import lockstep
from verifai_jax.falsification.validation import check_options, check_search, usable, usual_batch
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Observations, Search

SIMULATIONS_A_CALL = 512
"""Of each seed between two looks at who has found a failure."""


@dataclass(frozen=True, eq=False)
class Trials:
    """What `repeat` returns.

    - `seeds`: `[seeds]`; `rho`: `[seeds, simulations]`, the least formula's robustness, NaN where a
      simulation has no verdict.
    - `batch`: simulations a round.
    - `differentiated`: `[seeds, simulations]`, which had slopes taken; None where none or all had.
    - `failures`: `[seeds, d]`, the first failing point of each seed in the unit cube, NaN without
      one; None for searches that do not plan their rounds.
    """

    name: str
    search: str
    seeds: Int[np.ndarray, " seeds"]
    batch: int
    rho: Float[np.ndarray, "seeds simulations"]
    differentiated: Bool[np.ndarray, "seeds simulations"] | None = None
    failures: Float[np.ndarray, "seeds d"] | None = None

    def cost(self, slopes: float = 2.0) -> Float[np.ndarray, " seeds"]:
        """Like `first_failure`, with each differentiated simulation counted as so many."""
        first = self.first_failure
        if self.differentiated is None:
            return first
        before = np.arange(self.rho.shape[1]) < first[:, None]
        return first + (slopes - 1) * np.sum(self.differentiated & before, axis=1)

    @property
    def first_failure(self) -> Float[np.ndarray, " seeds"]:
        """The number, from 1, of each seed's first failing simulation; infinite without one."""
        failing = self.rho < 0
        return np.where(failing.any(axis=1), failing.argmax(axis=1) + 1.0, np.inf)

    @property
    def falsified(self) -> int:
        """Seeds that found a failure."""
        return int(np.isfinite(self.first_failure).sum())

    @property
    def mean_simulations(self) -> float:
        """Mean simulations to the first failure, of the seeds that found one; NaN if none did."""
        found = self.first_failure[np.isfinite(self.first_failure)]
        return float(found.mean()) if len(found) else float("nan")

    @property
    def median_simulations(self) -> float:
        """Median simulations to the first failure, infinite if half of the seeds found none."""
        ordered = np.sort(self.first_failure)
        return float((ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2)

    def __repr__(self) -> str:
        return (
            f"{self.name}: {self.search} falsified from {self.falsified} of {len(self.seeds)} "
            f"seeds within {self.rho.shape[1]} simulations; mean {self.mean_simulations:.4g}, "
            f"median {self.median_simulations:.4g} simulations to the first failure"
        )


@suggests_options
def repeat(
    problem: Problem,
    search: str | Search = "portfolio",
    budget: int = 1000,
    *,
    batch: int | None = None,
    seeds: int | Sequence[int] = 50,
    stop_early: bool = True,
    precision: str = "float32",
    backend: str | None = None,
) -> Trials:
    """Run a search from many seeds at once; each asks for what `falsify` with its seed would.

    **Arguments:**

    - `budget`: simulations of each seed, rounded up to whole batches.
    - `batch`, `precision`, `backend`: as in `falsify`.
    - `seeds`: which, or how many from 0 on.
    - `stop_early`: end once every seed has found a failure. Seeds of a search that plans its
      rounds (`portfolio`, `gradient`) each end with their own first failure.

    A robustness of exactly zero is no failure here, whatever the comparator says.

    **Raises:** as `falsify`; `ValueError` for a black box, a constraint (`where=`) or a priority,
    which are dealt with between rounds: use `falsify` with one seed after the other.
    """
    check_options(budget, 1 if batch is None else batch, 0, None, None)
    search = check_search(problem, search)
    every = np.arange(seeds) if isinstance(seeds, int | np.integer) else np.asarray(seeds)
    if every.ndim != 1 or not len(every) or every.dtype.kind not in "iu" or every.min() < 0:
        raise ValueError(f"seeds must be a number or a list of integers >= 0; got {seeds!r}")
    if (traced := _traced(problem, backend)) is None:
        raise ValueError(
            f"the system of problem {problem.name!r} is a black box, which no compiled program can "
            "call; use falsify with one seed after the other"
        )
    for what, there in (
        ("a constraint (where=)", problem.space.where is not None),
        ("a priority", problem.rulebook is not None),
    ):
        if there:
            raise ValueError(
                f"problem {problem.name!r} has {what}, which is dealt with between rounds; use "
                "falsify with one seed after the other"
            )
    in_precision(precision)
    traced.check()
    search, _ = usable(traced, search)
    batch = min(usual_batch(search, budget) if batch is None else batch, budget)
    if search.wants_clauses:
        with in_precision(precision):
            found = lockstep(traced, search, every, budget, batch, precision, stop_early)
        return Trials(problem.name, repr(search), every, batch, *found)
    rounds = -(-budget // batch)
    each = min(rounds, max(1, SIMULATIONS_A_CALL // batch))
    with in_precision(precision):
        start, advance, devices = _program(traced, search, batch, each, precision)
        # As many on each device: the last seed again, for those that are missing.
        padded = np.append(every, np.repeat(every[-1:], -len(every) % devices))
        keys = [run_keys(int(seed)) for seed in padded]
        state = start(jnp.stack([key for key, _ in keys]))
        simulations = jnp.stack([key for _, key in keys])
        parts, found = [], np.zeros(len(padded), bool)
        for first in range(0, rounds, each):
            state, rho = advance(state, simulations, np.int32(first * batch))
            parts.append(np.asarray(rho))
            found |= (parts[-1] < 0).any(axis=1)
            if stop_early and found.all():
                break
    rho = np.concatenate(parts, axis=1)[: len(every), : rounds * batch]
    return Trials(problem.name, repr(search), every, batch, rho)


def _traced(problem: Problem, backend: str | None) -> Problem | None:
    """The problem on a backend that JAX can trace."""
    names = (backend,) if backend is not None else problem.system.backends
    for candidate in (problem, *map(problem.on_backend, names)):
        if not candidate.black_box and (candidate.system.backend or backend) != "auto":
            return candidate
    return None


def _program(problem: Problem, search: Search, batch: int, rounds: int, precision: str) -> Any:
    """The compiled beginning, and `rounds` rounds, of all seeds; kept as long as the problem."""
    kind = ("repeat", search, batch, rounds, precision)
    if kind not in problem.engines:
        problem.engines[kind] = _compiled(problem, search, batch, rounds, precision)
    return problem.engines[kind]


def _compiled(problem: Problem, search: Search, batch: int, rounds: int, precision: str) -> Any:
    engine = Engine(problem, batch, search.wants_gradient, precision=precision)
    cube = problem.space.cube

    def one_seed(state: Any, key: Any, first: Any) -> Any:
        def step(state: Any, i: Any) -> Any:
            u, state = search.ask(state, cube, batch)
            rows = first + i * batch + jnp.arange(batch, dtype=jnp.int32)
            keys = jax.vmap(partial(simulation_key, key))(rows)
            temperature: Any = search.temperature(state) if search.wants_gradient else 1.0
            simulate = jax.vmap(engine.told_row, in_axes=(0, 0, None))
            row = simulate(u, keys, jnp.float32(temperature))
            told = Observations(
                u, row.rho.astype(jnp.float32), row.status == Status.OK, row.gradient
            )
            return search.tell(state, cube, told) if search.learns else state, row.rho

        state, rho = jax.lax.scan(step, state, jnp.arange(rounds, dtype=jnp.int32))
        return state, rho.ravel()

    def on_device(state: Any, keys: Any, first: Any) -> Any:
        # Blocks of seeds whose simulations fit the cache together.
        blocks = max(1, engine.together // batch)
        return jax.lax.map(
            lambda seed: one_seed(seed[0], seed[1], first), (state, keys), batch_size=blocks
        )

    on_devices = spread_over_devices(on_device, (True, True, False))
    start = jax.jit(jax.vmap(lambda key: search.init(key, cube, batch)))
    programs: dict[int, Any] = {}

    def advance(state: Any, keys: Any, first: Any) -> Any:
        if len(keys) not in programs:
            enable_compile_cache()
            traced = engine.differentiable(
                lambda: jax.jit(partial(on_devices)).lower(state, keys, first)
            )
            programs[len(keys)] = traced.compile()
        return programs[len(keys)](state, keys, first)

    return start, advance, len(jax.local_devices())
