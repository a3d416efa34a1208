"""Division of a feature space into proved, broken and undecided boxes: `vj.verify`."""

from verifai_jax.addons.verification._verify import verify as verify
from verifai_jax.addons.verification.result import Verification as Verification
from verifai_jax.addons.verification.result import load_verification as load_verification
