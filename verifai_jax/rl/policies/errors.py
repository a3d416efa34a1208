"""The error of a policy that cannot be loaded."""

MAX_BYTES = 150_000_000
"""Bytes of a file, and of what is unpacked of it. A policy for control has a thousandth; a
file that says more is damaged, or means to fill the memory."""
MAX_NUMBERS = 2**24
"""Numbers that a graph computes for one observation, at most. That of a policy computes a
hundredth; a graph of a few bytes can ask for any number of them."""


class PolicyError(ValueError):
    """An error for a file or an object that is not a usable policy."""
