"""Failures of policies on the host, simulated once more before a certificate shows them.

    found = repeat_failures(blocks, policy, sampled, attacked)
    str(found), found.lost

What does not fail again was due to what earlier simulations left behind, or to numbers that do not
come from the random key. It stays in the failure rate, which is that of the system as simulated,
and is no counterexample.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.certification.attack import PolicyRecord
from verifai_jax.certification.blocks import Blocks
from verifai_jax.evaluation.confirmations import Repetitions, came_otherwise
from verifai_jax.evaluation.confirmer import LIMIT, MORE, REPEATED, SHARE_REPEATED


def repeat_failures(
    blocks: Blocks, policy: int, sampled: PolicyRecord, attacked: PolicyRecord
) -> Repetitions:
    """Simulate the worst failures of a policy again, and take out what does not fail again.

    One for 25 simulations or 32 of them, and up to 1024 where one has not come again.

    **Arguments:**

    - `blocks`: that simulate the policies.
    - `policy`: its number.
    - `sampled`, `attacked`: its simulations, of which verdicts are replaced.

    **Returns:** the counts, which as text say what that means of the system.
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
    blocks: Blocks,
    policy: int,
    attacked: PolicyRecord,
    rows: Sequence[tuple[float, PolicyRecord, int, int]],
    attempt: int,
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
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
