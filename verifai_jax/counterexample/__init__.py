"""What there is to know of a counterexample: whether it is real, how little it takes, and why."""
