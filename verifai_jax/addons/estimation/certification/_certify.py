"""Certificates of the safety of many policies: an attack first, then bounds from fresh samples.

    certificates = certify(problem_of, policies, p=0.01)
    print(certificates)
    certificates.safest, certificates[3].verdict, certificates.counterexamples(3)

Failures of policies on the host are simulated once more before a certificate shows them. A failure
that does not recur was caused by state left by earlier simulations, or by random numbers that do
not come from the key. It counts in the failure rate of the system as simulated, but is not shown as
a counterexample.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.estimation.certification.allocation import Allocation, find_leader
from verifai_jax.addons.estimation.certification.attack import (
    PolicyRecord,
    attack_policies,
    check_attack,
)
from verifai_jax.addons.estimation.certification.blocks import Blocks, Remember
from verifai_jax.addons.estimation.certification.certification import Certification
from verifai_jax.addons.estimation.certification.result import Certificate, Certificates
from verifai_jax.addons.estimation.simultaneous_interval import simultaneous_interval, verdict
from verifai_jax.core.compute.compilation import power_of_two
from verifai_jax.core.compute.devices import enable_compile_cache
from verifai_jax.core.display.progress import say_done, shows_progress
from verifai_jax.core.messages.checks import check_count, check_fraction, options_of
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.evaluation.confirmations import Repetitions, came_otherwise
from verifai_jax.evaluation.confirmer import LIMIT, MORE, REPEATED, SHARE_REPEATED
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.dependence import depends_on_key
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.silent_mistakes import formula_notes

LANES = 64
"""Number of samples of a policy in one block."""
SETTLED = 3.0
"""Over `tie`: about as many samples as name a leader that never fails."""
MAX_KEPT = 1000
"""Maximum number of counterexamples kept for a policy, the worst ones."""
ROWS = 256
"""Rows whose features are computed at a time, so that one shape compiles."""
ProgressReport = Callable[[int, int, str], None]


@suggests_options
@shows_progress("certifying")
def certify(
    problem_of: Callable[[Any], Problem], policies: Sequence[Any], *, p: float = 0.01,
    certification: Certification | None = None, seed: int = 0, only_safe: bool = False,
    tie: float | None = None, remember: Remember | None = None,
    progress: ProgressReport | bool | None = None, devices: Sequence[Any] | None = None,
    run_on: RunOn | None = None,
) -> Certificates:  # fmt: skip
    """Attack all policies, then bound the failure probability of each from fresh samples.

    **Arguments:**
    - `problem_of`: a function from a policy to its `Problem`. JAX traces it with the policy's
      numbers as arguments, so that policies of one structure share a program; if tracing fails,
      each policy is compiled by itself.
    - `policies`: `rl.Policy` objects, or other pytrees of numbers.
    - `p`: the failure probability below which a policy is called safe.
    - `certification`: the attack on each policy and the samples of its certificate.
    - `seed`: the seed of samples and search. All policies get the same samples, which differ from
      those of a training with this seed.
    - `only_safe`: whether to simulate only what shows policies to be safe: one that is shown to be
      unsafe by fewer than `samples` gets no more, one whose part of the budget is too small stays
      undecided, an attack ends with the block that finds a failure, and the safest is not sought.
    - `tie`: failure rates that differ by less than this count as equally safe. The default is `p /
      10` or less, such that resolving it takes about as many samples as the minimum for all
      policies together.
    - `remember(key, compute)`: a memo of simulated blocks; it returns the arrays of `compute`, or
      those stored under this key. A key holds a hash of the model's code, so that blocks of another
      model are simulated anew; data files of the model are not part of it.
    - `progress`: whether to show one line of progress; by default on a terminal, in a notebook, and
      once a minute elsewhere. A function `(done, total, text)` is called instead, with the
      simulations so far; `total` may not be reached.
    - `devices`: JAX devices; all of this process when left out.
    - `run_on`: the workers of the simulations; with them the result is the same.

    Ctrl-C returns the certificates from finished samples. The same seed gives the same
    certificates, bit for bit on one machine, whatever the order of the policies, the number of
    devices or the content of a memo.

    **Raises:** before anything compiles, `ValueError` for numbers out of range, a search that
    cannot attack, or policies with different features; `ProblemError` and the errors of the monitor
    for a problem whose parts do not fit, such as a formula over an unknown signal; `AlwaysRaises`
    if the first simulations of all policies raise.
    """
    started = time.perf_counter()
    if not callable(problem_of) or isinstance(problem_of, Problem) or callable(policies):
        raise ValueError(
            "certify is called with a function from a policy to its problem, and a list of "
            "policies, certify(lambda policy: Problem(...), policies); got "
            f"{type(problem_of).__name__} and {type(policies).__name__}"
        )
    policies = list(policies)
    certified = options_of("certify", Certification, certification)
    samples, confidence = certified.samples, certified.confidence
    budget = _check(policies, p, certified, seed, tie)
    lanes = LANES if samples >= LANES else max(8, power_of_two(samples))
    enable_compile_cache()  # Before the search compiles, too.
    blocks = Blocks(
        problem_of, policies, seed=seed, lanes=lanes, remember=remember, devices=devices,
        executor=options_of("certify", RunOn, run_on, "executor").executor,
    )  # fmt: skip
    attacker = check_attack(blocks.problem, certified.attack)
    rounds = -(-certified.attack_simulations // lanes)
    if tie is None:
        tie = min(p / 10, SETTLED / (len(policies) * samples))
    allocation = Allocation(p, confidence, samples, budget, lanes, tie, safest=not only_safe)
    sampled = [PolicyRecord() for _ in policies]
    attacked = [PolicyRecord() for _ in policies]
    report = _Report(progress, len(policies) * rounds * lanes, budget)
    stopped, margins = "decided", np.full(len(policies), np.nan)
    try:
        attack_policies(
            blocks, attacked, attacker, rounds, report.attacked, until_failure=only_safe
        )
        margins = np.array([one.lowest for one in attacked])
        stopped = _sample(blocks, sampled, allocation, margins, report)
    except KeyboardInterrupt:
        stopped = "interrupted"
    again = [Repetitions() for _ in policies]
    if blocks.problem.black_box and stopped != "interrupted":
        again = [
            repeat_failures(blocks, number, sampled[number], attacked[number])
            for number in range(len(policies))
        ]
    notes = [f"policy {number}: {found}" for number, found in enumerate(again) if str(found)]
    rows = tuple(
        replace(
            _certificate(
                number, sampled[number], attacked[number], allocation, len(policies), blocks
            ),
            fragile=again[number].lost,
        )
        for number in range(len(policies))
    )
    known = all(row.simulations for row in rows)
    now = find_leader(*_counts(sampled), tie, margins) if known else None
    return Certificates(
        rows=rows, problem=blocks.problem.name, p=p, confidence=confidence,
        safest=None if now is None else now.number, chance=None if now is None else now.chance,
        tie=tie, seed=seed, samples=samples, budget=budget, stopped=stopped,
        seconds=time.perf_counter() - started,
        notes=(
            *formula_notes(blocks.problem),
            *notes,
            *blocks.notes,
            *_chance(blocks.problem, rows),
        ),
        sources=blocks.sources.to_json(),
    )  # fmt: skip


def _chance(problem: Problem, rows: Sequence[Certificate]) -> list[str]:
    """Return a note on counterexamples of a system that draws random numbers."""
    if not any(row.counterexamples for row in rows) or not depends_on_key(problem):
        return []
    return [
        "the systems draw random numbers: a counterexample failed under the random key of its "
        "sample, and its features fail with a probability"
    ]


def _sample(
    blocks: Blocks, sampled: list[PolicyRecord], allocation: Allocation, margins: np.ndarray,
    report: "_Report",
) -> str:  # fmt: skip
    """Simulate the blocks of the allocation until it is done; return the reason for ending."""
    while True:
        failures, simulations = _counts(sampled)
        wanted = allocation.next(failures, simulations, margins)
        if not wanted.any():
            break
        undecided = int(allocation.undecided(failures, simulations).sum())
        chosen = [
            (number, len(sampled[number].verdicts) + block)
            for number in range(len(sampled))
            for block in range(int(wanted[number]))
        ]
        for (number, block), verdicts in blocks.certificate(chosen):
            sampled[number].add(blocks.points(block), verdicts, block * blocks.lanes)
            report.sampled(blocks.lanes, undecided)
    open_ = allocation.undecided(failures, simulations).any()
    if open_ or not allocation.safest:
        return "budget" if open_ else "decided"
    named = find_leader(failures, simulations, allocation.tie, margins).chance >= allocation.sure
    return "decided" if named else "budget"


def _counts(records: list[PolicyRecord]) -> tuple[np.ndarray, np.ndarray]:
    """Count the failures of each policy, those without a verdict included, and simulations."""
    failures = np.array([one.failures + one.not_finite for one in records])
    return failures, np.array([one.simulations for one in records])


def _certificate(
    number: int, sampled: PolicyRecord, attacked: PolicyRecord, allocation: Allocation, among: int,
    blocks: Blocks,
) -> Certificate:  # fmt: skip
    rate = None
    if sampled.simulations:
        failing = sampled.failures + sampled.not_finite
        rate = simultaneous_interval(failing, sampled.simulations, allocation.confidence, among)
    worst, features, counterexamples = _worst_rows(blocks.space, (sampled, attacked))
    return Certificate(
        number=number, failures=sampled.failures, simulations=sampled.simulations,
        not_finite=sampled.not_finite, rate=rate, verdict=verdict(rate, allocation.p),
        attacks=attacked.simulations, attack_failures=attacked.failures, worst_robustness=worst,
        worst_features=features, counterexamples=counterexamples,
    )  # fmt: skip


def _worst_rows(
    space: FeatureSpace, both: Sequence[PolicyRecord]
) -> tuple[float, Any, dict[str, np.ndarray]]:
    """Return the least robustness, its features, and the worst failing rows."""
    points = [u for record in both for u in record.points]
    if not points:
        return float("nan"), None, {}
    u = np.concatenate(points)
    verdicts = [each for record in both for each in record.verdicts]
    rho = np.concatenate([each.lowest for each in verdicts])
    failing = np.concatenate([each.violated for each in verdicts])
    order = np.argsort(rho, kind="stable")  # NaN come last.
    kept = order[failing[order]][:MAX_KEPT]
    shown = np.concatenate([order[:1], kept])
    columns = _columns(space, u[shown])
    found = {name: values[1:] for name, values in columns.items()} | {"rho": rho[kept]}
    lowest = float(rho[order[0]])
    if np.isnan(lowest):
        return lowest, None, found
    return lowest, {name: values[0] for name, values in columns.items()}, found


def _columns(space: FeatureSpace, u: np.ndarray) -> dict[str, np.ndarray]:
    """Return the table columns of these points."""
    parts = []
    for start in range(0, len(u), ROWS):
        part = u[start : start + ROWS]
        whole = np.pad(part, ((0, ROWS - len(part)), (0, 0)), mode="edge")
        features = jax.device_get(space.features_at(whole))
        parts.append({name: col[: len(part)] for name, col in space.rows(features).items()})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


class _Report:
    """Progress of both stages, counted in simulations."""

    def __init__(self, progress: ProgressReport | bool | None, attacks: int, budget: int) -> None:
        self._progress, self._total, self._done = progress, attacks + budget, 0

    def attacked(self, simulations: int) -> None:
        self._call(simulations, "attacking")

    def sampled(self, simulations: int, undecided: int) -> None:
        self._call(simulations, f"sampling, {undecided} undecided")

    def _call(self, simulations: int, text: str) -> None:
        self._done += simulations
        say_done(self._done, self._total, text)
        if callable(self._progress):
            self._progress(self._done, self._total, text)


def _check(
    policies: list[Any], p: float, certified: Certification, seed: int, tie: float | None
) -> int:
    """Refuse values out of range, and return the budget."""
    if not policies:
        raise ValueError("there is no policy to certify")
    check_fraction("p", p)
    check_count("seed", seed, 0)
    if tie is not None:
        check_fraction("tie", tie, zero=True)
    certified.check_budget(len(policies))
    return certified.budget or 4 * len(policies) * certified.samples


def repeat_failures(
    blocks: Blocks, policy: int, sampled: PolicyRecord, attacked: PolicyRecord
) -> Repetitions:
    """Simulate the worst failures of a policy again, and remove those that do not fail again.

    It repeats 32 failures, or 4 % of the simulations; 1024 if one did not fail again.

    **Arguments:**
    - `blocks`: the blocks that simulate the policies.
    - `sampled`, `attacked`: simulations of the policy, whose verdicts are replaced.
    **Returns:** the counts, with a text on their meaning for the system.
    """
    rows = [
        (float(verdicts.lowest[index]), record, block, index)
        for record in (sampled, attacked)
        for block, verdicts in enumerate(record.verdicts)
        for index in np.flatnonzero(verdicts.violated).tolist()
    ]
    rows.sort(key=lambda row: row[0])
    found = Repetitions()
    maximum = max(REPEATED, (sampled.simulations + attacked.simulations) // SHARE_REPEATED)
    begin = 0
    while begin < min(len(rows), maximum):
        part = rows[begin : min(begin + REPEATED, maximum)]
        begin += len(part)
        rho = np.array([row[0] for row in part])
        again, failing = _again(blocks, policy, attacked, part, 0)
        for attempt in range(1, 1 + MORE):
            left = np.flatnonzero(failing)
            wavers = found.moved or not failing.all() or came_otherwise(rho, again).any()
            if not (wavers and len(left)):
                break
            some = [part[i] for i in left.tolist()]
            more, failing[left] = _again(blocks, policy, attacked, some, attempt)
            again[left] = np.where(failing[left], np.maximum(again[left], more), more)
        lost = ~failing
        verdicts = np.where(lost, "fragile", "confirmed").astype(object)
        found = found.joined(Repetitions.count(rho, again, verdicts))
        for i in np.flatnonzero(lost).tolist():
            _, record, block, index = part[i]
            record.take_out(block, index)
            attacked.failures -= record is attacked
        if found.moved:
            maximum = LIMIT
    return found


def _again(
    blocks: Blocks, policy: int, attacked: PolicyRecord,
    rows: Sequence[tuple[float, PolicyRecord, int, int]], attempt: int,
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:  # fmt: skip
    """Return the robustness of these rows when they are simulated again, and which fail."""
    again, failing = np.full(len(rows), np.nan), np.zeros(len(rows), bool)
    for of_attack in (False, True):
        own = [i for i, row in enumerate(rows) if (row[1] is attacked) == of_attack]
        if own:
            taken = [rows[i][1:] for i in own]
            points = np.stack([record.points[block][index] for record, block, index in taken])
            numbers = np.array([record.first[block] + index for record, block, index in taken])
            again[own], failing[own] = blocks.again(policy, points, numbers, of_attack, attempt)
    return again, failing
