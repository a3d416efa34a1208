"""The search loop, its options, its table and its result."""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.evaluation.replay import Replay as Replay
    from verifai_jax.falsification._falsify import falsify as falsify
    from verifai_jax.falsification._falsify import resume as resume
    from verifai_jax.falsification._falsify import simulate as simulate
    from verifai_jax.falsification.run import Run as Run
    from verifai_jax.falsification.run_folder import load as load
    from verifai_jax.falsification.running import RunError as RunError
    from verifai_jax.falsification.start import Start as Start
    from verifai_jax.falsification.table import ErrorTable as ErrorTable
__getattr__, __dir__, __all__ = attach(__name__)
