"""Searches beyond those of the falsifier: names of `verifai_jax.search`, found by entry points."""
