"""Parameters for which a formula holds: chosen by `synthesize`, or changed by `repair`."""

from verifai_jax.synthesis._repair import repair as repair
from verifai_jax.synthesis._synthesize import synthesize as synthesize
from verifai_jax.synthesis.held_out import HeldOut as HeldOut
from verifai_jax.synthesis.results import Repair as Repair
from verifai_jax.synthesis.results import Synthesis as Synthesis
