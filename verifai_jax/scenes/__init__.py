"""Scenic programs as feature spaces, their scenes compiled to JAX."""

from verifai_jax.scenes._scenic import scenic as scenic
from verifai_jax.scenes.compilation import ProgramError as ProgramError
from verifai_jax.scenes.program import ScenicProgram as ScenicProgram
