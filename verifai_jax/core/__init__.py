"""Ground that everything stands on and that knows nobody: traces, errors, keys, devices, text."""
