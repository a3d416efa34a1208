"""The tool's own oracles, run on the user's machine: `verifai-jax qualify`."""

from verifai_jax.addons.assurance.qualification._qualify import qualify as qualify
from verifai_jax.addons.assurance.qualification.result import Qualification as Qualification
