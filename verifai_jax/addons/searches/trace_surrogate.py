"""Search on a model of the traces, for simulators that take seconds.

A simulation has only one robustness, but its trace has thousands of numbers. For slow simulations
this search learns a model of the traces (`trace_model`), and descends on the robustness of modelled
traces with gradients. The loop provides the traces; without them the search is `TuRBO`. Some points
always come from `TuRBO`, in case the model is wrong.
"""

from dataclasses import dataclass, replace

from jaxtyping import Array, Key

from verifai_jax.addons.searches.surrogates import Surrogate
from verifai_jax.addons.searches.trace_model import TraceOptions
from verifai_jax.addons.searches.turbo import TuRBO, TuRBOState
from verifai_jax.problem.problem import Problem
from verifai_jax.search.base import Wants
from verifai_jax.search.wrapper import Wrapper

MAX_BATCH = 8
"""Points in a round by default: in rounds of eight it was compared with other searches
(`benchmarks/RESULTS.md`, "Slow black boxes")."""


@dataclass(frozen=True)
class TraceSurrogate(TraceOptions, Wrapper[TuRBOState]):
    """A model of the traces on which searches descend; real simulations decide.

    **Arguments:**
    - `initial`: number of points of the prior before the model proposes any.
    - `share`: share of the points that the model proposes; `TuRBO` proposes the others.
    - `capacity`: maximum number of rows in the model: the best half and the latest ones.
    - `starts`: number of descents for each proposal; the best one is simulated.
    - `steps`: number of steps of a descent.
    **Raises:** `ValueError` for values out of range.
    """

    _internal = frozenset(("trace_model",))

    @property
    def search(self) -> TuRBO:
        """The search that is used without traces."""
        return TuRBO(initial=self.initial, capacity=self.capacity)

    @property
    def fallback(self) -> TuRBO:
        return self.search

    @property
    def wants(self) -> Wants:
        return replace(self.search.wants, traces=self, max_batch=MAX_BATCH)

    def trace_model(self, problem: Problem, key: Key[Array, ""]) -> Surrogate:
        """Return a model of the traces of a problem, without rows."""
        return Surrogate(problem, self, key)
