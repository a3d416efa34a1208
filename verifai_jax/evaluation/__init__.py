"""Points in, verdicts out: simulation and judgement of batches, on devices and on the host."""
