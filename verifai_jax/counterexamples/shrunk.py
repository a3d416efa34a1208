"""The result of `shrink`: a counterexample that departs little from nominal, and its text."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.counterexamples.selection import columns_at
from verifai_jax.evaluation.replay import Replay, replay
from verifai_jax.problem.problem import Problem


class Step(NamedTuple):
    """The smallest departure after some simulations: how many coordinates depart, and how far."""

    simulations: int
    count: int
    distance: float


class LogDensities(NamedTuple):
    """Natural logarithms of the prior's density: at a failure, at the row where its search
    started, and at the likeliest features.
    """

    failure: float
    start: float
    likeliest: float


@dataclass(frozen=True, eq=False)
class Shrunk(Drawn, InNotebook):
    """The smallest departure from nominal found to fail.

    **Fields:** `features` and `u` `[d]`, their point of the unit cube; `rho`: their robustness, the
    margin by which they fail; `row`: the row of the run at which the search started; `changed`: the
    departures by name of coordinate: `(nominal, value)`, None if nominal lacks the item; `count`:
    number of departures; `distance`: Euclidean, in unit coordinates; `nominal`: the nominal point
    of the cube; `start_count` and `start_distance` of the row; `broken` and `start_broken`: names
    of the formulas broken by the result and by the row; `simulations` spent; `by`: the measure that
    was minimised first; `history`: a `Step` for each improvement; `notes`; `duration` of the
    simulation in seconds; `model_changed` and `finding`: those of the row's `Replay`; `stopped`:
    `"interrupted"` after Ctrl-C; `log_densities`: given for `by="likelihood"`, else None. Then the
    likeliest features replace the nominal ones, and distances are numbers of standard deviations.
    """

    _picture = "verifai_jax.pictures.counterexamples", "plot_shrunk"
    """The coordinates that depart, and the signal that breaks the property."""
    problem: Problem
    row: int
    features: dict[str, Any]
    u: Float[np.ndarray, " d"]
    rho: float
    changed: dict[str, tuple[Any, Any]]
    distance: float
    nominal: Float[np.ndarray, " d"]
    start_count: int
    start_distance: float
    simulations: int
    by: str
    precision: str
    history: tuple[Step, ...]
    notes: tuple[str, ...] = ()
    key: Key[Array, ""] | None = field(default=None, repr=False)
    duration: float | None = None
    broken: tuple[str, ...] = ()
    start_broken: tuple[str, ...] = ()
    model_changed: str = ""
    finding: str = ""
    stopped: str | None = None
    log_densities: LogDensities | None = None

    @property
    def count(self) -> int:
        """Number of coordinates that are not nominal."""
        return len(self.changed)

    @property
    def labels(self) -> tuple[str, ...]:
        """Readable names of the departures; control points of signals are named by their time."""
        labels = self.problem.space.labels(self.duration)
        return tuple(labels.get(name, name) for name in self.changed)

    def replay(self, precision: str | None = None) -> Replay:
        """Simulate the result again with the random key of the row, and keep the trace."""
        columns = columns_at(self.problem, self.u)
        return replay(self.problem, columns, self.key, self.row, precision or self.precision)  # pyright: ignore[reportArgumentType]

    def __str__(self) -> str:
        d = len(self.u)
        name = self.problem.name
        domains = self.problem.space.domains.values()
        # A distribution has no width: what counts is the probability between two values.
        thins_out = any(any(domain.tailed) for domain in domains)
        unit = "prior, in probability" if thins_out else "range"
        if self.log_densities is not None:
            lines = [self._likelihood(self.log_densities)]
        elif not self.count:
            lines = [
                f"{name}: the nominal features fail themselves, with robustness {self.rho:z.4g}; "
                "there is nothing to shrink"
            ]
        else:
            lines = [
                f"{name}: {_of(self.count, d)} away from nominal "
                f"{'is' if self.count == 1 else 'are'} enough for a failure, by "
                f"{self.distance:z.3g} of {'its' if self.count == 1 else 'their'} {unit} "
                f"(robustness {self.rho:z.3g})"
            ]
        if self.count:
            names = self.labels
            width = max(map(len, names))
            lines += [
                f"  {name:<{width}}  {_shown(was)} -> {_shown(now)}"
                for name, (was, now) in zip(names, self.changed.values(), strict=True)
            ]
        lines += [
            f"  {name}: {words}"
            for name, domain in self.problem.space.domains.items()
            if (words := domain.words_for(self.features[name]))
        ]
        if len(self.problem.formulas) > 1:
            lines.append(f"  {self._breaks()}")
        began = f"departed in {_of(self.start_count, d)}, by {self.start_distance:z.3g}"
        if self.log_densities is not None:
            began = f"has log-likelihood {self.log_densities.start:z.5g}"
        lines.append(f"  row {self.row} {began}; {self.simulations} simulations")
        lines += [f"  note: {note}" for note in self.notes]
        warnings = [text for text in (self.model_changed, self.finding) if text]
        return "\n".join([*warnings, *lines])

    def _likelihood(self, log: LogDensities) -> str:
        """Say how likely the failure is, against the likeliest features."""
        name, lost = self.problem.name, log.likeliest - log.failure
        if not self.count:
            return f"{name}: the likeliest features fail, with robustness {self.rho:z.4g}"
        return (
            f"{name}: the likeliest failure found has log-likelihood {log.failure:z.5g}, "
            f"{lost:z.4g} less than the likeliest features: as improbable as {self.distance:z.3g} "
            f"standard deviations of a normal distribution (robustness {self.rho:z.3g})"
        )

    def _breaks(self) -> str:
        """Say which formulas break, and which of those that the row broke do not any more."""
        text = f"breaks {', '.join(self.broken)}"
        if self.broken == self.start_broken:
            return f"{text}, as the row did"
        return f"{text}; row {self.row} broke {', '.join(self.start_broken)}"

    __repr__ = __str__


def _of(count: int, d: int) -> str:
    return f"{count} of {d} features" if d != 1 else "its one feature"


def _shown(value: object) -> str:
    if value is None or value == "" or value != value:
        return "absent"
    return f"{value:z.5g}" if isinstance(value, float) else str(value)
