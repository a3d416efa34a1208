"""Parameters for which a formula holds: found (`synthesize`), or mended (`repair`)."""

from verifai_jax.synthesis.heldout import HeldOut as HeldOut
from verifai_jax.synthesis.repair import repair as repair
from verifai_jax.synthesis.results import Repair as Repair
from verifai_jax.synthesis.results import Synthesis as Synthesis
from verifai_jax.synthesis.synthesize import synthesize as synthesize
