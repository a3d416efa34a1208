"""Values that rooms pass to each other: traces, functions of time, events, the unit cube."""
