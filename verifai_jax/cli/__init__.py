"""The command line: one file a command, each one call into the Python API."""
