"""Scenic programs as feature spaces, their scenes compiled to JAX."""

from verifai_jax.addons.scenic._scenic import scenic as scenic
from verifai_jax.addons.scenic.compilation import ProgramError as ProgramError
from verifai_jax.addons.scenic.program import ScenicProgram as ScenicProgram
from verifai_jax.addons.scenic.steering import scenic_sampler as scenic_sampler
