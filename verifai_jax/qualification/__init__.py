"""The tool's own oracles, run where it is used: `verifai-jax qualify`."""

from verifai_jax.qualification._qualify import qualify as qualify
from verifai_jax.qualification.result import Qualification as Qualification
