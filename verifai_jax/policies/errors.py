"""The error of a policy that cannot be loaded."""

MAX_BYTES = 150_000_000
"""Bytes of a file, and of what is unpacked of it. A policy for control has a thousandth; a
file that says more is damaged, or means to fill the memory."""


class PolicyError(ValueError):
    """Raised for a file or an object of which no policy can be made."""
