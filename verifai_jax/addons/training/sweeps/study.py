"""A study: a space of hyper-parameters, a trainer, and the specification of a safe policy.

study = Study("mine", {"width": Categorical(16, 64)}, Trainer(task, PPO()), problem_of)
study.check()                           # finds all that is wrong before anything trains
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from verifai_jax.addons.rl.policy import Policy
from verifai_jax.addons.training.sweeps.curves import check_curve
from verifai_jax.addons.training.sweeps.hyperparameters import probe_values
from verifai_jax.addons.training.sweeps.trainer import STEPS, StudyError, Trainer
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.user_code.source_collection import made_here, sources_of
from verifai_jax.core.user_code.sources import Maker, Sources
from verifai_jax.features import FeatureSpace
from verifai_jax.features.domain import Domain
from verifai_jax.mtl import Formula
from verifai_jax.problem.problem import Problem, ProblemError


@dataclass(frozen=True, eq=False, init=False)
class Study(InNotebook):
    """A sweep to perform: hyper-parameters, a trainer, and a problem that tests a policy's safety.

    **Arguments:**
    - `name`: the name on the command line and in results.
    - `space`: the space of the hyper-parameters; a `FeatureSpace`, or a dictionary of domains.
    - `trainer`: the task and the algorithms.
    - `problem`: a function from a policy to the problem of its closed loop. JAX may trace the
      policy's weights.
    - `checkpoints`: environment steps at which the policy of a training becomes a row of the table,
      in addition to the end of the training.
    - `seeds`: training seeds of each configuration: their number (0, 1, ...), or the seeds.
    - `p`: the failure probability below which a policy is called safe, between 0 and 1.
    - `curve`: a formula over the learning curve, whose time is environment steps; None without one.
    - `description`: a description in one line.
    - `made_in`: as in `Problem`.

    **Fields** in addition:

    - `training_seeds`: the seeds as a tuple.
    - `curve_formula`: the parsed formula.

    **Raises:** `StudyError` for parts of a wrong type or out of range; `FormulaSyntaxError` and
    `UnknownNameError` for the formula of the curve.
    """

    name: str
    space: FeatureSpace
    trainer: Trainer
    problem: Callable[[Policy], Problem]
    checkpoints: tuple[int, ...]
    seeds: int | Sequence[int]
    p: float
    curve: Formula | str | None
    description: str
    made_in: Sequence[Maker] | None = field(repr=False)
    training_seeds: tuple[int, ...] = field(init=False, repr=False)
    curve_formula: Formula | None = field(init=False, repr=False)
    _problems: dict[str, Problem] = field(init=False, repr=False)

    def __init__(
        self, name: str, space: FeatureSpace | Mapping[str, Domain], trainer: Trainer,
        problem: Callable[[Policy], Problem], checkpoints: Sequence[int] = (),
        seeds: int | Sequence[int] = 1, p: float = 0.01, curve: Formula | str | None = None,
        description: str = "", made_in: Sequence[Maker] | None = None,
    ) -> None:  # fmt: skip
        if not isinstance(name, str) or not name.strip():
            raise StudyError(f"a study needs a name; got {name!r}")
        if isinstance(space, Mapping):
            space = FeatureSpace(space)
        if not isinstance(space, FeatureSpace):
            raise StudyError(
                f"space must be a FeatureSpace or a dictionary of domains; got {space!r}"
            )
        if not isinstance(trainer, Trainer):
            raise StudyError(f"trainer must be a Trainer; got {trainer!r}")
        if isinstance(problem, Problem) or not callable(problem):
            raise StudyError(
                f"problem must be a function from a policy to a Problem; got {problem!r}"
            )
        check_fraction("p", p, error=StudyError)
        steps = {check_count("a checkpoint", at, error=StudyError) for at in checkpoints}
        values = {
            "name": name, "space": space, "trainer": trainer, "problem": problem,
            "checkpoints": tuple(sorted(steps)), "seeds": seeds, "p": p, "curve": curve,
            "description": description,
            "made_in": made_here() if made_in is None else tuple(made_in),
            "training_seeds": _seeds(seeds),
            "curve_formula": None if curve is None else check_curve(curve), "_problems": {},
        }  # fmt: skip
        for attribute, value in values.items():
            object.__setattr__(self, attribute, value)

    def checkpoints_of(self, steps: int) -> tuple[int, ...]:
        """Return the environment steps of the rows of a training with `steps` in all."""
        return (*(at for at in self.checkpoints if at < steps), steps)

    def check(self) -> None:
        """Check that the study can be swept, before anything compiles or trains.

        **Raises:** the `StudyError` and `UnknownNameError` of `Trainer.check`; `StudyError` for
        checkpoints after the end of every training, and for a function `problem` that raises for an
        untrained policy, returns no `Problem`, or one with a specification over signals that its
        closed loop lacks.
        """
        self.trainer.check(self.space)
        self.space.check_where()
        maximum = self.trainer.steps
        if STEPS in self.space.domains:
            maximum = max(int(value) for value, _ in probe_values(self.space.domains[STEPS]))
        beyond = [at for at in self.checkpoints if at > maximum]
        if beyond:
            raise StudyError(
                f"checkpoints must lie between 1 and steps = {maximum}; got {beyond[0]}"
            )
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
        """Names of the algorithms that the space can choose."""
        return self.trainer.algorithms_in(self.space)

    def sources(self) -> Sources:
        """Return the files that define the study and its problem, and the versions of libraries."""
        problem = self.untrained_problem()
        return sources_of(self, problem, made=(*(self.made_in or ()), *(problem.made_in or ())))

    def untrained_problem(self) -> Problem:
        """Return the problem of a policy whose weights are all zero."""
        return self._problem_of(self.algorithms[0])

    def only(self, *names: str, nominal: Mapping[str, Any] | None = None) -> "Study":
        """Return the study with only these hyper-parameters varied; see `FeatureSpace.only`.

        **Arguments:**
        - `names`: hyper-parameters to vary.
        - `nominal`: values of the others.
        **Raises:** `UnknownNameError` for an unknown name; `ValueError` for a missing value.
        """
        return replace(self, space=self.space.only(*names, nominal=nominal))

    def _problem_of(self, algorithm: str) -> Problem:
        if algorithm not in self._problems:
            policy = self.trainer.untrained_policy(algorithm)
            try:
                problem = self.problem(policy)
            except Exception as error:
                raise StudyError(
                    f"problem raised {type(error).__name__} for an untrained {algorithm!r} policy: "
                    f"{error}"
                ) from error
            if not isinstance(problem, Problem):
                raise StudyError(
                    "problem must return a Problem for a policy; it returned "
                    f"{type(problem).__name__}"
                )
            self._problems[algorithm] = problem
        return self._problems[algorithm]

    def __str__(self) -> str:
        lines = [f"{self.name}: {self.description}" if self.description else self.name]
        lines.append(f"  hyper-parameters: {', '.join(self.space.columns)}")
        names = [n for n in self.algorithms if n != self.trainer.name]
        trains = " on ".join([*filter(None, [", ".join(names)]), self.trainer.name])
        lines.append(f"  trains: {trains}, {self._length()}")
        for name, formula in self.untrained_problem().formulas.items():
            lines.append(f"  {name}: {formula}")
        return "\n".join(lines)

    def _length(self) -> str:
        if STEPS in self.space.domains:
            return f"steps {self.space.domains[STEPS]!r}"
        return f"{self.trainer.steps} steps"


def _seeds(seeds: object) -> tuple[int, ...]:
    """Return the training seeds; a number of them stands for 0, 1, ..."""
    if isinstance(seeds, Sequence) and not isinstance(seeds, str):
        chosen = tuple(check_count("a training seed", seed, 0, error=StudyError) for seed in seeds)
        if not chosen or len(set(chosen)) < len(chosen):
            raise StudyError(f"training seeds must be different, at least one; got {seeds!r}")
        return chosen
    return tuple(range(check_count("seeds", seeds, error=StudyError)))
