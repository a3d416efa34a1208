"""The aim for which `synthesize` and `repair` choose parameters, and its check.

Aim(margin=0.2, held_out=0)
Aim("probability")                              # the same as aim="probability"
"""

from dataclasses import dataclass
from typing import Literal

from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import check_names
from verifai_jax.search import Search

AIMS = ("robustness", "probability")


@dataclass(frozen=True)
class Aim:
    """The aim of a choice of parameters.

    - `of`: `"robustness"`: the formula must hold in all environments that an attack finds, as
      robustly as possible. `"probability"`: the lowest failure probability, counted in samples of
      the prior without attacks, for problems in which no parameters always keep the formula.
    - `margin`: the required robustness.
    - `attack`: the search over the environment that looks for failures of the parameters.
    - `mass`: probability of the central part of the prior, around its medians, in which the
      environment is attacked; environments farther out in the tails are ignored. With 1 the attack
      reaches the ends of all tails at once.
    - `held_out`: number of fresh environments in which the result is checked; 0 for no check.

    **Raises:** `ValueError` for numbers out of range; `UnknownNameError` for another aim.
    """

    of: Literal["robustness", "probability"] = "robustness"
    margin: float = 0.0
    attack: str | Search = "cross_entropy"
    mass: float = 0.999
    held_out: int = 2000

    def __post_init__(self) -> None:
        check_names("aim", [self.of], AIMS)
        margin = self.margin
        if isinstance(margin, bool) or not isinstance(margin, int | float) or not margin >= 0:
            raise ValueError(f"margin must be a robustness of at least 0; got {margin!r}")
        check_count("held_out", self.held_out, 0)


def as_aim(given: Aim | Literal["robustness", "probability"]) -> Aim:
    """Return an aim, given by name or as an object."""
    return given if isinstance(given, Aim) else Aim(given)
