"""The ground of every room, which imports none: traces, errors, keys, devices, checks, text."""
