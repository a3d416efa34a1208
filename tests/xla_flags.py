"""Print the flags of XLA that tests compile with: those of `QUICK` that this version of XLA knows.

    XLA_FLAGS="$(python tests/xla_flags.py)" python -m pytest

XLA ends every process that gets a flag it does not know, so none is written down in the Makefile.
"""

from verifai_jax.core.compute.compilation import known_options

QUICK = {
    # The older emitters of loops compile in a quarter to a third less processor time (JAX 0.10 has
    # both, JAX 0.12 has no choice). One part per program: two workers use both cores already.
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 1,
}


def flags() -> str:
    """Return the value of the environment variable `XLA_FLAGS`."""
    known = known_options(QUICK)
    return " ".join(f"--{name}={str(value).lower()}" for name, value in known.items())


if __name__ == "__main__":
    print(flags())
