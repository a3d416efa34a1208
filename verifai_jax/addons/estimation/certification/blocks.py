"""Named blocks of simulations: computed together, stored one by one.

    blocks = Blocks(problem_of, policies, seed=0, lanes=64, remember=store.remember)
    for (policy, block), verdicts in blocks.certificate([(0, 0), (0, 1), (5, 0)]):
        ...

Each block belongs to one policy. Its name identifies everything that its results depend on, so
stored results can be used in any order.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.clusters.executors import Shipment, ship
from verifai_jax.addons.estimation.certification.executor_simulator import ExecutorSimulator
from verifai_jax.addons.estimation.certification.policy_groups import digest, group_policies
from verifai_jax.addons.estimation.certification.simulators import (
    SeparateSimulators,
    Simulator,
    problem_with,
    shared_simulator,
)
from verifai_jax.core.compute.executors import Executor
from verifai_jax.core.compute.precision import truncate_silently
from verifai_jax.core.user_code.source_collection import sources_of
from verifai_jax.core.user_code.sources import Sources
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.raising import Raising
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem, ProblemError
from verifai_jax.search.uniform import uniform_points

Arrays = Mapping[str, np.ndarray]
Remember = Callable[[str, Callable[[], dict[str, np.ndarray]]], Arrays]
STREAM = 0x5AFE
"""Sets the random numbers of a certificate apart from those of a training with the same seed."""
DRAWN = 4096
"""Samples drawn from the prior at a time."""
MAX_BARREN = 1000
"""Such draws in a row without one that the constraint accepts, after which it is given up."""


def compute_without_memo(key: str, compute: Callable[[], dict[str, np.ndarray]]) -> Arrays:
    """Compute a block without storing it."""
    return compute()


class Block(NamedTuple):
    """One block: a policy's number and name, and points `[m, d]` with `m <= lanes`.

    - `first`: number of its first sample, from which the random keys are derived.
    """

    policy: int
    points: Float[np.ndarray, "m d"]
    first: int
    name: str


class Blocks:
    """Blocks of simulations of many policies; `simulated` counts those that were computed.

    `sources` is the record of the model's files.

    **Arguments:**
    - `problem_of`: a function from a policy to its problem; JAX traces it if possible.
    - `policies`: pytrees of numbers, or other objects, which are then simulated one by one.
    - `seed`: the seed of the samples and of the random keys of simulations.
    - `lanes`: samples in a block.
    - `devices`: JAX devices to use; all of this process when left out.
    - `executor`: an executor whose workers simulate; this process when left out.
    **Raises:** before anything compiles, the `ProblemError` of `Problem.check`, naming the policy;
    `ValueError` for policies whose problems differ from the first in their features.
    """

    def __init__(
        self, problem_of: Callable[[Any], Problem], policies: Sequence[Any], *, seed: int,
        lanes: int, remember: Remember | None = None, devices: Sequence[Any] | None = None,
        executor: Executor | None = None,
    ) -> None:  # fmt: skip
        self.lanes = lanes
        self._notes: list[str] = []
        self.simulated = 0
        self._remember = compute_without_memo if remember is None else remember
        self._simulators: list[tuple[Simulator, dict[int, int]]] = []
        self._owner: dict[int, int] = {}
        self._raising, self._tried = Raising(), set[int]()
        first: Problem | None = None
        plans = []
        for group in group_policies(policies):
            numbers, together = group.numbers, group.traced
            known = _known_problems(problem_of, group.structure) if together else []
            if known:
                problem, sources = known[0]
            else:
                problem = _checked_problem(problem_of, policies[numbers[0]], numbers[0])
                sources = sources_of(problem, problem_of, made=problem.made_in or ())
            self.sources = sources if first is None else self.sources
            first = problem if first is None else first
            _check_same(first, problem, numbers[0])
            problems = [problem]
            if together and not problem.black_box and not known:
                together = self._traceable(problem_of, group.weights[0], numbers)
                known += [(problem, sources)] if together else []
            if not together or problem.black_box:
                others = [_checked_problem(problem_of, policies[n], n) for n in numbers[1:]]
                for number, other in zip(numbers[1:], others, strict=True):
                    _check_same(first, other, number)
                plans.append((numbers, None, [problem, *others]))
            else:
                plans.append((numbers, group, problems))
        if first is None:
            raise ValueError("there is no policy to certify")
        self.problem, self.space = first, first.space
        shipment = None if executor is None else _shipment(problem_of, executor)
        for numbers, group, problems in plans:
            simulator: Simulator
            if executor is not None and shipment is not None:
                own = [policies[number] for number in numbers] if group is None else group.weights
                structure = None if group is None else group.structure
                simulator = ExecutorSimulator(
                    shipment, own, structure, lanes, self.space.dim, executor
                )
            elif group is None:
                simulator = SeparateSimulators(problems, lanes)
            else:
                simulator = shared_simulator(problem_of, group, lanes, self.space.dim, devices)
            for number in numbers:
                self._owner[number] = len(self._simulators)
            indices = {number: index for index, number in enumerate(numbers)}
            self._simulators.append((simulator, indices))
        root = jax.random.fold_in(jax.random.key(seed, impl="threefry2x32"), STREAM)
        self.attack_key, points_key, self._simulation_key, self._attacked_key = jax.random.split(
            root, 4
        )
        self._samples = _Samples(self.space, points_key)
        self._digests = [digest(policy, i) for i, policy in enumerate(policies)]
        self._about = f"{_common_digest(first, seed, lanes)}/{self.sources.code[:16]}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Decisions and errors that a user should know of."""
        notes = list(self._notes)
        for simulator, indices in self._simulators:
            if isinstance(simulator, SeparateSimulators | ExecutorSimulator):
                messages = simulator.messages
                notes += [
                    f"a simulation of policy {number} raised {messages[index]}"
                    for number, index in indices.items()
                    if index in messages
                ]
        return tuple(notes)

    def certificate(
        self, chosen: Sequence[tuple[int, int]]
    ) -> Iterator[tuple[tuple[int, int], Verdicts]]:
        """Yield verdicts of `(policy, block)` pairs on fresh samples of the prior."""
        blocks = []
        for policy, number in chosen:
            first = number * self.lanes
            points = self.points(number)
            name = f"{self._about}/sample/{self._digests[policy]}/{number}"
            blocks.append(Block(policy, points, first, name))
        for i, verdicts in self._verdicts(blocks, self._simulation_key):
            yield chosen[i], verdicts

    def attack(
        self, chosen: Sequence[tuple[int, np.ndarray]], round_: int, search: str
    ) -> Iterator[tuple[int, Verdicts]]:
        """Yield verdicts of the points that searches chose; `chosen` holds indices of policies."""
        blocks = [
            Block(
                policy, points, round_ * self.lanes,
                f"{self._about}/attack/{search}/{self._digests[policy]}/{round_}",
            )
            for policy, points in chosen
        ]  # fmt: skip
        yield from self._verdicts(blocks, self._attacked_key)

    def again(
        self, policy: int, points: Float[np.ndarray, "n d"], numbers: Int[np.ndarray, " n"],
        of_attack: bool, attempt: int,
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:  # fmt: skip
        """Simulate rows of a policy once more on the host.

        **Arguments:**
        - `numbers`: the numbers of the simulations, from which their random keys are derived.
        - `of_attack`: whether they are simulations of the attack, or samples.
        **Returns:** for each row its least robustness, NaN without a verdict, and whether it fails.
        """

        def compute() -> dict[str, np.ndarray]:
            simulator, indices = self._simulators[self._owner[policy]]
            key = self._attacked_key if of_attack else self._simulation_key
            members = [indices[policy]] * len(points)
            with truncate_silently():
                found = simulator(members, points[:, None], numbers.astype(np.int32), key)
            self.simulated += 1
            lowest = [each.lowest[0] if each.proper[0] else np.nan for each in found]
            failing = np.array([bool(each.violated[0]) for each in found])
            return {"again": np.array(lowest, np.float32), "failing": failing}

        kind, rows = "attack" if of_attack else "sample", "-".join(map(str, numbers.tolist()))
        kind = f"{kind}/{attempt}"
        what = hashlib.sha256(points.tobytes() + rows.encode()).hexdigest()[:16]
        name = f"{self._about}/again/{kind}/{self._digests[policy]}/{what}"
        known = self._remember(name, compute)
        return np.asarray(known["again"], np.float64), np.asarray(known["failing"], bool)

    def points(self, block: int) -> Float[np.ndarray, "lanes d"]:
        """Return the samples of one block of the held-out stream, which all policies share."""
        return self._samples(block * self.lanes, self.lanes)

    def _verdicts(self, blocks: list[Block], key: Any) -> Iterator[tuple[int, Verdicts]]:
        # Those of one program after another.
        order = sorted(range(len(blocks)), key=lambda i: self._owner[blocks[i].policy])
        ready: dict[int, Verdicts] = {}
        for index, i in enumerate(order):
            block = blocks[i]

            def compute(index: int = index, i: int = i) -> dict[str, np.ndarray]:
                if i not in ready:
                    owner = self._owner[blocks[i].policy]
                    simulator, _ = self._simulators[owner]
                    maximum = simulator.blocks_per_call()
                    some = [
                        j
                        for j in order[index : index + maximum]
                        if self._owner[blocks[j].policy] == owner and j not in ready
                    ]
                    found = self._simulate(owner, [blocks[j] for j in some], key)
                    ready.update(zip(some, found, strict=True))
                verdicts = ready.pop(i)
                lowest = np.where(verdicts.proper, verdicts.lowest, np.nan).astype(np.float32)
                return {"rho": lowest, "failing": verdicts.violated, "proper": verdicts.proper}

            yield i, _from_memo(self._remember(block.name, compute), len(block.points))

    @truncate_silently()
    def _simulate(self, owner: int, blocks: list[Block], key: Any) -> list[Verdicts]:
        simulator, indices = self._simulators[owner]
        self.simulated += len(blocks)
        u = np.stack([_fill_block(block.points, self.lanes) for block in blocks])
        members = [indices[block.policy] for block in blocks]
        first = np.array([block.first for block in blocks], np.int32)
        found = simulator(members, u, first, key)
        for block, verdicts in zip(blocks, found, strict=True):
            self._take_in(block.policy, verdicts)
        if self._raising.reason is not None:
            self._check_raising(blocks[0], key)
        return found

    def _take_in(self, policy: int, verdicts: Verdicts) -> None:
        simulator, indices = self._simulators[self._owner[policy]]
        messages = verdicts.messages
        if messages is None and isinstance(simulator, ExecutorSimulator):
            messages = [simulator.messages.get(indices[policy], "")]
        self._raising.add(verdicts.status, messages)
        self._tried.add(policy)

    def _check_raising(self, block: Block, key: Any) -> None:
        """End the work where a simulation of each policy raises, too: one may be broken alone."""
        for policy, owner in self._owner.items():
            if policy not in self._tried and self._raising.always:
                simulator, indices = self._simulators[owner]
                first = np.array([block.first], np.int32)
                (verdicts,) = simulator([indices[policy]], block.points[None, :1], first, key)
                self._take_in(policy, verdicts)
        self._raising.check(self.problem.name)

    @truncate_silently()
    def _traceable(self, problem_of: Any, policy: Any, numbers: tuple[int, ...]) -> bool:
        """Check by abstract evaluation that JAX can trace the problem in the policy's numbers."""

        def simulated(policy: Any, u: Any, key: Any) -> Any:
            problem = problem_with(problem_of, policy)
            return problem.system(problem.space.unflatten(u), key).signals

        try:
            with jax.ensure_compile_time_eval():
                dim = problem_of(policy).space.dim
            u = jax.ShapeDtypeStruct((dim,), np.float32)
            jax.eval_shape(simulated, policy, u, jax.eval_shape(lambda: jax.random.key(0)))
        except Exception as error:
            # With the numbers themselves it worked.
            reason = str(error).strip().split("\n")[0]
            self._notes.append(
                f"compiled one by one: {_list_policies(numbers)}; JAX could not trace "
                f"problem_of in the policy's numbers ({type(error).__name__}: {reason[:120]})"
            )
            return False
        return True


def _known_problems(
    problem_of: Callable[[Any], Problem], structure: str
) -> list[tuple[Problem, Sources]]:
    """Return a list for the checked problem of a structure that JAX traces, kept between calls."""
    try:
        return _kept_problems(problem_of, structure)
    except TypeError:  # It cannot be hashed.
        return []


@lru_cache(maxsize=16)
def _kept_problems(
    problem_of: Callable[[Any], Problem], structure: str
) -> list[tuple[Problem, Sources]]:
    return []


def _shipment(problem_of: Callable[[Any], Problem], executor: Executor) -> Shipment[Any]:
    """Return the shipment of `problem_of`, made once, so that workers keep its programs."""
    try:
        return _known_shipment(problem_of, executor)
    except TypeError:  # One of them cannot be hashed.
        return ship(problem_of, executor)


@lru_cache(maxsize=8)
def _known_shipment(problem_of: Callable[[Any], Problem], executor: Executor) -> Shipment[Any]:
    return ship(problem_of, executor)


class _Samples:
    """The sequence of independent samples of the prior that the constraint accepts."""

    def __init__(self, space: FeatureSpace, key: Any) -> None:
        self._space, self._key, self._drawn = space, key, 0
        self._points = np.zeros((0, space.dim), np.float32)

    def __call__(self, first: int, count: int) -> Float[np.ndarray, "count d"]:
        barren = 0
        while len(self._points) < first + count:
            numbers = self._drawn + np.arange(DRAWN, dtype=np.uint32)
            u = np.asarray(_drawn(self._key, numbers, self._space.dim))
            self._drawn += DRAWN
            if self._space.where is not None:
                u = u[self.accepted(u)]
            barren = 0 if len(u) else barren + 1
            if barren >= MAX_BARREN:
                raise ValueError(
                    f"where accepted none of {MAX_BARREN * DRAWN:,} samples of the space in a row"
                )
            self._points = np.concatenate([self._points, u])
        return self._points[first : first + count]

    def accepted(self, u: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
        return np.asarray(self._space.accepts_points(u))


_drawn = jax.jit(uniform_points, static_argnums=2)


def _from_memo(known: Arrays, count: int) -> Verdicts:
    """Return the verdicts of a block's first `count` rows, with the least formula's robustness."""
    proper = np.asarray(known["proper"], bool)[:count]
    return Verdicts(
        rho=np.asarray(known["rho"], np.float32)[:count, None],
        status=np.where(proper, Status.OK, Status.NONFINITE).astype(np.int32),
        violated=np.asarray(known["failing"], bool)[:count],
    )


def _checked_problem(problem_of: Callable[[Any], Problem], policy: Any, number: int) -> Problem:
    """Return the problem of one policy, once its parts are checked."""
    problem = problem_with(problem_of, policy)
    try:
        problem.check()
    except Exception as error:
        error.add_note(f"while checking the problem of policy {number}")
        raise
    return problem


def _check_same(first: Problem, problem: Problem, number: int) -> None:
    same = (
        problem.space.root == first.space.root
        and (problem.space.where is None) == (first.space.where is None)
        and {k: str(f) for k, f in problem.formulas.items()}
        == {k: str(f) for k, f in first.formulas.items()}
    )
    if not same:
        raise ProblemError(
            "problem_of must give every policy the same features and formulas, or their rates "
            f"cannot be compared; those of policy {number} differ:\n{problem}\nFirst:\n{first}"
        )


def _common_digest(problem: Problem, seed: int, lanes: int) -> str:
    """Hash all that blocks depend on but the policy, the samples and the model's code."""
    parts = [problem.name, str(dict(problem.formulas)), problem.end, str(problem.space.columns)]
    parts += [str(problem.space.levels), str(seed), str(lanes), "float32"]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _fill_block(points: Float[np.ndarray, "m d"], lanes: int) -> Float[np.ndarray, "lanes d"]:
    return np.pad(points, ((0, lanes - len(points)), (0, 0)), mode="edge")


def _list_policies(numbers: Sequence[int]) -> str:
    shown = ", ".join(map(str, numbers[:8])) + (", ..." if len(numbers) > 8 else "")
    return f"{'policy' if len(numbers) == 1 else 'policies'} {shown}"
