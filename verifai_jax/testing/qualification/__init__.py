"""The tool's own oracles, run on the user's machine: `verifai-jax qualify`."""

from verifai_jax.testing.qualification._qualify import qualify as qualify
from verifai_jax.testing.qualification.result import Qualification as Qualification
