"""Points in, verdicts out: simulation and evaluation of batches, on devices and on the host."""
