"""Results of a synthesis and of a repair: parameters, and the evidence that they hold."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from verifai_jax.addons.synthesis.held_out import HeldOut
from verifai_jax.addons.synthesis.parametric import held
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd

    from verifai_jax.addons.synthesis.proved_parameters import ProvedParameters


@dataclass(frozen=True, eq=False)
class Synthesis(InNotebook):
    """Result of `synthesize`: parameters for which a formula holds.

    **Fields:** `parameters`: the best ones found, by name; `robustness`: the least robustness with
    them, over all `environments` of the set and all attacks (minus infinity without a verdict);
    `margin`: the required robustness; `candidates`: a table of the best parameters with their `rho`
    and the number of `environments`, all from the same set; `environments`: a table of the set,
    with the `rho` of the best parameters; `held_out`: the result in fresh samples, None without a
    check; `attacks`: environments tried against the best parameters; `converged`: whether the last
    attack found no environment worse than those of the set; `simulations` (without those of the
    check), `without_verdict` and `seconds`; `stopped`: `"converged"`, `"budget"`, `"max_seconds"`,
    `"no verdict"` or `"interrupted"`; `problem`: the given one; `seed`; `varied`: the parameters,
    the environment, and its extent; `counted`: with `aim="probability"`, the failures and samples
    by which the parameters were chosen; `sources`: the files of the model, as a run records them;
    `proved`: the proved box of parameters, None without one; `proof_seconds`: the seconds allowed
    for a proof, None for none.
    """

    problem: Problem = field(repr=False)
    parameters: dict[str, Any]
    robustness: float
    margin: float
    candidates: "pd.DataFrame" = field(repr=False)
    environments: "pd.DataFrame" = field(repr=False)
    held_out: HeldOut | None
    attacks: int
    converged: bool
    simulations: int
    without_verdict: int
    seconds: float
    stopped: str
    seed: int
    varied: str = ""
    counted: tuple[int, int] | None = None
    sources: Mapping[str, Any] = field(default_factory=dict, repr=False)
    proved: "ProvedParameters | None" = None
    proof_seconds: float | None = None

    @property
    def holds(self) -> bool:
        """True if the formula kept its margin in every simulation with the best parameters."""
        kept = bool(self.robustness >= self.margin)
        return kept and (self.held_out is None or self.held_out.passed)

    @cached_property
    def chosen(self) -> Problem:
        """The problem with the parameters fixed at their values, for example for `falsify`."""
        return held(self.problem, self.parameters)

    @property
    def robust(self) -> "pd.DataFrame":
        """The candidates that keep the margin over the whole set."""
        return self.candidates.loc[self.candidates["rho"] >= self.margin]

    def __str__(self) -> str:
        shown = ", ".join(
            f"{name} = {format_value(value)}" for name, value in self.parameters.items()
        )
        wanted = f" by the margin of {self.margin:zg}" if self.margin else ""
        lines = [f"synthesis for {self.problem.name}: {shown}"]
        around = self.environments.shape[1] > 1
        if self.counted is not None:
            lines.append(f"  {_counted(self.counted)}")
        elif self.robustness == -np.inf:
            lines.append("  no simulation with any parameters had a verdict")
        elif self.holds:
            where = f", the least over {self.attacks} simulated environments" if around else ""
            lines.append(f"  holds{wanted} with robustness {self.robustness:z.4g}{where}")
        elif self.robustness >= self.margin:
            lines.append(
                f"  no failure was found before the check: {self.robustness:z.4g} at least"
            )
        else:
            missing = self.margin - self.robustness
            lines.append(
                f"  NONE FOUND that holds{wanted}: the best so far has robustness "
                f"{self.robustness:z.4g}, {missing:z.4g} too little"
            )
        if self.held_out is not None:
            lines.append(
                f"  check: {self.held_out.describe('environments' if around else 'repeats')}"
            )
        elif around:
            lines.append("  not checked in held-out environments")
        if self.varied:
            lines.append(f"  {self.varied}")
        if self.proved is not None:
            lines.append(f"  {self.proved}{', whatever the others are' * around}")
        elif self.proof_seconds is not None:
            lines.append(f"  nothing around them was proved in {self.proof_seconds:zg} s")
        found, of = len(self.robust), len(self.candidates)
        if around:
            over = f"over {len(self.environments)} environments"
            lines.append(f"  {found} of the best {of} candidates keep it {over} (.candidates)")
        else:
            lines.append(f"  {found} of the simulated points keep the margin (.robust)")
        lines.append(f"  {self._costs()}")
        return "\n".join(lines)

    def _costs(self) -> str:
        text = f"{self.simulations:,} simulations in {self.seconds:z.1f} s, stopped: {self.stopped}"
        if self.without_verdict:
            text += f"; {self.without_verdict} gave no verdict"
        if self.environments.shape[1] > 1 and self.counted is None:
            text += "; an attack that finds nothing proves nothing, the check above is the evidence"
        return text


def _counted(counts: tuple[int, int]) -> str:
    """Say how many samples fail with the parameters that were chosen for that."""
    failing, samples = counts
    return (
        f"chosen for the least failure probability: {failing} of {samples} samples of the prior "
        "fail; the check counts in other samples"
    )


def format_value(value: object) -> str:
    """Format the value of a parameter."""
    if isinstance(value, float):
        return f"{value:z.6g}"
    if isinstance(value, int | str | bool):
        return str(value)
    import jax

    numbers = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(value)]).tolist()
    shown = ", ".join(f"{number:z.4g}" for number in numbers[:6])
    return f"[{shown}{', ...' * (len(numbers) > 6)}]"


class Round(NamedTuple):
    """One round of a repair, starting with the attack on its parameters.

    **Fields:**
    - `attacked`: number of simulated environments; their `counterexamples`; `worst` robustness.
    - `change`: distance of the parameters from the nominal ones, Euclidean in unit coordinates (or
      in the arrays' own).
    """

    attacked: int
    counterexamples: int
    worst: float
    change: float


class RepairEstimates(NamedTuple):
    """Failure probabilities before and after a repair, as `Repair.estimate` returns them.

    **Fields:**
    - `name`: the name of the problem.
    - `before`, `after`: an `Estimate` of each.
    """

    name: str
    before: Any
    after: Any

    @property
    def lowered(self) -> bool:
        """True if the whole interval after the repair is below the one before."""
        known = self.before.probability is not None
        return bool(known and self.after.high < self.before.low)

    def __str__(self) -> str:
        lines = [f"repair of {self.name}, failure probabilities"]
        for when, estimate in (("before", self.before), ("after", self.after)):
            sure = f"{100 * estimate.confidence:zg} %"
            if estimate.probability is None:
                text = f"no estimate, at most {estimate.upper_bound:z.2g} ({sure} bound)"
            else:
                text = (
                    f"{estimate.probability:z.3g} ({sure} interval {estimate.low:z.3g} to "
                    f"{estimate.high:z.3g}), in {estimate.simulations:,} simulations"
                )
            lines.append(f"  {when + ':':<8}{text}")
        lines.append(
            "  lowered: the whole interval after the repair is below the one before"
            if self.lowered
            else "  not shown to be lower: the interval after the repair reaches the one before"
        )
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class Repair(Drawn, InNotebook):
    """The result of `repair`: parameters changed as little as possible to remove the failures.

    **Fields:** `before` and `parameters`: the nominal and the repaired ones, features by name or a
    pytree; `rounds`: a `Round` for each; `held_out_before`, `held_out_after`: the results of both
    in the same number of fresh samples, None without a check; `robustness`: the least robustness
    with the repaired parameters; `environments`: size of the set of counterexamples; `margin`: the
    required robustness; `change`: distance of the parameters, as in `Round`; `found`: whether the
    last attack found nothing; `simulations` (without those of the check), `without_verdict`,
    `seconds`; `stopped`: `"repaired"`, `"no parameters"` (none found for the set), `"budget"`,
    `"max_seconds"`, `"rounds"`, `"fewest failures"`, `"no verdict"` or `"interrupted"`; `arrays`:
    whether the parameters are a pytree; `notes`; `seed`; `counted`: with `aim="probability"`, the
    failures and samples by which the parameters were chosen; `sources`: the files of the model, as
    a run records them; `changed`: a sentence if the model has changed since the given run was made.
    """

    _picture = "verifai_jax.addons.synthesis.picture", "plot_repair"
    """The worst robustness that each attack found."""
    name: str
    before: Any
    parameters: Any
    rounds: tuple[Round, ...]
    held_out_before: HeldOut | None
    held_out_after: HeldOut | None
    robustness: float
    environments: int
    margin: float
    change: float
    found: bool
    simulations: int
    without_verdict: int
    seconds: float
    stopped: str
    seed: int
    arrays: bool = False
    notes: tuple[str, ...] = ()
    make: Callable[[], Problem] | None = field(default=None, repr=False)
    make_nominal: Callable[[], Problem] | None = field(default=None, repr=False)
    counted: tuple[int, int] | None = None
    sources: Mapping[str, Any] = field(default_factory=dict, repr=False)
    changed: str = ""

    @property
    def repaired(self) -> bool:
        """True if there was a check, and neither it nor the last attack found a failure."""
        return self.found and self.held_out_after is not None and self.held_out_after.passed

    @cached_property
    def problem(self) -> Problem:
        """The problem with the repaired parameters, for example for `falsify`."""
        assert self.make is not None
        return self.make()

    @cached_property
    def nominal_problem(self) -> Problem:
        """The problem with the parameters before the repair."""
        assert self.make_nominal is not None
        return self.make_nominal()

    def estimate(
        self, method: str | None = None, budget: int = 50_000, **options: Any
    ) -> RepairEstimates:
        """Estimate the failure probabilities before and after, even if failures are rare.

        The check counts failures in samples of the prior, which hardly ever contain rare ones. This
        method searches for them, as `vj.estimate` does.

        **Arguments:**
        - `method`, `options`: as in `vj.estimate`.
        - `budget`: maximum number of simulations for each of the two.
        **Raises:** the errors of `vj.estimate`.
        """
        estimate = lazy_import("verifai_jax.addons.estimation", "estimate")
        problems = (self.nominal_problem, self.problem)
        return RepairEstimates(
            self.name, *(estimate(problem, method, budget, **options) for problem in problems)
        )

    def __str__(self) -> str:
        lines = [self.changed] if self.changed else []
        lines.append(f"repair of {self.name}: {self._changes()}")
        if self.counted is not None:
            lines.append(f"  {_counted(self.counted)}")
        elif self.found and not self.change:
            lines.append("  the nominal parameters were kept: no attack found a failure")
        elif self.found:
            lines.append(
                f"  an attack finds nothing any more; {self.environments} counterexamples are kept "
                f"with robustness {self.robustness:z.4g} at least"
            )
        elif self.stopped == "no parameters":
            lines.append(
                f"  NO REPAIR FOUND: the best parameters have robustness {self.robustness:z.4g} "
                f"over {self.environments} counterexamples; this does not prove that none has more"
            )
        else:
            lines.append(
                f"  NOT FINISHED ({self.stopped}): robustness {self.robustness:z.4g} over "
                f"{self.environments} counterexamples so far"
            )
        if self.held_out_before is not None:
            lines.append(f"  before: {self.held_out_before.describe()}")
        if self.held_out_after is not None:
            lines.append(f"  after:  {self.held_out_after.describe()}")
        else:
            lines.append("  not checked in held-out environments")
        if self.found and self.held_out_after is not None and not self.held_out_after.passed:
            lines.append(
                "  the check found failures that the attacks missed: try a larger budget, "
                "margin or mass"
            )
        checks = (self.held_out_before, self.held_out_after)
        if all(check is not None and check.simulations and not check.failures for check in checks):
            lines.append("  too rare for the check to compare: see .estimate()")
        if _worse(self.held_out_before, self.held_out_after):
            lines.append("  the change made it worse: keep the nominal parameters")
        if self.rounds:
            counts = ", ".join(str(turn.counterexamples) for turn in self.rounds)
            lines.append(f"  counterexamples round by round: {counts}")
        text = f"{self.simulations:,} simulations in {self.seconds:z.1f} s, stopped: {self.stopped}"
        if self.without_verdict:
            text += f"; {self.without_verdict} gave no verdict"
        lines.append(f"  {text}")
        lines += [f"  note: {note}" for note in self.notes]
        return "\n".join(lines)

    def _changes(self) -> str:
        if self.arrays:
            return f"arrays changed by {self.change:z.4g} (Euclidean)"
        pairs = []
        for name, value in self.parameters.items():
            same = format_value(self.before[name]) == format_value(value)
            shown = "unchanged" if same else f"-> {format_value(value)}"
            pairs.append(f"{name} {format_value(self.before[name])} {shown}")
        return ", ".join(pairs)


def _worse(before: HeldOut | None, after: HeldOut | None) -> bool:
    return before is not None and after is not None and after.failures > before.failures
