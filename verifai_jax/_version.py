"""The version of this package, for records of runs and for the build."""

__version__ = "0.1.0"
