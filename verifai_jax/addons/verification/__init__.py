"""Division of a feature space into proved, broken and undecided boxes: `vj.verify`."""
