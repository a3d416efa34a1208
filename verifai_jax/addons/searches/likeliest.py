"""Search for likely failures: the objective includes the likelihood of the features.

    Likeliest(CrossEntropy())
    vj.falsify(problem, "likeliest")                    # around `cross_entropy`

The loop replaces the robustness by another objective (`falsification/likelihood.py`); the wrapped
search is unchanged.
"""

from dataclasses import dataclass, field, replace

from jaxtyping import PyTree

from verifai_jax.addons.searches.diverse import EITHER, Diverse
from verifai_jax.search.base import Search, Wants
from verifai_jax.search.cross_entropy import CrossEntropy
from verifai_jax.search.wrapper import Wrapper

MAX_BATCH = 64
"""Default size of a round at most."""


@dataclass(frozen=True)
class Likeliest(Wrapper[PyTree]):
    """A wrapper that makes another search look for likely failures.

    **Arguments:**
    - `search`: the wrapped search, which must learn.
    **Raises:** `TypeError` for anything that is not a search; `ValueError` for one that does not
    learn, or that cannot use this objective.
    """

    search: Search = field(default_factory=CrossEntropy)

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.search, Diverse):
            raise ValueError(EITHER)
        if not self.search.learns or self.search.wants.outcomes or self.search.wants.coverage_ids:
            raise ValueError(
                "only a search that learns from the robustness alone can look for likely failures, "
                f"such as 'portfolio' or 'cross_entropy'; got {self.search!r}"
            )

    @property
    def wants(self) -> Wants:
        # A model of the traces would propose what fails by most.
        batch = min(self.search.wants.max_batch, MAX_BATCH)
        return replace(self.search.wants, likelihood=True, traces=None, max_batch=batch)
