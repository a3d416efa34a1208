"""The error of a policy that cannot be loaded."""

MAX_BYTES = 150_000_000
"""Maximum bytes of a file, also after unpacking; policies for control have a thousandth."""
MAX_NUMBERS = 2**24
"""Maximum count of numbers that a graph computes for one observation; policies need 1 %."""


class PolicyError(ValueError):
    """An error for a file or an object that is not a usable policy."""
