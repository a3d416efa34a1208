"""Search on a model of the traces, for simulators that take seconds.

A robustness is one number of a simulation; its trace is thousands. Where simulations are dear this
search learns the traces (`trace_model`), and asks the monitor, on the model and with gradients,
where the property would be broken. Whoever runs it gives it the traces and the monitor
(`falsification/surrogates.py`); told of robustness alone it is `TuRBO`, whose points are among its
own in any case, in case the model is wrong.
"""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Array, Float, Key

from verifai_jax.core.checks import check_count, check_fraction
from verifai_jax.core.cube import Cube
from verifai_jax.search.base import Observations, Search
from verifai_jax.search.turbo import TuRBO, TuRBOState


@dataclass(frozen=True)
class TraceSurrogate(Search[TuRBOState]):
    """Model of the traces, monitored and descended on; the real system decides.

    **Arguments:**

    - `initial`: points of the prior before the model has a say.
    - `share`: of the points that the model proposes; the others are those of `TuRBO`.
    - `capacity`: rows that the model knows at most, the best half and the last ones.
    - `starts`: descents for each proposal, the best one of which is simulated.
    - `steps`: steps of a descent.

    **Raises:** `ValueError` for values out of range.
    """

    most_at_once: ClassVar[int] = 8
    initial: int = 8
    share: float = 0.75
    capacity: int = 512
    starts: int = 16
    steps: int = 40

    def __post_init__(self) -> None:
        check_count("initial", self.initial, 2)
        check_fraction("share", self.share, one=True)
        check_count("capacity", self.capacity, 16)
        check_count("starts", self.starts)
        check_count("steps", self.steps)

    @property
    def without_traces(self) -> TuRBO:
        """The search that it is where there are no traces."""
        return TuRBO(initial=self.initial, capacity=self.capacity)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> TuRBOState:
        return self.without_traces.init(key, cube, batch)

    def ask(
        self, state: TuRBOState, cube: Cube, batch: int
    ) -> tuple[Float[Array, "batch d"], TuRBOState]:
        return self.without_traces.ask(state, cube, batch)

    def tell(self, state: TuRBOState, cube: Cube, observations: Observations) -> TuRBOState:
        return self.without_traces.tell(state, cube, observations)

    def warm_start(self, state: TuRBOState, cube: Cube, observations: Observations) -> TuRBOState:
        return self.without_traces.warm_start(state, cube, observations)
