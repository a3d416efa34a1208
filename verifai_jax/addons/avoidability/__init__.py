"""The last instant at which a failure could still have been avoided (`last_chance`)."""

from verifai_jax.addons.avoidability._last_chance import last_chance as last_chance
from verifai_jax.addons.avoidability.result import Escape as Escape
from verifai_jax.addons.avoidability.result import LastChance as LastChance
