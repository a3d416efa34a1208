"""The further training in the rounds of a hardening.

FurtherTraining(steps=50_000, own=0.5)
"""

from dataclasses import dataclass

from verifai_jax.addons.training.hardening.mixture import Start
from verifai_jax.core.messages.checks import check_count, check_fraction


@dataclass(frozen=True)
class FurtherTraining:
    """The training of a round: its length, and where its episodes begin.

    - `steps`: environment steps of each round; an eighth of the first training when left out.
    - `added`: the maximum number of failures, as points to train around, that a round adds.
    - `own`, `failing`: share of the task's own episodes, and share of episodes that begin near
      failures, including those drawn from the prior that fail; all others come from the prior. The
      share of own episodes grows after a round that loses return, and shrinks after other rounds.
    - `tolerance`: the share of the first policy's return that the result may lose.
    - `start`: a function `(key, features) -> state` for a task without such a method.

    **Raises:** `ValueError` for numbers out of range.
    """

    steps: int | None = None
    added: int = 64
    own: float = 0.25
    failing: float = 0.5
    tolerance: float = 0.02
    start: Start | None = None

    def __post_init__(self) -> None:
        if self.steps is not None:
            check_count("steps", self.steps)
        check_count("added", self.added)
        for name in ("own", "failing", "tolerance"):
            check_fraction(name, getattr(self, name), zero=True)
        if self.own + self.failing > 1:
            raise ValueError(
                f"own and failing are shares of all episodes; got {self.own} + {self.failing} > 1"
            )
