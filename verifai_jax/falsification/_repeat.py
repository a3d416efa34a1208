"""The same search from many seeds in one compiled program, to measure how soon it falsifies.

    trials = repeat(problem, "gradient", budget=300, batch=8, seeds=50)
    trials.falsified, trials.median_simulations         # seeds that found a failure; how soon
    trials.first_failure                                # [seeds], counted from 1; inf without one
    trials.violating, trials.first_violation            # the same as simulated, before confirmation

Whole rounds (ask, simulate, evaluate, differentiate, tell) of all seeds run together in one
`lax.scan`. Separate runs for each seed would spend most of their time between rounds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.devices import enable_compile_cache, spread_over_devices
from verifai_jax.core.compute.keys import run_keys, simulation_key
from verifai_jax.core.compute.precision import in_precision, reproducible_settings
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.display.progress import count_done, say_done, shows_progress
from verifai_jax.core.messages.checks import check_options
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.engine import Engine
from verifai_jax.evaluation.raising import Raising
from verifai_jax.evaluation.verdicts import violations
from verifai_jax.falsification.confirm_seeds import SeedConfirmer
from verifai_jax.falsification.lockstep import lockstep
from verifai_jax.falsification.validation import adapt_search, check_search, usual_batch
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Observations, Search

SIMULATIONS_A_CALL = 512
"""Simulations of each seed between two checks for failures; at most so many are wasted."""


@dataclass(frozen=True, eq=False)
class Trials(InNotebook):
    """The histories of one search from many seeds; what `repeat` returns.

    - `name`, `search`: the name of the problem; the repr of the search.
    - `seeds`: `[seeds]`, the seeds.
    - `batch`: simulations in a round.
    - `rho`: `[seeds, simulations]`, the least robustness over the formulas; NaN without a verdict.
    - `violated`: `[seeds, simulations]`, whether a simulation violates the property.
    - `failures`: `[seeds, d]`, the first failing point of each seed in the unit cube, or NaN.
    - `not_claimed`: `[seeds, simulations]`, whether closer replays reject a violation, as in
      `falsify`; None without closer replays. Unless all violations were replayed, replays of a seed
      end with its first claimed failure.
    - `differentiated`: `[seeds, simulations]`, the differentiated simulations; None if none or all
      were.
    - `sources`: the files of the model, as a run records them.
    """

    name: str
    search: str
    seeds: Int[np.ndarray, " seeds"]
    batch: int
    rho: Float[np.ndarray, "seeds simulations"]
    violated: Bool[np.ndarray, "seeds simulations"]
    failures: Float[np.ndarray, "seeds d"]
    not_claimed: Bool[np.ndarray, "seeds simulations"] | None = None
    differentiated: Bool[np.ndarray, "seeds simulations"] | None = None
    sources: Mapping[str, Any] = field(default_factory=dict)

    def cost(self, derivative: float = 2.0) -> Float[np.ndarray, " seeds"]:
        """Return `first_failure`, with each differentiated simulation counted as several."""
        first = self.first_failure
        if self.differentiated is None:
            return first
        before = np.arange(self.rho.shape[1]) < first[:, None]
        return first + (derivative - 1) * np.sum(self.differentiated & before, axis=1)

    @property
    def first_failure(self) -> Float[np.ndarray, " seeds"]:
        """The number, from 1, of each seed's first failing simulation; infinite if none fails.

        With closer replays only claimed failures count.
        """
        refused = self.not_claimed
        return _first(self.violated if refused is None else self.violated & ~refused)

    @property
    def first_violation(self) -> Float[np.ndarray, " seeds"]:
        """The number of each seed's first violation before closer replays; infinite without one."""
        return _first(self.violated)

    @property
    def falsified(self) -> int:
        """Number of seeds that found a failure."""
        return int(np.isfinite(self.first_failure).sum())

    @property
    def violating(self) -> int:
        """Number of seeds that found a violation, whether or not it is claimed."""
        return int(np.isfinite(self.first_violation).sum())

    @property
    def mean_simulations(self) -> float:
        """Mean simulations to the first failure, over the seeds that found one; NaN if none did."""
        found = self.first_failure[np.isfinite(self.first_failure)]
        return float(found.mean()) if len(found) else float("nan")

    @property
    def median_simulations(self) -> float:
        """Median simulations to the first failure; infinite if half of the seeds found none."""
        ordered = np.sort(self.first_failure)
        return float((ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2)

    def __repr__(self) -> str:
        if self.not_claimed is None:
            meant = "as simulated, not confirmed"
        else:
            meant = f"counting what is claimed; as simulated from {self.violating}"
        return (
            f"{self.name}: {self.search} falsified from {self.falsified} of {len(self.seeds)} "
            f"seeds within {self.rho.shape[1]} simulations ({meant}); mean "
            f"{self.mean_simulations:z.4g}, median {self.median_simulations:z.4g} simulations to "
            "the first failure"
        )


@suggests_options
@reproducible_settings()
@shows_progress("repeating a search of")
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
    confirm: bool = True,
    progress: bool | None = None,
) -> Trials:
    """Run a search from many seeds at once; each seed proposes the same points as in `falsify`.

    **Arguments:**
    - `budget`: simulations of each seed, rounded up to whole batches.
    - `batch`, `precision`, `backend`: as in `falsify`.
    - `seeds`: the seeds, or their number, counted from 0.
    - `stop_early`: end once every seed has found a failure. For a search that plans its rounds
      (`portfolio`, `gradient`) each seed ends with its own first failure.
    - `confirm`: count only failures that `falsify` would claim: a violation is replayed more
      finely, and does not count if it is `refuted` or `fragile`. A replay costs at least ten
      simulations, so the violations of a seed are replayed in order only until one is claimed
      (without `stop_early`, all of them). False counts violations as simulated, and compiles only
      the search.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.

    A search that plans its rounds observes an unclaimed violation as safe, as in `falsify`. Any
    other search that learns has its rounds compiled together and observes results as simulated:
    after a seed's first unclaimed violation its simulations may differ from those of `falsify`.

    **Returns:** the robustness and the verdicts of each seed's simulations, as simulated, and the
    violations that are not claimed.
    **Raises:** the errors of `falsify`; `AlwaysRaises` if all of the first simulations raise the
    same error; `ValueError` for a black box, a constraint (`where=`), a priority, a guide or the
    search `trace_surrogate`, which need work between rounds: call `falsify` once for each seed
    instead.
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
        ("a guide", problem.guide is not None),
    ):
        if there:
            raise ValueError(
                f"problem {problem.name!r} has {what}, which needs work between rounds; use "
                "falsify with one seed after the other"
            )
    if search.wants.traces is not None:
        raise ValueError(
            f"search {search!r} learns from traces between rounds; use falsify with one seed after "
            "the other"
        )
    in_precision(precision)
    say_done(0, budget * len(every))
    traced.check()
    search, _ = adapt_search(traced, search)
    batch = min(usual_batch(search, budget) if batch is None else batch, budget)
    sources = problem.sources().to_json()
    claims = SeedConfirmer(traced, precision, every, not stop_early) if confirm else None
    if search.wants.clauses:
        # The search is in single precision whatever the simulations are, as in `falsify`.
        with in_precision("float32"):
            found = lockstep(traced, search, every, budget, batch, precision, stop_early, claims)
        return Trials(
            problem.name,
            repr(search),
            every,
            batch,
            found.rho,
            found.violated,
            found.failures,
            found.not_claimed if confirm else None,
            found.differentiated,
            sources,
        )
    rounds = -(-budget // batch)
    each = min(rounds, max(1, SIMULATIONS_A_CALL // batch))
    with in_precision(precision):
        program = traced.programs.get(
            MERGED_ROUNDS,
            (search, batch, each, precision),
            lambda: _WholeRounds(traced, search, batch, each, precision),
        )
        histories = program.play(every, rounds, stop_early, claims)
    return Trials(problem.name, repr(search), every, batch, *histories, sources=sources)


def _first(failing: Bool[np.ndarray, "seeds simulations"]) -> Float[np.ndarray, " seeds"]:
    """Return the number of each seed's first marked simulation, from 1; infinite without one."""
    return np.where(failing.any(axis=1), failing.argmax(axis=1) + 1.0, np.inf)


