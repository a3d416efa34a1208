"""Parameters for which a formula holds: chosen by `synthesize`, or changed by `repair`."""

from verifai_jax.addons.synthesis._repair import repair as repair
from verifai_jax.addons.synthesis._synthesize import synthesize as synthesize
from verifai_jax.addons.synthesis.aim import Aim as Aim
from verifai_jax.addons.synthesis.held_out import HeldOut as HeldOut
from verifai_jax.addons.synthesis.results import Repair as Repair
from verifai_jax.addons.synthesis.results import Synthesis as Synthesis
