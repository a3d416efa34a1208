"""Boxes of a feature space that are proved, broken, or neither: `vj.verify`."""

from verifai_jax.verification._verify import verify as verify
from verifai_jax.verification.result import Verification as Verification
from verifai_jax.verification.result import load_verification as load_verification
