"""Failure rates of chosen parameters in fresh environments.

A search without a failure proves nothing. Environments drawn after the parameters are fixed are
independent of their choice, so an exact binomial interval holds.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.synthesis.budget import Budget
from verifai_jax.addons.synthesis.parametric import Parametric
from verifai_jax.statistics.binomial import Rate, clopper_pearson

MAX_DRAWS = 1000
"""Batches of draws at most where the constraint refuses nearly all."""
ROUND = 256
"""Simulations between two readings of the clock."""


@dataclass(frozen=True)
class HeldOut:
    """Verdicts of parameters in fresh environments.

    **Fields:**
    - `simulations`: number of simulations made.
    - `failures`: simulations that broke a formula.
    - `short`: simulations that satisfied the formula by less than the required margin.
    - `without_verdict`: simulations that did not end properly; the upper end of the rate's interval
      counts them as failures.
    - `lowest` robustness, None without a verdict.
    - `rate`: the rate of failures, with its 95 % interval; None without any verdict.
    """

    simulations: int
    failures: int
    short: int
    without_verdict: int
    lowest: float | None
    rate: Rate | None

    @property
    def passed(self) -> bool:
        """True if all were simulated, and none fails or is below the margin."""
        return self.simulations > 0 and not (self.failures or self.short or self.without_verdict)

    @property
    def bound(self) -> float | None:
        """An upper bound of the failure probability with 95 % confidence."""
        if self.rate is None:
            return None
        rate = self.rate
        return clopper_pearson(rate.failures, rate.simulations, 0.9, rate.undecided).high

    def describe(self, what: str = "environments") -> str:
        """Describe the verdicts: `0 of 2000 held-out environments fail: ...`."""
        if not self.simulations:
            return f"no time was left for held-out {what}"
        if self.rate is None:
            return f"none of {self.simulations} held-out {what} gave a verdict"
        text = f"{self.failures} of {self.simulations} held-out {what} fail"
        if self.failures:
            text += f": failure probability {self.rate}"
        else:
            text += f": failure probability < {self.bound:z.2g} at 95 %"
        if self.short:
            text += f"; {self.short} more keep less than the margin"
        if self.without_verdict:
            text += f"; {self.without_verdict} gave no verdict and may have failed"
        return text


def held_out(
    loop: Parametric, theta: Float[np.ndarray, " p"], count: int, margin: float,
    seed: tuple[int, int], limits: Budget | None = None,
) -> HeldOut:  # fmt: skip
    """Simulate environments drawn from the prior.

    **Arguments:**
    - `loop`: the system with its parameters.
    - `theta` `[p]`: the parameters.
    - `count`: number of environments; fewer if the constraint of the space refuses nearly all.
    - `margin`: the required robustness.
    - `seed`: the seed, which alone determines the environments.
    - `limits`: time at which to stop early.
    **Returns:** a `HeldOut`.
    """
    points = draw(loop, theta, count, seed)
    parts = []
    for start in range(0, len(points), ROUND):
        if limits is not None and limits.timed_out:
            break
        pairs = loop.evaluate(theta[None], points[start : start + ROUND])
        short = pairs.violates(margin) & ~pairs.failing
        parts.append((pairs.rho[0], pairs.proper[0], pairs.failing[0], short[0]))
    none = (np.zeros(0), *[np.zeros(0, bool)] * 3)
    rho, proper, failing, short = (
        np.concatenate(column) for column in zip(none, *parts, strict=True)
    )
    verdicts, failures = int(proper.sum()), int(failing.sum())
    return HeldOut(
        simulations=len(rho),
        failures=failures,
        short=int(short.sum()),
        without_verdict=len(rho) - verdicts,
        lowest=float(np.min(rho[proper])) if verdicts else None,
        rate=clopper_pearson(failures, len(rho), undecided=len(rho) - verdicts)
        if verdicts
        else None,
    )


def draw(
    loop: Parametric, theta: Float[np.ndarray, " p"], count: int, seed: tuple[int, int]
) -> Float[np.ndarray, "n d"]:
    """Draw environments from the prior that the constraint accepts with these parameters."""
    d = loop.environment.dim if loop.environment is not None else 0
    rng = np.random.default_rng(seed)
    parts, count_so_far = [np.zeros((0, d), np.float32)], 0
    for _ in range(MAX_DRAWS):
        if count_so_far >= count:
            break
        points = rng.random((max(count, 64), d), np.float32)
        points = points[loop.happens(theta, points)]
        parts.append(points)
        count_so_far += len(points)
    return np.concatenate(parts)[:count]