def _traced(problem: Problem, backend: str | None) -> Problem | None:
    """Return the problem on a backend that JAX can trace; None if there is none."""
    names = (backend,) if backend is not None else problem.system.backends
    for candidate in (problem, *map(problem.on_backend, names)):
        if not candidate.black_box and (candidate.system.backend or backend) != "auto":
            return candidate
    return None


class _WholeRounds:
    """Compiled rounds of a search, several at a time, for all seeds together."""

    def __init__(
        self, problem: Problem, search: Search, batch: int, rounds: int, precision: str
    ) -> None:
        self.problem, self.search, self.batch, self.rounds = problem, search, batch, rounds
        self.precision = precision
        self.engine = Engine(problem, batch, search.wants.gradient, precision=precision)
        cube = problem.space.cube
        self._start = jax.jit(jax.vmap(lambda key: search.init(key, cube, batch)))
        self._programs: dict[int, jax.stages.Compiled] = {}

    def play(
        self,
        seeds: Int[np.ndarray, " seeds"],
        rounds: int,
        stop_early: bool,
        claims: SeedConfirmer | None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Play the rounds.

        **Returns:** robustness and violations, `[seeds, n]`, first failures `[seeds, d]`, and which
        violations are not claimed, `[seeds, n]`; None without `claims`.
        """
        count, devices = len(seeds), len(jax.local_devices())
        # As many on each device: the last seed again, for those that are missing.
        padded = np.append(seeds, np.repeat(seeds[-1:], -count % devices))
        keys = [run_keys(int(seed)) for seed in padded]
        state = self._start(jnp.stack([key for key, _ in keys]))
        simulations = jnp.stack([key for _, key in keys])
        parts, broken, refused, raising = [], [], [], Raising()
        failures = np.full((count, self.problem.space.dim), np.nan, np.float32)
        failed = np.zeros(count, bool)
        for first in range(0, rounds, self.rounds):
            number = first * self.batch
            state, results = self._advance(state, simulations, np.int32(number))
            u, rho, status = (np.asarray(result)[:count] for result in results)
            # The last call may have rounds beyond the budget.
            u, rho, status = (part[:, : (rounds - first) * self.batch] for part in (u, rho, status))
            raising.add(status.ravel(), None)
            raising.check(self.problem.name)
            violated = self._violated(u, rho, status, simulations, number)
            unclaimed = np.zeros_like(violated)
            if claims is not None:
                some = violated & ~(failed[:, None] & stop_early)
                seed, row = np.nonzero(some)
                unclaimed[some], _ = claims(seed, number + row, u[some], rho[some])
            failing = violated & ~unclaimed
            new = failing.any(axis=1) & ~failed
            failures[new] = u[new, failing[new].argmax(axis=1)]
            failed |= new
            count_done(rho.size)
            parts.append(rho)
            broken.append(violated)
            refused.append(unclaimed)
            if stop_early and failed.all():
                break
        rho, violated, unclaimed = (
            np.concatenate(each, axis=1) for each in (parts, broken, refused)
        )
        return rho, violated, failures, unclaimed if claims is not None else None

    def _violated(
        self,
        u: Float[np.ndarray, "seeds n d"],
        rho: Float[np.ndarray, "seeds n"],
        status: Int[np.ndarray, "seeds n"],
        keys: Key[Array, " padded"],
        first: int,
    ) -> Bool[np.ndarray, "seeds n"]:
        flat = status.ravel()

        def holds() -> Bool[np.ndarray, "rows 1"]:
            undecided = np.flatnonzero((rho.ravel() == 0) & (flat == Status.OK))
            every = np.ones((rho.size, 1), bool)
            for index in undecided.tolist():
                seed, row = divmod(index, rho.shape[1])
                found = self.engine.holds(u[seed, row][None], keys[seed], first + row)
                every[index] = found.all()
            return every

        return violations(rho.reshape(-1, 1), flat, holds).reshape(rho.shape)

    def _advance(
        self, state: PyTree, keys: Key[Array, " padded"], first: np.int32
    ) -> tuple[PyTree, tuple[Array, Array, Array]]:
        if len(keys) not in self._programs:
            enable_compile_cache()
            program = spread_over_devices(self._on_device, (True, True, False))
            traced = self.engine.program.differentiable(
                lambda: jax.jit(partial(program)).lower(state, keys, first)
            )
            self._programs[len(keys)] = traced.compile()
        return self._programs[len(keys)](state, keys, first)

    def _on_device(self, state: PyTree, keys: Array, first: Array) -> PyTree:
        # Blocks of seeds whose simulations fit the cache together.
        blocks = max(1, self.problem.system.lanes // self.batch)
        return jax.lax.map(
            lambda seed: self._one_seed(seed[0], seed[1], first), (state, keys), batch_size=blocks
        )

    def _one_seed(self, state: PyTree, key: Array, first: Array) -> PyTree:
        search, cube, batch = self.search, self.problem.space.cube, self.batch

        def step(state: PyTree, i: Array) -> PyTree:
            u, state = search.ask(state, cube, batch)
            rows = first + i * batch + jnp.arange(batch, dtype=jnp.int32)
            keys = jax.vmap(partial(simulation_key, key))(rows)
            temperature = search.temperature(state) if search.wants.gradient else 1.0
            simulate = jax.vmap(self.engine.program.row, in_axes=(0, 0, None))
            row = simulate(u, keys, jnp.float32(temperature))
            lowest = jnp.min(row.rho, axis=-1)
            gradient = row.derivatives.get("gradient")
            gradient = None if gradient is None else gradient.astype(jnp.float32)
            valid = row.status == Status.OK
            observations = Observations(u, lowest.astype(jnp.float32), valid, gradient)
            if search.wants.no_verdict_rows:
                rho = jnp.where(valid, observations.rho, jnp.nan)
                observations = observations._replace(rho=rho, valid=jnp.ones(batch, bool))
            if search.learns:
                state = search.tell(state, cube, observations)
            return state, (u, lowest, row.status)

        state, results = jax.lax.scan(step, state, jnp.arange(self.rounds, dtype=jnp.int32))
        return state, jax.tree.map(lambda each: each.reshape(-1, *each.shape[2:]), results)


MERGED_ROUNDS: Slot[tuple[Search, int, int, str], _WholeRounds] = Slot("whole rounds")
"""Compiled rounds by (search, batch, rounds, precision)."""
