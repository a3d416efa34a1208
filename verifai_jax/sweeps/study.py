"""What to sweep: a space of hyper-parameters, what they train, and what a policy must keep.

    study = Study(
        "safe_training",
        space=FeatureSpace({"learning_rate": LogUniform(1e-4, 1e-2), "width": Categorical(16, 64)}),
        trainer=Trainer(task, PPO(), steps=32_768),
        problem=problem_of,                                 # Policy -> Problem
        snapshots=(8_192, 16_384, 32_768),
    )

`Study.check()` says everything that is wrong with it before anything trains.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from verifai_jax.core.checks import check_count, check_fraction
from verifai_jax.core.errors import UnknownNameError
from verifai_jax.features import FeatureSpace
from verifai_jax.mtl import Formula
from verifai_jax.problem.problem import Problem, ProblemError
from verifai_jax.rl.policy import Policy
from verifai_jax.sweeps.curves import check_curve
from verifai_jax.sweeps.trainer import STEPS, StudyError, Trainer, probes


@dataclass(frozen=True, eq=False)
class Study:
    """Hyper-parameters to sweep, under a name.

    **Arguments:**

    - `name`: how the command line and the report call it.
    - `space`: of the hyper-parameters; a `FeatureSpace`, or a dictionary of domains.
    - `trainer`: what they train.
    - `problem`: from a policy to the problem of its closed loop. JAX may trace the policy's
      weights.
    - `snapshots`: environment steps at which a training's policy is a row of the table; the end of
      the training always is one.
    - `seeds`: training seeds of each configuration: how many (0, 1, ...), or which.
    - `p`: the failure probability below which a policy is called safe.
    - `curve`: a formula over the learning curve, whose time is environment steps; None for none.
    - `description`: one line.

    `training_seeds` and `curve_formula` are the seeds and the formula.

    **Raises:** `StudyError` for parts of a wrong kind or out of range; what the parser says of
    the curve's formula.
    """

    name: str
    space: FeatureSpace
    trainer: Trainer
    problem: Callable[[Policy], Problem]
    snapshots: Sequence[int] = ()
    seeds: int | Sequence[int] = 1
    p: float = 0.01
    curve: Formula | str | None = None
    description: str = ""
    training_seeds: tuple[int, ...] = field(init=False, repr=False)
    curve_formula: Formula | None = field(init=False, repr=False, default=None)
    _problems: dict[str, Problem] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise StudyError(f"a study needs a name; got {self.name!r}")
        if isinstance(self.space, Mapping):
            object.__setattr__(self, "space", FeatureSpace(self.space))
        if not isinstance(self.space, FeatureSpace):
            raise StudyError(
                f"space must be a FeatureSpace or a dictionary of domains; got {self.space!r}"
            )
        if not isinstance(self.trainer, Trainer):
            raise StudyError(f"trainer must be a Trainer; got {self.trainer!r}")
        if isinstance(self.problem, Problem) or not callable(self.problem):
            raise StudyError(
                f"problem must be a function from a policy to a Problem; got {self.problem!r}"
            )
        object.__setattr__(self, "training_seeds", _seeds(self.seeds))
        snapshots = tuple(check_count("a snapshot", at, error=StudyError) for at in self.snapshots)
        object.__setattr__(self, "snapshots", tuple(sorted(set(snapshots))))
        check_fraction("p", self.p, error=StudyError)
        if self.curve is not None:
            object.__setattr__(self, "curve_formula", check_curve(self.curve))

    def snapshots_of(self, steps: int) -> tuple[int, ...]:
        """The environment steps of the rows of a training that takes so many."""
        return (*(at for at in self.snapshots if at < steps), steps)

    def check(self) -> None:
        """Refuse what cannot be swept, before anything compiles or trains.

        **Raises:** `StudyError` and `UnknownNameError` as `Trainer.check`; `StudyError` for
        snapshots after the end of every training, and for a problem that raises for an untrained
        policy, returns no `Problem`, or has a specification over signals that its closed loop
        lacks.
        """
        self.trainer.check(self.space)
        self.space.check_where()
        most = self.trainer.steps
        if STEPS in self.space.domains:
            most = max(int(value) for value, _ in probes(self.space.domains[STEPS]))
        late = [at for at in self.snapshots if at > most]
        if late:
            raise StudyError(f"snapshots must lie between 1 and steps = {most}; got {late[0]}")
        for name in self.algorithms:
            problem = self._problem_of(name)
            try:
                problem.check()
            except (ProblemError, UnknownNameError, ValueError) as error:
                raise StudyError(
                    f"the problem of an untrained {name!r} policy does not fit: {error}"
                ) from error
            problem.space.check_where()

    @property
    def algorithms(self) -> tuple[str, ...]:
        """The names of the algorithms that the space can choose."""
        from verifai_jax.sweeps.trainer import ALGORITHM

        if ALGORITHM not in self.space.domains:
            return tuple(self.trainer.by_name)
        return tuple(value for value, _ in probes(self.space.domains[ALGORITHM]))

    def untrained_problem(self) -> Problem:
        """The problem of a policy whose weights are all zero."""
        return self._problem_of(self.algorithms[0])

    def only(self, *names: str, nominal: Mapping[str, Any] | None = None) -> "Study":
        """The same study with these hyper-parameters varied alone; see `FeatureSpace.only`."""
        return replace(self, space=self.space.only(*names, nominal=nominal))

    def _problem_of(self, algorithm: str) -> Problem:
        if algorithm not in self._problems:
            self._problems[algorithm] = self._made_problem(algorithm)
        return self._problems[algorithm]

    def _made_problem(self, algorithm: str) -> Problem:
        policy = self.trainer.untrained(algorithm)
        try:
            problem = self.problem(policy)
        except Exception as error:
            raise StudyError(
                f"problem raised {type(error).__name__} for an untrained {algorithm!r} policy: "
                f"{error}"
            ) from error
        if not isinstance(problem, Problem):
            raise StudyError(
                f"problem must return a Problem for a policy; it returned {type(problem).__name__}"
            )
        return problem

    def __str__(self) -> str:
        lines = [f"{self.name}: {self.description}" if self.description else self.name]
        lines.append(f"  hyper-parameters: {', '.join(self.space.columns)}")
        task = type(self.trainer.task).__name__
        lines.append(f"  trains: {', '.join(self.algorithms)} on {task}, {self._length()}")
        for name, formula in self.untrained_problem().formulas.items():
            lines.append(f"  {name}: {formula}")
        return "\n".join(lines)

    def _length(self) -> str:
        if STEPS in self.space.domains:
            return f"steps {self.space.domains[STEPS]!r}"
        return f"{self.trainer.steps} steps"


def _seeds(seeds: Any) -> tuple[int, ...]:
    if isinstance(seeds, Sequence) and not isinstance(seeds, str):
        found = tuple(check_count("a training seed", seed, 0, error=StudyError) for seed in seeds)
        if not found or len(set(found)) < len(found):
            raise StudyError(f"training seeds must be different, at least one; got {seeds!r}")
        return found
    return tuple(range(check_count("seeds", seeds, error=StudyError)))
